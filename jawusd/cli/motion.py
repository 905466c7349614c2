"""Read what `jawusd animate` takes: keys, parameters or poses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jawusd.formats.keys import load_keys
from jawusd.formats.poses import read_parameters, read_poses, table_columns

if TYPE_CHECKING:
    from jawusd.evaluator import JawRig


def read_motion(rig: JawRig, source: Path) -> tuple[np.ndarray, np.ndarray, float | None]:
    """Return frames, parameters d and, where the file knows it, the frame rate.

    Keys are interpolated to every whole frame; poses are encoded.

    Args:
        rig: the rig they are for.
        source: keys.json, or a CSV or JSON table of d or of poses.

    Returns:
        Frames (F,), d [mm] (F, 3), frames per second or None.

    Raises:
        FormatError: not such a file.
    """
    if source.suffix.lower() == ".json" and source.read_bytes().lstrip()[:1] == b"{":
        keys = load_keys(source)
        frames, d = keys.arrays()
        at = np.unique(np.concatenate([np.arange(np.ceil(frames[0]), np.floor(frames[-1]) + 1), frames]))
        return at, rig.interpolate(frames, d, at, method=keys.interpolation), keys.fps
    if "d1" in table_columns(source):
        frames, d = read_parameters(source)
    else:
        frames, T = read_poses(source)
        d, _ = rig.encode(T)
    return frames.astype(np.float64), d, None
