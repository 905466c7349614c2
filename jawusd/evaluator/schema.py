"""The named arrays that all rigs have: shapes and USD attributes. `jawusd.evaluator.kinds` adds those of each kind.

This file imports only the standard library: it is copied into the single-file reader.
"""

from __future__ import annotations

from typing import Literal, NamedTuple


class ArraySpec(NamedTuple):
    """Shape and USD attribute of one array.

    Attributes:
        attribute: USD attribute, with the values in row-major order; None for `d_range` (see `D_RANGE_ATTRIBUTES`).
        shape: Axis lengths; axes of the same name have the same length.
        integer: Whether the values are integers in USD; in memory all arrays are float64.
        values: Constraint on the values: "positive", "rising" (two or more, strictly increasing), or None.
    """

    attribute: str | None
    shape: tuple[int | str, ...] = ()
    integer: bool = False
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


#: Arrays of the clearance of the teeth, all present or none; see `jawusd.evaluator.contact`.
CONTACT_ARRAYS: dict[str, ArraySpec] = {
    "contact_first_mm": ArraySpec("jaw:contact:first", (3,)),
    "contact_step_mm": ArraySpec("jaw:contact:step", (3,)),
    "contact_shape": ArraySpec("jaw:contact:shape", (3,), integer=True),
    "contact_values": ArraySpec("jaw:contact:clearances", ("clearances",), integer=True),
    "contact_closed_mm": ArraySpec("jaw:contact:closed"),
    "contact_error_mm": ArraySpec("jaw:contact:error"),
    "contact_limit_mm": ArraySpec("jaw:contact:limit"),
}


#: Arrays of the clearance between condyles and skull, for rigs with scanned bones, all present or none.
JOINT_ARRAYS: dict[str, ArraySpec] = {
    "joint_first_mm": ArraySpec("jaw:joints:first", (3,)),
    "joint_step_mm": ArraySpec("jaw:joints:step", (3,)),
    "joint_shape": ArraySpec("jaw:joints:shape", (3,), integer=True),
    "joint_values": ArraySpec("jaw:joints:clearances", ("joint clearances",), integer=True),
    "joint_closed_mm": ArraySpec("jaw:joints:closed"),
    "joint_error_mm": ArraySpec("jaw:joints:error"),
    "joint_limit_mm": ArraySpec("jaw:joints:limit"),
}

#: Arrays of the speeds in a take with a known frame rate, both present or both absent; see `jawusd.evaluator.speeds`.
SPEED_ARRAYS: dict[str, ArraySpec] = {
    "velocity_covariance": ArraySpec("jaw:motion:velocityCovariance", (3, 3)),
    "acceleration_covariance": ArraySpec("jaw:motion:accelerationCovariance", (3, 3)),
}

#: Distances of frames from a bound built without them, both arrays present or both absent; see
#: `jawusd.evaluator.arrays.HeldOut`.
HELD_OUT_ARRAYS: dict[str, ArraySpec] = {
    "held_out_share": ArraySpec("jaw:thresholds:heldOutShare"),
    "held_out_p95_mm": ArraySpec("jaw:thresholds:heldOutP95"),
}


#: Optional groups of arrays of any kind of model, each keyed by the name of one of its arrays.
COMMON_OPTIONAL = {
    "contact_values": CONTACT_ARRAYS,
    "joint_values": JOINT_ARRAYS,
    "velocity_covariance": SPEED_ARRAYS,
    "held_out_share": HELD_OUT_ARRAYS,
}
