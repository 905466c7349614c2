"""Where everything lies in a rig: prim paths, file names, and the attribute of every model array."""

from __future__ import annotations

from dataclasses import dataclass

FORMAT_VERSION = 1

ACTOR, GEO, MATERIALS = "/Actor", "/Actor/geo", "/Actor/mtl"
SKULL, MANDIBLE = "/Actor/geo/Skull", "/Actor/geo/Mandible"

ACTOR_FILE, RIG_FILE, GEO_FILE = "actor.usda", "rig.usdc", "geo.usdc"
ONNX_FILE, ENCODE_FILE = "actor.onnx", "actor_encode.onnx"
SKEL_FILE, PACKAGE_FILE = "actor_skel.usdc", "actor.usdz"

PARAMETERS = ("jaw:d1", "jaw:d2", "jaw:d3")
ONNX_ATTRIBUTES = ("jaw:onnx", "jaw:onnx:encode")
SIDECAR_HASH = "sha256"  # key of the custom data of these attributes


@dataclass(frozen=True)
class ArraySpec:
    """Say where a model array lies in USD.

    Attributes:
        attribute: attribute name.
        shape: lengths; a name stands for any length, which follows from the number of values.
        kind: the model kind that has it, None for both.
        integer: whole numbers instead of float64.
    """

    attribute: str
    shape: tuple[int | str, ...] = ()
    kind: str | None = None
    integer: bool = False


def _curve(i: int) -> dict[str, ArraySpec]:
    length = f"n{i}"
    return {
        f"curve{i}_knots": ArraySpec(f"jaw:model:curve{i}Knots", (length,), "additive"),
        f"curve{i}_twists": ArraySpec(f"jaw:model:curve{i}Twists", (length, 6), "additive"),
        f"curve{i}_slopes": ArraySpec(f"jaw:model:curve{i}Slopes", (length, 6), "additive"),
    }


# Names on the left: `jawusd.evaluator.JawRig.arrays`. `d_range` lies in the three jaw:d*:range.
ARRAYS: dict[str, ArraySpec] = {
    "T_anatomical_skull": ArraySpec("jaw:model:tAnatomicalSkull", (4, 4)),
    "T_rest": ArraySpec("jaw:model:tRest", (4, 4)),
    "incisor": ArraySpec("jaw:model:incisor", (3,)),
    "codes": ArraySpec("jaw:model:codes", ("codes", 3)),
    "landmarks": ArraySpec("jaw:landmarks:positions", (5, 3)),
    "residual_limit_mm": ArraySpec("jaw:thresholds:residual"),
    "margin_limit_mm": ArraySpec("jaw:thresholds:margin"),
    "slice_d1": ArraySpec("jaw:bounds:sliceD1", ("slices",)),
    "slice_directions": ArraySpec("jaw:bounds:sliceDirections", ("directions", 2)),
    "slice_support": ArraySpec("jaw:bounds:sliceSupport", ("slices", "directions")),
    "slice_softness_mm": ArraySpec("jaw:bounds:sliceSoftness"),
    "slice_margin_mm": ArraySpec("jaw:bounds:sliceMargin"),
    "polygon_d1d2": ArraySpec("jaw:bounds:polygonD1D2", ("corners2", 2)),
    "polygon_d1d2_counts": ArraySpec("jaw:bounds:polygonD1D2Counts", ("polygons2",), integer=True),
    "polygon_d1d3": ArraySpec("jaw:bounds:polygonD1D3", ("corners3", 2)),
    "polygon_d1d3_counts": ArraySpec("jaw:bounds:polygonD1D3Counts", ("polygons3",), integer=True),
    "path_coefficients": ArraySpec("jaw:model:pathCoefficients", (2, 5), "anchored"),
    "path_scale_mm": ArraySpec("jaw:model:pathScale", (), "anchored"),
    "path_limits": ArraySpec("jaw:model:pathLimits", (2,), "anchored"),
    "glide_arch": ArraySpec("jaw:model:glideArch", (7,), "anchored"),
    "glide_drop": ArraySpec("jaw:model:glideDrop", (4,), "anchored"),
    "glide_softness_mm": ArraySpec("jaw:model:glideSoftness", (), "anchored"),
    "glide_fade_mm": ArraySpec("jaw:model:glideFade", (), "anchored"),
    "spline_scales": ArraySpec("jaw:model:splineScales", (3,), "anchored"),
    "spline_centres": ArraySpec("jaw:model:splineCentres", ("centres", 3), "anchored"),
    "spline_weights": ArraySpec("jaw:model:splineWeights", ("weights", 3), "anchored"),
    **_curve(1),
    **_curve(2),
    **_curve(3),
}
