"""A solved performance: head and jaw of a known person per frame, its CSV table, and its arrays in `tracks.npz`."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import FormatError
from jawusd.base.npz import NamedArrays, take
from jawusd.formats.atomic import write_text_atomic

HEADER = ("frame", "time_s", "d1", "d2", "d3", "sigma1", "sigma2", "sigma3", "margin_mm", "verdict", "state")
_PREFIX = "solved_"


class SolveState(IntEnum):
    """Values of `Performance.state`."""

    LOST = 0  # pictures that nothing fits: the motion before and after carries the jaw
    SOLVED = 1  # both arches found
    CARRIED = 2  # an arch out of sight: lips closed, no picture

    def __str__(self) -> str:
        return self.name.lower()


#: What the states mean, for people.
STATE_WORDS: dict[SolveState, str] = {
    SolveState.SOLVED: "solved from the pictures",
    SolveState.CARRIED: "out of sight: carried by the motion around",
    SolveState.LOST: "lost: nothing fits the pictures there",
}
#: Red, green and blue of an arch in pictures, by state; they differ in brightness too.
STATE_COLOURS: dict[SolveState, tuple[int, int, int]] = {
    SolveState.SOLVED: (0, 190, 120),
    SolveState.CARRIED: (255, 225, 0),
    SolveState.LOST: (255, 40, 170),
}


@dataclass(eq=False)
class Performance:
    """Hold a performance; every frame has a pose, and `covariance` says what it is worth.

    Attributes:
        frames: frame numbers of the reference camera, shape (F,).
        T_world_upper: the head, shape (F, 4, 4).
        d: jaw parameters [mm], shape (F, 3).
        covariance: of a step of the head in its own axes about `pivot` (omega [rad], v [mm]) and of d [mm], shape
            (F, 9, 9).
        pivot: point of the upper scan [mm], shape (3,).
        state: `SolveState`, shape (F,).
        found: arches whose outlines took part, (upper, lower), shape (F, 2).
        use: masks, or cameras, that took part, shape (F, 2, C).
        uncovered: share of every mask that the scan leaves uncovered, shape (F, 2, C); NaN without a mask.
        residual_px, matched_px: spread of the outlines' residuals, and contour that was matched, shape (F, 2).
        margin_mm: signed distance to the rig's bound, > 0 inside, shape (F,).
        valid: the rig allows the pose: inside its bound, or within the tolerance of measured poses, shape (F,).
        verdict: what the rig says of the pose, in words, length F.
        camera_names: length C.
        notes: what was estimated for the whole take.
    """

    frames: NDArray[np.int64]
    T_world_upper: Array
    d: Array
    covariance: Array
    pivot: Array
    state: NDArray[np.int8]
    found: Mask
    use: Mask
    uncovered: Array
    residual_px: Array
    matched_px: Array
    margin_mm: Array
    valid: Mask
    verdict: list[str]
    camera_names: tuple[str, ...]
    notes: dict[str, object] = field(default_factory=dict)

    @property
    def sigma_d(self) -> Array:
        """The standard deviations of d [mm], shape (F, 3)."""
        return np.sqrt(np.einsum("fii->fi", self.covariance)[:, 6:])


def write_performance(path: str | os.PathLike[str], performance: Performance, fps: float) -> None:
    """Write the jaw of every frame as CSV, atomically: `HEADER`; lengths in mm, times from frame 0 on.

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
    """Hold the jaw of a performance.

    Attributes:
        d: jaw parameters [mm], shape (F, 3).
        sigma_mm: their standard deviations [mm], shape (F, 3).
        margin_mm: signed distance to the rig's bound, > 0 inside, shape (F,).
        state: `SolveState`, shape (F,).
        valid: the rig allows the pose: inside its bound, or within the tolerance of measured poses, shape (F,).
    """

    d: Array
    sigma_mm: Array
    margin_mm: Array
    state: NDArray[np.int8]
    valid: Mask

    def arrays(self) -> dict[str, Array]:
        """Return the arrays by their names in the file.

        Raises:
            ValueError: an array has the wrong shape.
        """
        found = {}
        for name, shape in _shapes(len(self.d)).items():
            value = np.asarray(getattr(self, name))
            if value.shape != shape:
                raise ValueError(f"solved.{name} has shape {value.shape}, expected {shape}")
            found[_PREFIX + name] = value
        return found


def take_solved(arrays: NamedArrays, count: int, path: str | os.PathLike[str]) -> SolvedJaw | None:
    """Return what a file says of so many frames of a performance; None if it holds other tracks.

    Raises:
        FormatError: an array is missing, of another shape, not finite, or names no state.
    """
    if _PREFIX + "d" not in arrays:
        return None
    found = {name: take(arrays, _PREFIX + name, shape, path) for name, shape in _shapes(count).items()}
    if not np.isin(found["state"], list(SolveState)).all():
        raise FormatError(f'"{_PREFIX}state" holds a number that names no state.', path=path)
    return SolvedJaw(
        found["d"], found["sigma_mm"], found["margin_mm"], found["state"].astype(np.int8), found["valid"].astype(bool)
    )


def _shapes(count: int) -> dict[str, tuple[int, ...]]:
    one, three = (count,), (count, 3)
    return {"d": three, "sigma_mm": three, "margin_mm": one, "state": one, "valid": one}
