"""Solved performance: head and jaw of a known subject in each frame, as CSV table and as arrays in `tracks.npz`."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import AnyPath, FormatError
from jawusd.base.npz import NamedArrays, fields_of_shapes, take
from jawusd.formats.atomic import write_text_atomic

HEADER = ("frame", "time_s", "d1", "d2", "d3", "sigma1", "sigma2", "sigma3", "margin_mm", "verdict", "state")
_PREFIX = "solved_"


class SolveState(IntEnum):
    """Values of `Performance.state`."""

    LOST = 0  # no pose fits the images; the pose is interpolated
    SOLVED = 1  # both arches were found
    CARRIED = 2  # an arch is hidden (closed lips, no image); the pose is interpolated
    SKIN = 3  # an arch was not found; d is estimated from facial skin

    def __str__(self) -> str:
        return self.name.lower()


#: Descriptions of the states.
STATE_WORDS: dict[SolveState, str] = {
    SolveState.SOLVED: "solved from the images",
    SolveState.CARRIED: "hidden: interpolated from neighbouring frames",
    SolveState.LOST: "lost: no pose fits the images",
    SolveState.SKIN: "hidden: estimated from facial skin",
}
#: RGB of an arch in overlays, by state; the colours also differ in brightness.
STATE_COLOURS: dict[SolveState, tuple[int, int, int]] = {
    SolveState.SOLVED: (0, 190, 120),
    SolveState.CARRIED: (255, 225, 0),
    SolveState.LOST: (255, 40, 170),
    SolveState.SKIN: (110, 170, 255),
}


@dataclass(eq=False)
class Performance:
    """Solved performance; every frame has a pose, and `covariance` is its uncertainty."""

    frames: NDArray[np.int64]  # frame numbers of the reference camera, shape (F,)
    T_world_upper: Array  # pose of the head, shape (F, 4, 4)
    d: Array  # jaw parameters [mm], shape (F, 3)
    #: covariance of head twist (in head axes about `pivot`; omega [rad], v [mm]) and of d [mm], shape (F, 9, 9)
    covariance: Array
    rig_covariance: Array  # covariance of d due to rig error [mm^2], shape (F, 3, 3)
    #: covariance of the mandible's pose due to rig error, a twist (omega [rad], v [mm]), skull frame, shape (F, 6, 6)
    rig_pose_covariance: Array
    pivot: Array  # reference point of the head twist, upper scan frame [mm], shape (3,)
    state: NDArray[np.int8]  # `SolveState`, shape (F,)
    found: Mask  # arches whose outlines were used, (upper, lower), shape (F, 2)
    use: Mask  # which masks were used, or which cameras if there are no masks, shape (F, 2, C)
    uncovered: Array  # fraction of each mask not covered by the scan, shape (F, 2, C); NaN without a mask
    residual_px: Array  # standard deviation of outline residuals, shape (F, 2)
    matched_px: Array  # length of matched contour, shape (F, 2)
    margin_mm: Array  # signed distance to the rig's bound, > 0 inside, shape (F,)
    #: whether the rig allows the pose (inside the bound or within the tolerance of measured poses), shape (F,)
    valid: Mask
    verdict: list[str]  # the rig's verdict on each pose as text, length F
    camera_names: tuple[str, ...]  # names of the cameras, length C
    notes: dict[str, object] = field(default_factory=dict)  # estimates that apply to the whole take

    @property
    def sigma_d(self) -> Array:
        """Standard deviations of d [mm], including the error of the rig, shape (F, 3)."""
        return np.sqrt(np.einsum("fii->fi", self.covariance)[:, 6:] + np.einsum("fii->fi", self.rig_covariance))


def write_performance(path: AnyPath, performance: Performance, fps: float) -> None:
    """Write the jaw of every frame as CSV, atomically, with columns `HEADER`; lengths in mm, time 0 at frame 0.

    Raises:
        OutputError: the file cannot be written.
    """
    p = performance
    numbers = np.column_stack([p.frames / fps, p.d, p.sigma_d, p.margin_mm])
    lines = [",".join(HEADER)]
    for frame, row, verdict, state in zip(p.frames, numbers, p.verdict, p.state, strict=True):
        words = (verdict.replace(",", ";"), str(SolveState(int(state))))
        lines.append(",".join([str(int(frame)), *(f"{value:.6f}" for value in row), *words]))
    write_text_atomic(path, "\n".join([*lines, ""]))


@dataclass(frozen=True, eq=False)
class SolvedJaw:
    """Jaw of a performance, stored in `tracks.npz`."""

    d: Array  # jaw parameters [mm], shape (F, 3)
    sigma_mm: Array  # standard deviations of d [mm], shape (F, 3)
    margin_mm: Array  # signed distance to the rig's bound, > 0 inside, shape (F,)
    state: NDArray[np.int8]  # `SolveState`, shape (F,)
    #: whether the rig allows the pose (inside the bound or within the tolerance of measured poses), shape (F,)
    valid: Mask

    def arrays(self) -> dict[str, Array]:
        """Return the arrays by their names in the file.

        Raises:
            ValueError: an array has the wrong shape.
        """
        found = fields_of_shapes(self, _shapes(len(self.d)), "solved")
        return {_PREFIX + name: value for name, value in found.items()}


def take_solved(arrays: NamedArrays, count: int, path: AnyPath) -> SolvedJaw | None:
    """Return the performance arrays of a tracks file with `count` frames; None if the file has none.

    Raises:
        FormatError: an array is missing, has the wrong shape, is not finite, or has an unknown state.
    """
    if _PREFIX + "d" not in arrays:
        return None
    found = {name: take(arrays, _PREFIX + name, shape, path) for name, shape in _shapes(count).items()}
    if not np.isin(found["state"], list(SolveState)).all():
        raise FormatError(f'"{_PREFIX}state" contains an unknown state.', path=path)
    return SolvedJaw(
        found["d"], found["sigma_mm"], found["margin_mm"], found["state"].astype(np.int8), found["valid"].astype(bool)
    )


def _shapes(count: int) -> dict[str, tuple[int, ...]]:
    one, three = (count,), (count, 3)
    return {"d": three, "sigma_mm": three, "margin_mm": one, "state": one, "valid": one}
