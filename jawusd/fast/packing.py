"""The memory layout of a rig for compiled code: one flat array for the model, one for the bound.

Passing an array to compiled code takes about as long as computing one pose, so each function receives a single array.
The constants below are offsets into these arrays; their comments describe the contents.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.curves import GlideTable, HermiteCurve
from jawusd.evaluator.models import AdditiveModel, AnchoredModel, JawModelForm
from jawusd.evaluator.motions import RigFrames
from jawusd.evaluator.schema import ADDITIVE, ANCHORED, KINDS

# offsets into a model of any kind
KIND = 0  # index into `schema.KINDS`
COUNT = 1  # number of spline centres; 0 for an additive model
INCISOR = 2  # incisal point at rest (3,) [mm]
FROM_ANATOMICAL = 5  # matrix L (4, 4) in pose = L M Q, row-major
CLOSED = 21  # matrix Q (4, 4) in pose = L M Q
TO_ANATOMICAL = 37  # inverse of L (4, 4)
FROM_CLOSED = 53  # inverse of Q (4, 4)
ADJOINT = 69  # map (6, 6) of twists from the anatomical to the skull frame
VECTORS = 105  # vectors (4, 4) that represent the landmarks; see `evaluator.encoding`
REST = 121  # start of the part that depends on the kind of model
ANCHORED_KIND, ADDITIVE_KIND = KINDS.index(ANCHORED), KINDS.index(ADDITIVE)

# offsets into an anchored model
SCALES = REST  # lengths dividing the sheared displacement (3,) [mm]
OFFSET = REST + 3  # value of the spline at u = 0 (3,) [rad]
LINEAR = REST + 6  # linear terms of the spline (3 inputs, 3 outputs) [rad]
PATH = REST + 15  # habitual path: scale, low, high [mm], then 5 coefficients of gx and 5 of gz
ARCH = REST + 28  # coefficients of rho (7,)
DROP = REST + 35  # coefficients of drop (4,)
SOFTNESS = REST + 39  # radius of the softened absolute value and ramp [mm]
FADE = REST + 40  # opening over which the glide surface fades out [mm]
SPLINE = REST + 41  # centres, column-major (3, m), then kernel weights (m, 3), then the table of the glide surface
# layout of the glide table: numbers of knots n2 and n3 (0 without a table); knots (n2,) and starts (n2 + 1,) for d2,
# the same for d3, coefficients (n2 + 1, n3 + 1, 4, 4)

# offsets into an additive model
CURVES = REST  # offsets at which the three curves start
STARTS = REST + 3  # number n of starting points for searches
GRID = REST + 4  # d (n, 3) and incisal displacements (n, 3) of the starting points [mm], then the curves
# layout of a curve: number of knots n, knots (n,), starts (n + 1,), coefficients (n + 1, 4, k)

# offsets into the bound
ROUNDING = 0  # `SliceHull.softness_mm`
MARGIN = 1  # `SliceHull.offset_mm`
SIDES = 2  # number k of half-planes
HULL = 3  # normals of the half-planes, column-major (2, k), then the curve of the supports


def packed_model(model: JawModelForm, frames: RigFrames, vectors: Array) -> Array:
    """Return a packed model; see `encoding.landmark_vectors` for the vectors (4, 4) [mm].

    Raises:
        TypeError: the kind of model has no compiled form.
    """
    every: list[ArrayLike] = [
        [KINDS.index(model.kind), len(model.centres) if isinstance(model, AnchoredModel) else 0],
        model.incisor,
        frames.T_skull_anatomical,
        frames.T_anatomical_mandible_rest,
        frames.T_anatomical_skull,
        frames.T_mandible_anatomical_rest,
        frames.adjoint,
        vectors,
    ]
    if isinstance(model, AnchoredModel):
        return _joined([*every, *_anchored(model)])
    if isinstance(model, AdditiveModel):
        return _joined([*every, *_additive(model)])
    raise TypeError(f"models of kind {model.kind!r} have no compiled form")


def packed_bound(bound: SliceHull) -> Array:
    """Return a packed bound."""
    head = [np.array([bound.softness_mm, bound.offset_mm, len(bound.directions)]), bound.directions.T]
    return _joined([*head, _curve(bound.supports)])


def _anchored(model: AnchoredModel) -> list[ArrayLike]:
    gauge = model.gauge
    count = len(model.centres)
    return [
        model.scales,
        model.offset,
        model.weights[count:],
        [gauge.path_scale_mm, *gauge.path_limits],
        gauge.path_coefficients,
        gauge.glide_arch,
        gauge.glide_drop,
        [gauge.glide_softness_mm, gauge.glide_fade_mm],
        model.centres.T,
        model.weights[:count],
        *_glide(gauge.glide),
    ]


def _glide(table: GlideTable | None) -> list[ArrayLike]:
    if table is None:
        return [[0.0, 0.0]]
    (k2, k3), (s2, s3) = table.knots, table.starts
    return [[len(k2), len(k3)], k2, s2, k3, s3, table.coefficients]


def _additive(model: AdditiveModel) -> list[ArrayLike]:
    curves = [_curve(curve) for curve in model.curves]
    first = GRID + 2 * model.starts.d.size
    begins = first + np.cumsum([0, len(curves[0]), len(curves[1])])
    return [begins, [len(model.starts.d)], model.starts.d, model.starts.displacements, *curves]


def _curve(curve: HermiteCurve) -> Array:
    return _joined([[len(curve.knots)], curve.knots, curve.starts, curve.coefficients])


def _joined(parts: list[ArrayLike]) -> Array:
    return np.concatenate([np.asarray(part, dtype=np.float64).ravel() for part in parts])
