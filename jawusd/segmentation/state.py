"""The colours as they were after the last frames, so that resumed work gives what uninterrupted work would."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.base.npz import DAMAGED
from jawusd.formats.atomic import write_npz_atomic
from jawusd.segmentation.colours import ColourModel

# Alternating: a run may be killed between saving the colours of a frame and recording it.
_FILES = ("colours_0.npz", "colours_1.npz")


class ColourStates:
    """Save and restore the colours of all cameras."""

    def __init__(self, folder: Path, colours: Mapping[str, ColourModel]) -> None:
        """Take the folder of the files and the colours by camera."""
        self._folder, self._colours = folder, dict(colours)

    def keep(self, frame: int, step: int) -> None:
        """Write the colours after a frame.

        Raises:
            OutputError: the file cannot be written.
        """
        arrays: dict[str, ArrayLike] = {"frame": frame, "step": step}
        for name, model in self._colours.items():
            arrays[f"seen {name}"], arrays[f"counts {name}"] = model.counts()
        write_npz_atomic(self._folder / _FILES[frame % 2], arrays, packed=False)

    def take_up(self, done: int, step: int) -> int | None:
        """Restore the latest colours saved up to a frame that is done; step is 1 or -1, forwards or backwards.

        Returns the frame after which they were saved; None if there are none to resume from.
        """
        for frame in (done, done - step):
            path = self._folder / _FILES[frame % 2]
            kept = _stored(path)
            if kept is None or (int(kept["frame"]), int(kept["step"])) != (frame, step):
                continue
            for name, model in self._colours.items():
                model.take_up(np.asarray(kept[f"seen {name}"], np.int64), kept[f"counts {name}"])
            return frame
        return None


def _stored(path: Path) -> dict[str, Array] | None:
    """Return the arrays of a file; None where there is none, or it is damaged: the frames are then done again."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, *DAMAGED):
        return None


def state_files(folder: Path) -> list[Path]:
    """Return the files there may be in a folder."""
    return [folder / name for name in _FILES]
