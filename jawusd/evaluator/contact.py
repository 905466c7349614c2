"""Clearance: how far teeth, or condyles and skull, are from penetrating deeper than in the closed bite.

It is sampled from the scans on a grid over d when the rig is built, and interpolated trilinearly; outside the grid,
where the mouth is open, the nearest value is used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import EvaluatorError
from jawusd.evaluator.batching import pairs_in_chunks, rows_of

#: Stored values are multiples of this length [mm].
UNIT_MM = 0.01
#: Maximum penetration [mm] of the teeth in an authored pose beyond that of the closed bite.
AUTHORED_MM = 0.15
#: Clearance [mm] below which the interpolation error is measured.
NEAR_MM = 0.5


#: The pairs of surfaces with a clearance, and the prefixes of their array names.
Meeting = Literal["teeth", "condyles"]
PREFIXES: dict[Meeting, str] = {"teeth": "contact", "condyles": "joint"}


class Clearance(NamedTuple):
    """Result of `JawRig.clearance`."""

    clearance_mm: Array  # negative where surfaces penetrate deeper than in the closed bite, shape (...)
    gradient: Array  # its derivative with respect to d [mm/mm], shape (..., 3)


@dataclass(frozen=True, eq=False)
class ContactField:
    """The clearance of a rig, sampled over d."""

    first_mm: Array  # d of the first sample, shape (3,)
    step_mm: Array  # sample spacing along each axis, shape (3,)
    values: Array  # clearances [mm], shape (n1, n2, n3)
    closed_mm: float  # penetration depth of the scans in the closed bite; negative for a gap
    #: largest interpolation error at random valid parameters with a clearance below `NEAR_MM`; at least 0
    error_mm: float
    #: smallest clearance of the captured poses, at most 0; measured poses with a smaller clearance collide
    limit_mm: float
    _floats: tuple[Callable[[int], float], list[float], list[float], list[int]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        ends = [n - 1 for n in self.values.shape]
        read = np.ascontiguousarray(self.values).ravel().item
        object.__setattr__(self, "_floats", (read, self.first_mm.tolist(), self.step_mm.tolist(), ends))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array], of: Meeting) -> ContactField | None:
        """Return the clearance in the named arrays of a rig; None if the rig has none."""
        name = PREFIXES[of]
        if f"{name}_values" not in arrays:
            return None
        shape = tuple(int(n) for n in arrays[f"{name}_shape"])
        return cls(
            arrays[f"{name}_first_mm"],
            arrays[f"{name}_step_mm"],
            UNIT_MM * arrays[f"{name}_values"].reshape(shape),
            *(float(arrays[f"{name}_{each}_mm"]) for each in ("closed", "error", "limit")),
        )

    def arrays(self, of: Meeting) -> dict[str, Array]:
        """Return the arrays of the clearance by their names in a rig."""
        named = {
            "first_mm": self.first_mm,
            "step_mm": self.step_mm,
            "shape": np.array(self.values.shape, dtype=np.float64),
            "values": np.round(self.values.ravel() / UNIT_MM) + 0.0,  # + 0.0 turns -0.0 into 0.0
            "closed_mm": np.array(self.closed_mm),
            "error_mm": np.array(self.error_mm),
            "limit_mm": np.array(self.limit_mm),
        }
        return {f"{PREFIXES[of]}_{name}": value for name, value in named.items()}

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
        """Return which jaw parameters d (n, 3) [mm] have less clearance than ``limit_mm``; False for NaN."""
        return self.clearance(d).clearance_mm < limit_mm - self.error_mm

    def collides_at(self, d: Array, limit_mm: float) -> bool:
        """Return the result of `collides` for one d (1, 3) [mm], computed in Python floats, which is faster."""
        return self._single(*d[0].tolist()) < limit_mm - self.error_mm

    def _single(self, d1: float, d2: float, d3: float) -> float:
        """Return the clearance [mm] at one d [mm], computed in Python floats; NaN for NaN."""
        if not (math.isfinite(d1) and math.isfinite(d2) and math.isfinite(d3)):
            return math.nan
        flat, (first1, first2, first3), (step1, step2, step3), (last1, last2, last3) = self._floats
        x, y, z = (d1 - first1) / step1, (d2 - first2) / step2, (d3 - first3) / step3
        x = 0.0 if x < 0.0 else last1 if x > last1 else x
        y = 0.0 if y < 0.0 else last2 if y > last2 else y
        z = 0.0 if z < 0.0 else last3 if z > last3 else z
        i = int(x) if x < last1 else last1 - 1
        j = int(y) if y < last2 else last2 - 1
        k = int(z) if z < last3 else last3 - 1
        a, b, c = x - i, y - j, z - k
        wide = last3 + 1
        near = (i * (last2 + 1) + j) * wide + k
        far = near + (last2 + 1) * wide
        low = (flat(near) * (1 - c) + flat(near + 1) * c) * (1 - b) + (
            flat(near + wide) * (1 - c) + flat(near + wide + 1) * c
        ) * b
        high = (flat(far) * (1 - c) + flat(far + 1) * c) * (1 - b) + (
            flat(far + wide) * (1 - c) + flat(far + wide + 1) * c
        ) * b
        return float(low * (1 - a) + high * a)


_CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)


class RigClearance:
    """The clearances of a rig."""

    contact: ContactField | None  # clearance of the teeth over d; None if the rig was built without it
    #: clearance of the condyles; None unless the bones of both jaws were scanned. Cartilage and disc are not in the
    #: scans, so this clearance never rejects a pose
    joints: ContactField | None

    def clearance(self, d: ArrayLike, *, of: Meeting = "teeth") -> Clearance:
        """Return how far the teeth are from penetrating deeper than in the closed bite of the scans.

        Args:
            d: Jaw parameters [mm], shape (..., 3).
            of: "teeth", or "condyles" for the clearance between condyles and skull.

        Returns:
            The clearance [mm], shape (...), and its derivative with respect to d [mm/mm], shape (..., 3). The clearance
            saturates at about 1.5 mm and is constant far outside the bound. The clearance of the teeth is 0 in the
            closed bite.

        Raises:
            EvaluatorError: The rig has no such clearance; see `contact` and `joints`.
            ValueError: ``of`` is neither "teeth" nor "condyles".
        """
        if of not in PREFIXES:
            raise ValueError(f'of must be "teeth" or "condyles", got {of!r}')
        field = self.contact if of == "teeth" else self.joints
        if field is None:
            needed = "scans of both dental arches in occlusion"
            if of == "condyles":
                needed = "meshes of skull and mandible that include the joints"
            raise EvaluatorError(f"this rig has no clearance data for the {of}.", hint=f"Fit or bake it with {needed}.")
        rows, batch = rows_of(d, (3,), "d")
        value, gradient = pairs_in_chunks(field.clearance, rows)
        return Clearance(value.reshape(batch), gradient.reshape(*batch, 3))


def check_contact(arrays: Mapping[str, Array], name: str) -> None:
    """Raise EvaluatorError if a clearance whose arrays have a name prefix has values out of range or unequal counts."""
    shape, count = arrays[f"{name}_shape"], arrays[f"{name}_values"].size
    if (shape != np.round(shape)).any() or (shape < 2).any() or shape.prod() != count:
        raise EvaluatorError(
            f'"{name}_shape" is {shape.tolist()}; it must be three counts of 2 or more whose product is {count}.'
        )
    step, limit, error = (arrays[f"{name}_{each}_mm"] for each in ("step", "limit", "error"))
    if (step <= 0).any() or limit > 0 or error < 0:
        raise EvaluatorError(
            f'"{name}_step_mm" must be positive, "{name}_limit_mm" at most 0 and "{name}_error_mm" at least 0.'
        )
