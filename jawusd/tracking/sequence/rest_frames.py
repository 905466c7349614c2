"""The frames of a take in which the teeth are together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array
from jawusd.geometry import relative_pose
from jawusd.tracking.contour.frame_record import FrameRecord, whole_frames

# Teeth held together rest: slower than this against one another [mm/frame at the teeth], and no farther from the
# closest frame [mm].
_STILL_MM, _SAME_BITE_MM = 0.12, 0.2
_LONGEST_REST = 24  # frames used on either side: later ones tell nothing new


@dataclass(frozen=True, eq=False)
class RestFrames:
    """Say where the teeth are together, and what to do about it.

    Attributes:
        frames: numbers of the frames.
        named: whether the capture names one of them.
        point, lower: amid the teeth, and amid the lower crowns, scan coordinates [mm], shape (3,).
        apply: whether the lower scan is moved to where it belongs.
    """

    frames: tuple[int, ...]
    named: bool
    point: Array
    lower: Array
    apply: bool


def rest_frames(
    records: Mapping[int, FrameRecord], named: int | None, up: Array, point: Array, probes: Array
) -> tuple[int, ...]:
    """Return the frames in which the teeth rest together, around a named one or where the mouth is closed farthest.

    Args:
        named: frame the capture names; None searches.
        up: from the lower to the upper teeth, unit vector in scan axes, shape (3,).
        point, probes: amid the teeth, shape (3,), and spread over the lower ones, shape (N, 3), scan coordinates [mm].
    """
    relative = {frame: relative_pose(*records[frame].solution.poses) for frame in whole_frames(records)}
    if named is None:
        closed = {f: float((T[:3, :3] @ point + T[:3, 3] - point) @ up) for f, T in relative.items()}
        ranked = sorted(closed, key=lambda f: -closed[f])
        named = next((f for f in ranked if _still(relative, f, f + 1, probes)), None)
    if named is None or named not in relative:
        return ()
    out = [named]
    for step in (1, -1):
        frame = named
        while abs(frame + step - named) <= _LONGEST_REST and _still(relative, frame, frame + step, probes):
            frame += step
            if _moved_mm(relative[frame], relative[named], probes) > _SAME_BITE_MM:
                break
            out.append(frame)
    return tuple(sorted(out))


def _still(relative: Mapping[int, Array], frame: int, other: int, probes: Array) -> bool:
    if frame not in relative or other not in relative:
        return False
    return _moved_mm(relative[frame], relative[other], probes) < _STILL_MM


def _moved_mm(one: Array, other: Array, probes: Array) -> float:
    """Return how far two poses (4, 4) of the lower arch are apart, on average over points (N, 3) [mm]."""
    gap = probes @ (one - other)[:3, :3].T + (one - other)[:3, 3]
    return float(np.linalg.norm(gap, axis=1).mean())
