"""The named arrays of rigs, with shapes and USD attributes; the kinds of jaw models, each with arrays and formula.

`MODELS` is the one list of kinds: files, checks, ONNX graphs, the torch layer and the single-file reader follow it.
This file imports only the standard library and modules that do the same: it is copied into the single-file reader.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Literal, NamedTuple, cast

from jawusd.evaluator.formula import (
    Arrays,
    GaugeNumbers,
    Numbers,
    RigidMotion,
    anchored_motion,
    curve,
    curve_tables,
    displacement,
    flat_ended_slopes,
    glide,
    spline,
    spline_input,
    spread_of,
    twist_motion,
)
from jawusd.evaluator.operations import FloatOperations, Operations, Table, rows, triple
from jawusd.geometry.rodrigues import N, Triple


class ArraySpec(NamedTuple):
    """Shape and USD attribute of one array."""

    #: USD attribute, with the values in row-major order; None for `d_range` (see `D_RANGE_ATTRIBUTES`)
    attribute: str | None
    shape: tuple[int | str, ...] = ()  # axis lengths; axes of the same name have the same length
    integer: bool = False  # whether the values are integers in USD; in memory all arrays are float64
    #: constraint on the values: "positive", "rising" (two or more, strictly increasing), or None
    values: Literal["positive", "rising"] | None = None


D_RANGE_ATTRIBUTES = ("jaw:d1:range", "jaw:d2:range", "jaw:d3:range")  # one per row of `d_range`, (low, high) [mm]

COMMON: dict[str, ArraySpec] = {
    "T_anatomical_skull": ArraySpec("jaw:model:tAnatomicalSkull", (4, 4)),
    "T_rest": ArraySpec("jaw:model:tRest", (4, 4)),
    "incisor": ArraySpec("jaw:model:incisor", (3,)),
    "d_range": ArraySpec(None, (3, 2)),
    "landmarks": ArraySpec("jaw:landmarks:positions", ("landmarks", 3)),
    "slice_d1": ArraySpec("jaw:bounds:sliceD1", ("openings",), values="rising"),
    "slice_directions": ArraySpec("jaw:bounds:sliceDirections", ("directions", 2)),
    "slice_support": ArraySpec("jaw:bounds:sliceSupport", ("openings", "directions")),
    "slice_softness_mm": ArraySpec("jaw:bounds:sliceSoftness", values="positive"),
    "slice_margin_mm": ArraySpec("jaw:bounds:sliceMargin"),
    "polygon_d1d2": ArraySpec("jaw:bounds:polygonD1D2", ("lateral corners", 2)),
    "polygon_d1d2_counts": ArraySpec("jaw:bounds:polygonD1D2Counts", ("lateral outlines",), integer=True),
    "polygon_d1d3": ArraySpec("jaw:bounds:polygonD1D3", ("protrusion corners", 2)),
    "polygon_d1d3_counts": ArraySpec("jaw:bounds:polygonD1D3Counts", ("protrusion outlines",), integer=True),
    "residual_limit_mm": ArraySpec("jaw:thresholds:residual"),
    "tolerance_mm": ArraySpec("jaw:thresholds:tolerance"),
    "codes": ArraySpec("jaw:model:codes", ("codes", 3)),
}


def _clearance_arrays(prefix: str, namespace: str, size: str) -> dict[str, ArraySpec]:
    """Return the arrays of a clearance table by name: `prefix` begins the names, `namespace` those of attributes."""
    return {
        f"{prefix}_first_mm": ArraySpec(f"{namespace}:first", (3,)),
        f"{prefix}_step_mm": ArraySpec(f"{namespace}:step", (3,)),
        f"{prefix}_shape": ArraySpec(f"{namespace}:shape", (3,), integer=True),
        f"{prefix}_values": ArraySpec(f"{namespace}:clearances", (size,), integer=True),
        f"{prefix}_closed_mm": ArraySpec(f"{namespace}:closed"),
        f"{prefix}_error_mm": ArraySpec(f"{namespace}:error"),
        f"{prefix}_limit_mm": ArraySpec(f"{namespace}:limit"),
    }


#: Distances of frames from a bound built without them; see `jawusd.evaluator.arrays.HeldOut`.
HELD_OUT_ARRAYS: dict[str, ArraySpec] = {
    "held_out_share": ArraySpec("jaw:thresholds:heldOutShare"),
    "held_out_p95_mm": ArraySpec("jaw:thresholds:heldOutP95"),
}

#: Optional groups of arrays of any kind of model, all present or none, each keyed by the name of one of its arrays: the
#: clearance of the teeth, that of the condyles for rigs with scanned bones, speeds, and distances of held-out frames.
COMMON_OPTIONAL = {
    "contact_values": _clearance_arrays("contact", "jaw:contact", "clearances"),
    "joint_values": _clearance_arrays("joint", "jaw:joints", "joint clearances"),
    "velocity_covariance": {
        "velocity_covariance": ArraySpec("jaw:motion:velocityCovariance", (3, 3)),
        "acceleration_covariance": ArraySpec("jaw:motion:accelerationCovariance", (3, 3)),
    },
    "held_out_share": HELD_OUT_ARRAYS,
}


ANCHORED, ADDITIVE = "anchored", "additive"


class AnchoredNumbers(NamedTuple):
    """The scalars of an anchored model (see `AnchoredModel`)."""

    gauge: GaugeNumbers
    incisor: Triple[float]
    scales: Sequence[float]
    linear: Sequence[Sequence[float]]
    offset: Triple[float]
    spread: Triple[float] | None


#: Arrays of a glide surface measured on scans, of which a model has all or none; see `jawusd.evaluator.curves`.
GLIDE_ARRAYS: dict[str, ArraySpec] = {
    "glide_d2": ArraySpec("jaw:model:glideD2", ("glide knots of d2",), values="rising"),
    "glide_d2_factors": ArraySpec("jaw:model:glideD2Factors", ("glide knots of d2", "glide factors")),
    "glide_d3": ArraySpec("jaw:model:glideD3", ("glide knots of d3",), values="rising"),
    "glide_d3_factors": ArraySpec("jaw:model:glideD3Factors", ("glide knots of d3", "glide factors")),
}


class AnchoredFormula:
    """Rotation as a function of the position of the lower incisal point: ``omega = f(u), t = u + p - R(omega) p``."""

    arrays: ClassVar[dict[str, ArraySpec]] = {
        "path_coefficients": ArraySpec("jaw:model:pathCoefficients", (2, 5)),
        "path_scale_mm": ArraySpec("jaw:model:pathScale", values="positive"),
        "path_limits": ArraySpec("jaw:model:pathLimits", (2,), values="rising"),
        "glide_arch": ArraySpec("jaw:model:glideArch", (7,)),
        "glide_drop": ArraySpec("jaw:model:glideDrop", (4,)),
        "glide_softness_mm": ArraySpec("jaw:model:glideSoftness", values="positive"),
        "glide_fade_mm": ArraySpec("jaw:model:glideFade", values="positive"),
        "spline_scales": ArraySpec("jaw:model:splineScales", (3,), values="positive"),
        "spline_centres": ArraySpec("jaw:model:splineCentres", ("centres", 3)),
        "spline_weights": ArraySpec("jaw:model:splineWeights", ("weights", 3)),
    }
    optional: ClassVar[dict[str, dict[str, ArraySpec]]] = {"glide_d2": GLIDE_ARRAYS}

    def __init__(self, arrays: Arrays) -> None:
        *weights, first, second, third = rows(arrays["spline_weights"], 3)
        linear = (first, second, third)
        self.tables = {"centres": rows(arrays["spline_centres"], 3), "weights": weights}
        self._glide_width = 0
        if "glide_d2" in arrays:
            self._glide_width = len(arrays["glide_d2_factors"]) // len(arrays["glide_d2"])
            for name, d in (("glide2", "d2"), ("glide3", "d3")):
                knots, factors = arrays[f"glide_{d}"], rows(arrays[f"glide_{d}_factors"], self._glide_width)
                self.tables.update(curve_tables(name, knots, factors, flat_ended_slopes(knots, factors)))
        spread = spread_of(self.tables["centres"], weights)
        offset = spline((0.0, 0.0, 0.0), self.tables["centres"], weights, linear, spread, FloatOperations())
        incisor, scales = triple(arrays["incisor"]), arrays["spline_scales"]
        self.numbers = AnchoredNumbers(GaugeNumbers.of(arrays), incisor, scales, linear, offset, spread)

    def motion(
        self,
        d: Triple[N],
        tables: Mapping[str, Table],
        ops: Operations[N, Table],
        numbers: Numbers | None = None,
    ) -> RigidMotion[N]:
        """Return the motion away from the closed bite, anatomical frame, at the jaw parameters d [mm].

        `tables` and `numbers` are those of the formula in the form of the number type; without numbers, its own floats.
        """
        gauge, incisor, scales, linear, offset, spread = cast("AnchoredNumbers", numbers or self.numbers)
        table = glide(self._glide_width, d[1], d[2], tables, ops) if self._glide_width else None
        u = displacement(gauge, d, ops, table)
        q = spline_input(gauge, scales, u, ops)
        omega = spline(q, tables["centres"], tables["weights"], linear, spread, ops)
        return anchored_motion(triple([x - o for x, o in zip(omega, offset)]), u, incisor, ops)


def _curve(i: int) -> dict[str, ArraySpec]:
    knots = f"knots{i}"
    return {
        f"curve{i}_knots": ArraySpec(f"jaw:model:curve{i}Knots", (knots,), values="rising"),
        f"curve{i}_twists": ArraySpec(f"jaw:model:curve{i}Twists", (knots, 6)),
        f"curve{i}_slopes": ArraySpec(f"jaw:model:curve{i}Slopes", (knots, 6)),
    }


class AdditiveFormula:
    """A sum of three curves in se(3): ``log M(d) = Phi1(d1) + Phi2(d2) + Phi3(d3)`` (Yang et al. 2019, eq. 5)."""

    arrays: ClassVar[dict[str, ArraySpec]] = {**_curve(1), **_curve(2), **_curve(3)}
    optional: ClassVar[dict[str, dict[str, ArraySpec]]] = {}
    numbers: Numbers = ()

    def __init__(self, arrays: Arrays) -> None:
        self.tables = {}
        for name in ("curve1", "curve2", "curve3"):
            values, slopes = (rows(arrays[f"{name}_{part}"], 6) for part in ("twists", "slopes"))
            self.tables.update(curve_tables(name, arrays[f"{name}_knots"], values, slopes))

    def motion(
        self,
        d: Triple[N],
        tables: Mapping[str, Table],
        ops: Operations[N, Table],
        numbers: Numbers | None = None,
    ) -> RigidMotion[N]:
        """Return the motion away from the closed bite (see `AnchoredFormula`); the model has no numbers."""
        first, second, third = (curve(f"curve{i}", x, tables, ops) for i, x in enumerate(d, start=1))
        twist = ops.split([x + y + z for x, y, z in zip(first, second, third)], 6)
        return twist_motion(triple(twist[:3]), triple(twist[3:]), ops)


#: The kinds of models: `arrays` and `optional` are those that a rig has besides `COMMON` and `COMMON_OPTIONAL`.
MODELS: dict[str, type[AnchoredFormula] | type[AdditiveFormula]] = {
    ANCHORED: AnchoredFormula,
    ADDITIVE: AdditiveFormula,
}
KINDS = tuple(MODELS)


def arrays_of(kind: str) -> dict[str, ArraySpec]:
    """Return the arrays that a rig of a model kind has, by name."""
    return {**COMMON, **MODELS[kind].arrays}


def present_arrays(kind: str, present: Callable[[str, ArraySpec], bool]) -> dict[str, ArraySpec]:
    """Return the arrays that a rig of a model kind has, by name, with the optional groups whose key is `present`."""
    found = arrays_of(kind)
    for name, group in {**MODELS[kind].optional, **COMMON_OPTIONAL}.items():
        if present(name, group[name]):
            found |= group
    return found


def every_array() -> dict[str, ArraySpec]:
    """Return the arrays of all kinds of models, including optional ones, by name."""
    return {name: spec for kind in KINDS for name, spec in present_arrays(kind, lambda *_: True).items()}
