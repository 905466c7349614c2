"""Clearance: how far the teeth are from running deeper into each other than the scans' closed bite does.

Sampled over d when a rig is made, from the scans: at each of a grid of parameters, the depth of the closed bite less
that of the pose. Between the values it is linear along each axis; beyond the grid, where the mouth is open, the nearest
value holds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from jawusd.errors import EvaluatorError
from jawusd.evaluator.batching import pairs_in_chunks, rows_of
from jawusd.evaluator.verdicts import Verdicts
from jawusd.geometry.arrays import Array, Mask

#: Values are stored as whole numbers of this length [mm].
UNIT_MM = 0.01
#: How much deeper than in the closed bite teeth may run in a pose that is authored [mm].
AUTHORED_MM = 0.15


class Clearance(NamedTuple):
    """What `JawRig.clearance` found.

    Attributes:
        clearance_mm: Below 0 where the teeth run deeper into each other than in the closed bite, shape (...).
        gradient: Its derivative by d [mm/mm], shape (..., 3).
    """

    clearance_mm: Array
    gradient: Array


@dataclass(frozen=True, eq=False)
class ContactField:
    """The clearance of a rig, sampled over d.

    Attributes:
        first_mm: d of the first value, shape (3,).
        step_mm: Between values along each axis, shape (3,).
        values: Clearances [mm], shape (n1, n2, n3).
        closed_mm: How deep the scans run into each other in the closed bite; negative if they leave a gap.
        error_mm: Largest error found at random valid parameters where the clearance is below 0.5 mm.
        limit_mm: Measured poses of less clearance collide: the most that captured poses needed.
    """

    first_mm: Array
    step_mm: Array
    values: Array
    closed_mm: float
    error_mm: float
    limit_mm: float

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> ContactField | None:
        """Pick the field out of the named arrays of a rig; None if the rig has none."""
        if "contact_values" not in arrays:
            return None
        shape = tuple(int(n) for n in arrays["contact_shape"])
        return cls(
            arrays["contact_first_mm"],
            arrays["contact_step_mm"],
            UNIT_MM * arrays["contact_values"].reshape(shape),
            *(float(arrays[f"contact_{name}_mm"]) for name in ("closed", "error", "limit")),
        )

    def arrays(self) -> dict[str, Array]:
        """Return the field's arrays by their names in a rig."""
        return {
            "contact_first_mm": self.first_mm,
            "contact_step_mm": self.step_mm,
            "contact_shape": np.array(self.values.shape, dtype=np.float64),
            "contact_values": np.round(self.values.ravel() / UNIT_MM) + 0.0,  # no -0: whole numbers have none
            "contact_closed_mm": np.array(self.closed_mm),
            "contact_error_mm": np.array(self.error_mm),
            "contact_limit_mm": np.array(self.limit_mm),
        }

    def clearance(self, d: Array) -> Clearance:
        """Return the clearance (n,) [mm] and its gradient (n, 3) at d (n, 3) [mm]; NaN for NaN."""
        last = np.array(self.values.shape) - 1
        place = (d - self.first_mm) / self.step_mm
        known = np.asarray(np.isfinite(place).all(axis=1))
        inside = np.clip(np.where(known[:, None], place, 0.0), 0.0, last)
        cell = np.minimum(inside.astype(np.intp), last - 1)
        t = inside - cell
        corners = self.values[tuple(cell[:, axis, None] + _CORNERS[:, axis] for axis in range(3))].reshape(-1, 2, 2, 2)
        a, b, c = ((1.0 - t[:, axis], t[:, axis]) for axis in range(3))
        along3 = corners[..., 0] * c[0][:, None, None] + corners[..., 1] * c[1][:, None, None]
        along2 = along3[..., 0] * b[0][:, None] + along3[..., 1] * b[1][:, None]
        value = along2[:, 0] * a[0] + along2[:, 1] * a[1]
        rise3 = corners[..., 1] - corners[..., 0]
        flat3 = rise3[..., 0] * b[0][:, None] + rise3[..., 1] * b[1][:, None]
        rise2 = along3[..., 1] - along3[..., 0]
        gradient = np.stack(
            [
                along2[:, 1] - along2[:, 0],
                rise2[:, 0] * a[0] + rise2[:, 1] * a[1],
                flat3[:, 0] * a[0] + flat3[:, 1] * a[1],
            ],
            axis=1,
        )
        gradient = np.where((place >= 0) & (place <= last), gradient / self.step_mm, 0.0)
        value[~known], gradient[~known] = np.nan, np.nan
        return Clearance(value, gradient)

    def collides(self, d: Array, limit_mm: float) -> Mask:
        """Tell at which d (n, 3) [mm] there is less clearance than ``limit_mm``; False for NaN."""
        return self.clearance(d).clearance_mm < limit_mm - self.error_mm


_CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)


class TouchingTeeth:
    """What a rig says of its teeth.

    Attributes:
        contact: The clearance of the teeth over d; None if the scans do not show it.
    """

    contact: ContactField | None

    def clearance(self, d: ArrayLike) -> Clearance:
        """Return how far the teeth are from running deeper into each other than in the scans' closed bite.

        Args:
            d: Jaw parameters [mm], shape (..., 3).

        Returns:
            The clearance [mm], shape (...), and its derivative by d [mm/mm], shape (..., 3). 0 is the closed bite; it
            ends at some 1.5 mm, and at the nearest sampled parameters far outside the bound.

        Raises:
            EvaluatorError: The rig has no clearances, see `contact`.
        """
        if self.contact is None:
            raise EvaluatorError(
                "this rig does not know how the teeth meet.",
                hint="Fit or bake it with scans of both rows of teeth in occlusion.",
            )
        rows, batch = rows_of(d, (3,), "d")
        value, gradient = pairs_in_chunks(self.contact.clearance, rows)
        return Clearance(value.reshape(batch), gradient.reshape(*batch, 3))

    def _without_collisions(self, verdicts: Verdicts, *, measured: bool) -> Verdicts:
        """Return the verdicts with poses in which the teeth collide refused."""
        if self.contact is None:
            return verdicts
        limit_mm = self.contact.limit_mm if measured else -AUTHORED_MM
        return verdicts.with_collisions(self.contact.collides(verdicts.d, limit_mm))


def check_contact(arrays: Mapping[str, Array]) -> None:
    """Check the clearances among the named arrays of a rig.

    Raises:
        EvaluatorError: Values out of range, or of numbers that do not match.
    """
    shape, count = arrays["contact_shape"], arrays["contact_values"].size
    if (shape != np.round(shape)).any() or (shape < 2).any() or shape.prod() != count:
        raise EvaluatorError(
            f'"contact_shape" is {shape.tolist()}; it must give the {count} clearances three axes of 2 or more.'
        )
    if (arrays["contact_step_mm"] <= 0).any() or arrays["contact_limit_mm"] > 0 or arrays["contact_error_mm"] < 0:
        raise EvaluatorError(
            '"contact_step_mm" must be positive, "contact_limit_mm" at most 0 and "contact_error_mm" not negative.'
        )
