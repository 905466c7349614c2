"""What `jawusd solve` says of every frame beside the poses: optional arrays of `tracks.npz`."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import FormatError
from jawusd.base.npz import NamedArrays, take
from jawusd.formats.performance import SolveState

_PREFIX = "solved_"


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
