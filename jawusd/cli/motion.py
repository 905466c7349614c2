"""Read what `jawusd animate` takes, keys, parameters, poses or a face capture, and keep it inside the bound."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jawusd.errors import FormatError
from jawusd.formats.arkit import read_arkit
from jawusd.formats.keys import load_keys
from jawusd.formats.poses import read_parameters, read_poses, table_columns

if TYPE_CHECKING:
    from jawusd.evaluator import JawRig


@dataclass(frozen=True, eq=False)
class Motion:
    """Hold a motion as it was read.

    Attributes:
        frames: frame numbers (F,), increasing.
        d: parameters (F, 3) [mm], NaN in frames that say nothing.
        fps: frames per second, None where the source does not know.
    """

    frames: np.ndarray
    d: np.ndarray
    fps: float | None


def read_motion(rig: JawRig, source: Path) -> Motion:
    """Read keys, parameters or poses. Keys are interpolated to every whole frame; poses are encoded.

    Args:
        rig: the rig they are for.
        source: keys.json, or a CSV or JSON table of d or of poses.

    Raises:
        FormatError: not such a file.
    """
    if source.suffix.lower() == ".json" and source.read_bytes().lstrip()[:1] == b"{":
        keys = load_keys(source)
        frames, d = keys.arrays()
        at = np.unique(np.concatenate([np.arange(np.ceil(frames[0]), np.floor(frames[-1]) + 1), frames]))
        return Motion(at, rig.interpolate(frames, d, at, method=keys.interpolation), keys.fps)
    if "d1" in table_columns(source):
        frames, d = read_parameters(source)
    else:
        frames, T = read_poses(source)
        d, _ = rig.encode(T)
    return Motion(frames.astype(np.float64), d, None)


def read_face(rig: JawRig, source: Path, fps: float | None) -> Motion:
    """Read the jaw of an ARKit face capture, its weights taken as shares of the person's own ranges.

    JawOpen 1 is the full opening; JawLeft less JawRight, and JawForward, are shares of the reach to that side at that
    opening. Left is the subject's left.

    Args:
        rig: the rig it is for.
        source: CSV of Live Link Face.
        fps: rate of the time codes, None to find it from them.

    Raises:
        FormatError: not such a file, or no row with a face.
    """
    capture = read_arkit(source, fps)
    opening, left, right, forward = capture.weights.T
    d = rig.denormalized(np.stack([opening, left - right, forward], axis=1))
    if not np.isfinite(d).any():
        raise FormatError("no row has a face (BlendShapeCount is 0 in all of them).", path=source)
    return Motion(capture.frames, d, capture.fps)


def kept_inside(rig: JawRig, d: np.ndarray) -> tuple[np.ndarray, dict[str, float]]:
    """Return parameters moved to the nearest valid ones where they lie outside the bound, and how much was moved.

    Args:
        rig: the rig.
        d: parameters (F, 3) [mm]; rows with NaN stay.

    Returns:
        Valid parameters (F, 3) [mm], and `clamped` frames, `largest_clamp_mm`, `mean_clamp_mm` over those frames.
    """
    outside = rig.margin(d) < float(rig.arrays["margin_limit_mm"])
    kept = d.copy()
    kept[outside] = rig.project(d[outside])
    moved_mm = np.linalg.norm(kept - d, axis=1)[outside]
    report = {
        "clamped": int(outside.sum()),
        "largest_clamp_mm": float(moved_mm.max(initial=0.0)),
        "mean_clamp_mm": float(moved_mm.mean()) if moved_mm.size else 0.0,
    }
    return kept, report
