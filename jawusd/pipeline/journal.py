"""A record that grows by one line per finished frame, so that long work can be taken up again."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jawusd.errors import OutputError
from jawusd.formats.atomic import write_text_atomic
from jawusd.geometry.arrays import Array
from jawusd.pipeline.state import hash_value

FILE = "segment.jsonl"


class Journal:
    """Hold what is known about finished frames, in memory and in a file of JSON lines."""

    def __init__(self, folder: Path, inputs: str, resume: bool) -> None:
        """Start anew, or take up what was finished from the same inputs.

        Args:
            folder: where the file lies.
            inputs: hash of everything the work depends on.
            resume: keep what is there if it came from these inputs.

        Raises:
            OutputError: the folder cannot be written, or the file not read.
        """
        self._path = folder / FILE
        self.entries: dict[int, dict[str, Any]] = {}
        head = json.dumps({"inputs": inputs})
        lines = _lines(self._path) if resume else []
        if lines and lines[0] == head:
            self.entries = dict(entry for line in lines[1:] if (entry := _entry(line)) is not None)
        self._head = head
        self.drop(())

    def add(self, frame: int, entry: dict[str, Any]) -> None:
        """Note a finished frame.

        Args:
            frame: its number.
            entry: what to keep of it, as JSON has it.

        Raises:
            OutputError: the file cannot be written.
        """
        self.entries[frame] = json.loads(_line(frame, entry))["entry"]
        try:
            with open(self._path, "a", encoding="utf-8") as handle:
                handle.write(_line(frame, entry) + "\n")
        except OSError as error:
            raise OutputError(f"cannot be written: {error.strerror}.", path=self._path) from error

    def drop(self, frames: Iterable[int]) -> None:
        """Forget frames.

        Raises:
            OutputError: the file cannot be written.
        """
        for frame in frames:
            del self.entries[frame]
        kept = [self._head, *(_line(frame, entry) for frame, entry in self.entries.items())]
        write_text_atomic(self._path, "\n".join(kept) + "\n")

    def known(self, frame: int) -> tuple[Array, NDArray[np.int8]]:
        """Return T_world_upper and T_world_lower, shape (2, 4, 4), and status, shape (2,), of a frame."""
        entry = self.entries[frame]
        return np.array(entry["poses"], np.float64), np.array(entry["status"], np.int8)


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []
    except OSError as error:
        raise OutputError(f"cannot be read: {error.strerror}.", path=path) from error


def _line(frame: int, entry: dict[str, Any]) -> str:
    data = json.loads(json.dumps({"frame": frame, "entry": _without_nan(entry)}))
    return json.dumps({**data, "sha256": hash_value(data)})


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _entry(line: str) -> tuple[int, dict[str, Any]] | None:
    """Return a line's frame and entry; None for a line that was cut short when the work was stopped, or damaged."""
    try:
        data = json.loads(line)
        known = data.pop("sha256")
        return (data["frame"], data["entry"]) if known == hash_value(data) else None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
