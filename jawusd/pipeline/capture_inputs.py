"""Open a capture, and list and hash the input files of each of its parts."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path

from jawusd.base.errors import CaptureError
from jawusd.cameras.files import calibration_files
from jawusd.formats.capture import Capture, load_capture
from jawusd.formats.file_names import is_pattern, numbered_files
from jawusd.formats.scan_labels import labels_path
from jawusd.pipeline.state import hash_files, hash_value
from jawusd.pipeline.subject import BONES, TEETH


def open_capture(capture: Capture | str | os.PathLike[str], *, allow_outside: bool = False) -> Capture:
    """Return a capture, loading it from capture.toml or its folder if needed; see `formats.capture.load_capture`.

    Args:
        allow_outside: allow paths in the capture that point outside its folder.
    """
    return capture if isinstance(capture, Capture) else load_capture(capture, allow_outside=allow_outside)


def input_files(capture: Capture, names: Iterable[str]) -> dict[str, list[Path]]:
    """Return the input files of each part of a capture, for hashing.

    Args:
        names: any of "teeth", "mandible", "skull", "boards", "calibration", "masks", "videos".
    """
    parts: dict[str, list[Path]] = {}
    for name in names:
        if name == "teeth":
            scans = {key: getattr(capture.scans, key) for key in TEETH.values()}
            parts |= {key: [path] for key, path in scans.items()}
            parts |= {f"{key} labels": [labels_path(path, capture.scans.labels)] for key, path in scans.items()}
        elif name in BONES and (path := getattr(capture.scans, name)) is not None:
            parts[name] = [path]
        elif name == "calibration" and capture.calibration is not None:
            parts[name] = calibration_files(capture.calibration)
        elif name == "boards" and capture.boards is not None:
            parts |= {f"boards {k}": _sequence_files(path) for k, path in enumerate(capture.boards.videos)}
        elif name == "videos":
            clips = {camera.name: camera.video for camera in capture.cameras if camera.video is not None}
            parts |= {f"video {camera}": _sequence_files(path) for camera, path in clips.items()}
        elif name == "masks":
            for camera in capture.cameras:
                arches = {camera.masks.upper: "upper", camera.masks.lower: "lower"} if camera.masks else {}
                parts |= {f"masks {camera.name} {arch}": _sequence_files(path) for path, arch in arches.items()}
    return {part: [path for path in files if path.is_file()] for part, files in parts.items()}


def input_hashes(
    capture: Capture, names: Iterable[str], hashed: Callable[[list[Path]], str] = hash_files
) -> dict[str, str]:
    """Return the content hash of each part of a capture; see `input_files`.

    Args:
        hashed: function that returns one hash of a list of files.

    Raises:
        CaptureError: a file cannot be read.
    """
    try:
        names = list(names)
        found = {part: hashed(files) for part, files in input_files(capture, names).items()}
    except OSError as error:
        raise CaptureError(f"cannot be read: {error.strerror}.", path=error.filename) from error
    if "videos" in names:  # settings that affect the decoding of footage are hashed too
        keys = {"timecode", "start_frame", "fps", "colour_space", "pixel_aspect"}
        found["footage as read"] = hash_value([camera.model_dump(include=keys) for camera in capture.cameras])
        if capture.colour_config is not None:
            found["colour config"] = hashed([capture.colour_config])
    return found


class InputWatch:
    """Hash inputs and detect later changes; files whose size and timestamps are unchanged are not read again."""

    def __init__(self) -> None:
        self._hashed: list[tuple[Capture, list[str], dict[str, str]]] = []
        self._known: dict[tuple[object, ...], str] = {}

    def hashes(self, capture: Capture, names: Iterable[str]) -> dict[str, str]:
        """Return the hashes of `input_hashes` and store them for `changed`; raises CaptureError."""
        names = list(names)
        found = input_hashes(capture, names, self._hash)
        self._hashed.append((capture, names, found))
        return found

    def changed(self) -> list[str]:
        """Return the names, as in `input_files`, of the parts that changed since they were hashed."""
        parts: set[str] = set()
        for capture, names, before in self._hashed:
            now = input_hashes(capture, names, self._hash)
            parts |= {part for part in before.keys() | now.keys() if before.get(part) != now.get(part)}
        return sorted(parts)

    def _hash(self, files: list[Path]) -> str:
        states = [(path, path.stat()) for path in files]
        key = tuple((p, s.st_dev, s.st_ino, s.st_size, s.st_mtime_ns, s.st_ctime_ns) for p, s in states)
        if key not in self._known:
            self._known[key] = hash_files(files)
        return self._known[key]


def _sequence_files(path: Path) -> list[Path]:
    """Return the numbered files of an image pattern, or the path itself for a video."""
    if not is_pattern(path):
        return [path]
    try:
        return list(numbered_files(path).values())
    except CaptureError:  # the error is reported when the clip is opened
        return []
