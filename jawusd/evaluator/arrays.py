"""The named arrays of a rig, and checks of their presence, shapes and values."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.base.errors import EvaluatorError
from jawusd.evaluator.contact import PREFIXES, check_contact
from jawusd.evaluator.kinds import KINDS, ArraySpec, present_arrays
from jawusd.evaluator.speeds import check_speeds
from jawusd.geometry.anatomy import LANDMARKS
from jawusd.geometry.se3 import rigidity_defect

_RIGID_TOLERANCE = 1e-6

# maximum magnitude of values [mm, rad]: far beyond any jaw, but small enough that sums of squares do not overflow
_LARGEST = 1e9
_GROWTH = ("base_mm", "per_mm")  # names of the coefficients of a landmark's error in the header


class HeldOut(NamedTuple):
    """Distances by which frames of a take lie outside a bound that was built without them."""

    share: float  # fraction of these frames within the tolerance
    p95_mm: float  # 95th percentile of the distance of these frames outside the bound; frames inside count as 0
    tolerance_mm: float  # the tolerance of the rig

    @property
    def words(self) -> str:
        """The fraction of frames and, if it exceeds the tolerance, the 95th percentile, in words."""
        within = f"{100 * self.share:.0f} % of held-out frames lie within the tolerance of {self.tolerance_mm:.1f} mm"
        return within if self.p95_mm <= self.tolerance_mm else f"{within}; 95 % within {self.p95_mm:.1f} mm"


class RigArrays:
    """The arrays and the header of a rig."""

    arrays: dict[str, Array]  # named arrays, read-only; `jawusd.evaluator.kinds` lists them
    meta: dict[str, object]  # the header of the file
    kind: str  # the kind of model, one of `jawusd.evaluator.kinds.KINDS`
    T_anatomical_skull: Array  # transform from skull to anatomical axes (x left, y up, z anterior), shape (4, 4)
    T_rest: Array  # T_skull_mandible of the closed bite, shape (4, 4)
    landmarks: Array  # landmarks of the mandible [mm], mandible frame, shape (n, 3)
    incisor: Array  # the lower incisal point at rest [mm], anatomical frame, shape (3,)
    d_range: Array  # bounding box of the valid parameters [mm], rows (low, high), shape (3, 2)
    captured_d: Array  # parameters of the captured poses [mm], shape (n, 3)
    tolerance_mm: float  # maximum distance of a valid measured pose outside the bound; authored poses must lie inside

    def __init__(self, arrays: Mapping[str, ArrayLike], meta: Mapping[str, object]) -> None:
        """Check and store the arrays and the header.

        Raises:
            EvaluatorError: an unknown kind, or an array missing, of a wrong shape, not finite or out of range.
        """
        self.meta, self.kind = dict(meta), str(meta.get("kind"))
        self.arrays = checked_arrays(arrays, self.kind)
        self.T_anatomical_skull, self.T_rest = self.arrays["T_anatomical_skull"], self.arrays["T_rest"]
        self.landmarks, self.incisor = self.arrays["landmarks"], self.arrays["incisor"]
        self.d_range, self.captured_d = self.arrays["d_range"], self.arrays["codes"]
        # + 0.0 avoids -0.0 for older files, which store the negated tolerance
        self.tolerance_mm = float(self.arrays["tolerance_mm"]) + 0.0

    def __repr__(self) -> str:
        low, high = self.d_range.T
        ranges = ", ".join(f"d{i} {a:.1f} to {b:.1f}" for i, (a, b) in enumerate(zip(low, high), start=1))
        return f"<JawRig {self.actor or 'unnamed'}, {self.kind}, {ranges} mm>"

    @property
    def actor(self) -> str:
        """The subject's name, empty if the rig has none."""
        return str(self.meta.get("actor") or "")

    @property
    def method(self) -> str:
        """The method that fitted the model, empty if unknown."""
        return str(self.meta.get("method") or "")

    @property
    def inferred(self) -> tuple[str, ...]:
        """Descriptions of the parts of the rig that were inferred, not measured on this subject."""
        found = self.meta.get("inferred")
        return tuple(str(each) for each in found) if isinstance(found, list | tuple) else ()

    @property
    def error_growth(self) -> Array:
        """Error of the model at its landmarks, from held-out frames, shape (n, 2); 0 if unknown.

        The columns are the error near captured poses [mm], and its growth per mm far from them [mm/mm].
        """
        known = self.meta.get("uncertainty")
        if not isinstance(known, dict) or len(self.landmarks) != len(LANDMARKS):
            return np.zeros((len(self.landmarks), 2))
        tables = [known.get(name) for name in LANDMARKS]
        found = [[table.get(key) if isinstance(table, dict) else None for key in _GROWTH] for table in tables]
        return np.array(
            [[float(x) if isinstance(x, int | float) and 0 < x < _LARGEST else 0.0 for x in r] for r in found]
        )

    @property
    def held_out(self) -> HeldOut | None:
        """Distances by which held-out frames of the take lie outside the bound; None if unknown."""
        if "held_out_share" not in self.arrays:
            return None
        share, p95_mm = (float(self.arrays[name]) for name in ("held_out_share", "held_out_p95_mm"))
        return HeldOut(share, p95_mm, self.tolerance_mm)

    @property
    def model_hash(self) -> str:
        """SHA-256 over the names, shapes and little-endian float64 values of all arrays, sorted by name."""
        # The tolerance is hashed under its version 1 name and sign, so that old rigs keep their hash.
        named = {name: value for name, value in self.arrays.items() if name != "tolerance_mm"}
        named["margin_limit_mm"] = np.negative(self.arrays["tolerance_mm"])
        digest = hashlib.sha256()
        for name, value in sorted(named.items()):
            digest.update(f"{name}{list(value.shape)}".encode())
            digest.update(np.ascontiguousarray(value, dtype="<f8").tobytes())
        return digest.hexdigest()


def checked_arrays(arrays: Mapping[str, ArrayLike], kind: str) -> dict[str, Array]:
    """Return the arrays of a rig of a kind as read-only float64 after checking them, without those of other names.

    Raises:
        EvaluatorError: an unknown kind, or an array that is missing, of a wrong shape, not finite or out of range.
    """
    if kind not in KINDS:
        raise EvaluatorError(f'the model is of kind "{kind}"; this version of jawusd supports {", ".join(KINDS)}.')
    lengths: dict[str, int] = {}
    specs = present_arrays(kind, lambda name, _: name in arrays)
    checked = {name: _checked(name, arrays, spec.shape, lengths) for name, spec in specs.items()}
    _check_values(checked, specs)
    _check_sections(checked)
    for name in PREFIXES.values():
        if f"{name}_values" in checked:
            check_contact(checked, name)
    if "velocity_covariance" in checked:
        check_speeds(checked)
    if "spline_weights" in checked and lengths["weights"] != lengths["centres"] + 3:
        raise EvaluatorError(
            f'"spline_weights" has {lengths["weights"]} rows for {lengths["centres"]} centres; '
            f"expected {lengths['centres'] + 3}: one per centre and 3 for the linear part."
        )
    return checked


def flat_arrays(arrays: Mapping[str, Array]) -> dict[str, list[float]]:
    """Return the arrays flattened in row-major order, as `jawusd.evaluator.kinds` expects them."""
    return {name: value.ravel().tolist() for name, value in arrays.items()}


def _checked(
    name: str, arrays: Mapping[str, ArrayLike], shape: tuple[int | str, ...], lengths: dict[str, int]
) -> Array:
    if name not in arrays:
        raise EvaluatorError(f'the model has no array "{name}".')
    try:
        value = np.array(arrays[name], dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise EvaluatorError(f'"{name}" is not numeric ({error}).') from error
    wanted = [lengths.get(size, size) if isinstance(size, str) else size for size in shape]
    fits = value.ndim == len(shape) and all(isinstance(w, str) or w == n for w, n in zip(wanted, value.shape))
    if not fits:
        raise EvaluatorError(f'"{name}" has shape {value.shape}; expected ({", ".join(map(str, wanted))}).')
    if not np.isfinite(value).all():
        raise EvaluatorError(f'"{name}" contains values that are not finite.')
    if (np.abs(value) > _LARGEST).any():
        raise EvaluatorError(f'"{name}" has magnitudes up to {np.abs(value).max():.3g}; the maximum is {_LARGEST:g}.')
    lengths.update((size, n) for size, n in zip(shape, value.shape) if isinstance(size, str))
    value.flags.writeable = False
    return value


def _check_values(arrays: dict[str, Array], specs: Mapping[str, ArraySpec]) -> None:
    for name in ("T_anatomical_skull", "T_rest"):
        defect = float(rigidity_defect(arrays[name]))
        if defect > _RIGID_TOLERANCE:
            raise EvaluatorError(
                f'"{name}" is not rigid: its deviation from a rigid transform is {defect:.2g}; '
                f"the maximum is {_RIGID_TOLERANCE:g}."
            )
    for name, spec in specs.items():
        if spec.values == "positive" and not (arrays[name] > 0).all():
            raise EvaluatorError(f'"{name}" is {arrays[name].tolist()}; it must be positive.')
        if spec.values == "rising" and (len(arrays[name]) < 2 or (np.diff(arrays[name]) <= 0).any()):
            raise EvaluatorError(f'"{name}" must contain at least two increasing values.')
    if len(arrays["landmarks"]) < 3:
        raise EvaluatorError(f'"landmarks" has {len(arrays["landmarks"])} points; at least 3 are needed.')
    low, high = arrays["d_range"].T
    if not (low < high).all() or high[0] <= 0:
        raise EvaluatorError(f'"d_range" is {arrays["d_range"].tolist()} mm; it needs low < high and an opening > 0.')
    if arrays["tolerance_mm"] < 0 or arrays["residual_limit_mm"] <= 0:
        raise EvaluatorError('"residual_limit_mm" must be positive, and "tolerance_mm" must not be negative.')
    if "held_out_share" in arrays and not (0 <= arrays["held_out_share"] <= 1 and arrays["held_out_p95_mm"] >= 0):
        raise EvaluatorError('"held_out_share" must be from 0 to 1, and "held_out_p95_mm" must not be negative.')


def _check_sections(arrays: dict[str, Array]) -> None:
    directions = arrays["slice_directions"]
    if (np.abs(np.linalg.norm(directions, axis=1) - 1.0) > 1e-6).any():
        raise EvaluatorError('"slice_directions" must be unit vectors.')
    angles = np.sort(np.arctan2(directions[:, 1], directions[:, 0]))
    gaps = np.diff(np.append(angles, angles[0] + 2 * np.pi))
    if gaps.max(initial=0.0) >= np.pi - 1e-9 or len(directions) < 3:
        raise EvaluatorError('"slice_directions" do not surround the section: one side is open.')
    for name in ("polygon_d1d2", "polygon_d1d3"):
        counts = arrays[f"{name}_counts"]
        if counts.sum() != len(arrays[name]) or (counts < 3).any() or (counts != np.round(counts)).any():
            raise EvaluatorError(
                f'"{name}_counts" is {counts.tolist()}; it must split the {len(arrays[name])} corners of "{name}" into '
                "outlines of at least 3 corners."
            )
