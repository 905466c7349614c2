"""The model's formulas in torch: differentiable, in float32 or float64, on any device.

A scalar of a formula is a column over the batch, shape (n, 1); an array (see `jawusd.evaluator.operations`) has shape
(n, m).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import cast

import torch
from torch import Tensor, nn

from jawusd.base.arrays import Array
from jawusd.evaluator.arrays import flat_arrays
from jawusd.evaluator.formula import Numbers, RigidMotion, anchored_motion
from jawusd.evaluator.kinds import MODELS
from jawusd.evaluator.operations import Rows, polynomials, triple
from jawusd.geometry.rodrigues import SMALL_SQUARED_ANGLE, Triple, angle_quotients, angle_series
from jawusd.solvers.solution import check_precision, full_precision

_TINY = 1e-30  # added to the argument of sqrt, which keeps the derivative at zero finite


class TensorOperations:
    """`jawusd.evaluator.operations.Operations` on tensors; all derivatives are finite, including at zero."""

    exp = staticmethod(torch.exp)
    polynomials = staticmethod(polynomials)

    @staticmethod
    def clip(x: Tensor, low: float, high: float) -> Tensor:
        """Return x limited to [low, high]."""
        return torch.clamp(x, low, high)

    @staticmethod
    def sqrt(x: Tensor) -> Tensor:
        """Return the square root."""
        return torch.sqrt(x + _TINY)

    @staticmethod
    def angle_coefficients(squared: Tensor) -> Triple[Tensor]:
        """Return a, b and c of `jawusd.geometry.rodrigues` at a squared angle [rad^2]."""
        small = squared < SMALL_SQUARED_ANGLE
        # each branch gets an argument where its derivatives are finite
        far = torch.where(small, torch.ones_like(squared), squared)
        near = torch.where(small, squared, torch.zeros_like(squared))
        angle = torch.sqrt(far)
        quotients = angle_quotients(far, angle, torch.sin(angle), torch.sin(0.5 * angle))
        return triple([torch.where(small, x, y) for x, y in zip(angle_series(near), quotients)])

    @staticmethod
    def log_sum_exp(terms: Sequence[Tensor]) -> Tensor:
        """Return the logarithm of the sum of the exponentials of all terms."""
        return torch.logsumexp(torch.cat(list(terms), dim=1), dim=1, keepdim=True)

    @staticmethod
    def columns(table: Tensor) -> list[tuple[Tensor]]:
        """Return the columns (1, m) of a table (m, k)."""
        return [(column[None],) for column in table.unbind(dim=1)]

    @staticmethod
    def weighted_sum(factors: Sequence[Tensor], weights: Tensor) -> Triple[Tensor]:
        """Return the sum of the rows of a table (m, 3), each multiplied by its factor, factors (n, m)."""
        return triple((factors[0] @ weights).split(1, dim=1))

    @staticmethod
    def lookup(x: Tensor, knots: Tensor, tables: Sequence[Tensor]) -> list[tuple[Tensor]]:
        """Return the rows (n, k) of each table, indexed by how many of the knots (m, 1) are at or below x."""
        interval = (x.detach() >= knots[:, 0]).sum(dim=1)
        return [(table[interval],) for table in tables]

    @staticmethod
    def split(row: Sequence[Tensor], width: int) -> Sequence[Tensor]:
        """Return the columns (n, 1) of an array (n, width)."""
        return row[0].split(1, dim=1)


OPERATIONS = TensorOperations()


class Formula(nn.Module):
    """A formula with all its tables, rows of floats by name, and its nested numbers as buffers."""

    singles: Tensor

    def __init__(self, tables: Mapping[str, Rows], numbers: Numbers) -> None:
        super().__init__()
        self._names = tuple(tables)
        for name, table in tables.items():
            self.register_buffer(name, torch.tensor(table, dtype=torch.float64))
        self._nesting = numbers
        self.register_buffer("singles", torch.tensor(list(_leaves(numbers)), dtype=torch.float64))

    def tables(self) -> dict[str, Tensor]:
        """Return the tables by name."""
        return {name: self.get_buffer(name) for name in self._names}

    def numbers(self) -> Numbers:
        """Return the numbers in their nested tuples, each a scalar tensor."""
        return cast("Numbers", _nested(self._nesting, iter(self.singles.unbind())))


class MotionModule(Formula):
    """The motion of a model of any kind, anatomical frame."""

    def __init__(self, kind: str, arrays: Mapping[str, Array]) -> None:
        formula = MODELS[kind](flat_arrays(arrays))
        super().__init__(formula.tables, formula.numbers)
        self._formula = formula

    def forward(self, d: Tensor) -> Tensor:
        """Return M(d), shape (n, 4, 4) [mm], for d (n, 3) [mm]."""
        return transforms(
            self._formula.motion(triple(d.split(1, dim=1)), self.tables(), OPERATIONS, numbers=self.numbers())
        )


def transforms(motion: RigidMotion[Tensor]) -> Tensor:
    """Return rigid motions as transforms (n, 4, 4)."""
    columns = torch.cat([x for row, shift in zip(motion.turn, motion.t) for x in (*row, shift)], dim=1)
    change = torch.cat([columns, torch.zeros_like(columns[:, :4])], dim=1).reshape(-1, 4, 4)
    return change + torch.eye(4, dtype=columns.dtype, device=columns.device)


def _leaves(numbers: object) -> Iterator[float]:
    if isinstance(numbers, tuple | list):
        for each in numbers:
            yield from _leaves(each)
    elif numbers is not None:
        yield cast("float", numbers)


def _nested(like: object, leaves: Iterator[Tensor]) -> object:
    if like is None:
        return None
    if not isinstance(like, tuple | list):
        return next(leaves)
    parts = [_nested(each, leaves) for each in like]
    return type(like)(*parts) if hasattr(like, "_fields") else parts  # type: ignore[arg-type]  # a NamedTuple's fields


@full_precision
def jaw_pose_from_axis_angle(
    axis_angle: Tensor,
    translation: Tensor | None,
    *,
    joint: Tensor,
    T_skull_model: Tensor,
    T_rest: Tensor,
    unit_mm: float = 1000.0,
) -> Tensor:
    """Return the jaw poses of a parametric face model (FLAME, SMPL-X) as T_skull_mandible.

    These models move jaw vertices by ``v -> R (v - j) + j + t`` in the model's frame (Li et al. 2017, FLAME; Pavlakos
    et al. 2019, SMPL-X); with the mouth closed, R = I and t = 0. In the skull frame, S = T_skull_model,
    ``T_skull_mandible = S [R, j - R j + t] S^-1 T_rest``.

    Args:
        axis_angle: Rotation vectors of the jaw [rad], shape (..., 3).
        translation: Translation t of the jaw [model units], shape (..., 3); None for models that only rotate it.
        joint: Jaw joint j of the face model with the mouth closed [model units], shape (3,).
        T_skull_model: Rigid alignment of the model's frame with the skull (upper teeth scan) frame, in mm, (4, 4).
        T_rest: Pose of the closed bite, `JawRig.T_rest`, shape (4, 4).
        unit_mm: Length of a model unit; both models use metres.

    Returns:
        T_skull_mandible [mm], shape (..., 4, 4).

    Raises:
        TypeError: a dtype coarser than float32.
    """
    check_precision("axis_angle", axis_angle.dtype)
    batch = axis_angle.shape[:-1]
    omega = axis_angle.reshape(-1, 3)
    moved = torch.zeros_like(omega) if translation is None else translation.reshape(-1, 3) * unit_mm
    turn, shift, anchor = (triple(x.split(1, dim=-1)) for x in (omega, moved, joint * unit_mm))
    turned = transforms(anchored_motion(turn, shift, anchor, OPERATIONS))
    T = T_skull_model @ turned @ torch.linalg.inv(T_skull_model) @ T_rest
    return T.reshape(*batch, 4, 4)
