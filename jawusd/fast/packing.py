"""The memory layout of a rig for compiled code: one flat array for the model, one for the bound.

Passing an array to compiled code takes about as long as computing one pose, so each function receives a single array.
The constants below are offsets into these arrays; their comments describe the contents. `jawusd.fast.kinds` has the
offsets of each kind of model.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.curves import HermiteCurve

# offsets of the fields in a packed model of any kind
KIND = 0  # index into `evaluator.kinds.KINDS`
COUNT = 1  # number of spline centres; 0 for models without a spline
# number n of starting points of searches in d; 0 if searches run over the displacement of the incisal point
STARTS = 2
GRID = 3  # offset of the starting points: d (n, 3), then their incisal displacements (n, 3) [mm]
INCISOR = 4  # incisal point at rest (3,) [mm]
FROM_ANATOMICAL = 7  # matrix L (4, 4) in pose = L M Q, row-major
CLOSED = 23  # matrix Q (4, 4) in pose = L M Q
TO_ANATOMICAL = 39  # inverse of L (4, 4)
FROM_CLOSED = 55  # inverse of Q (4, 4)
ADJOINT = 71  # map (6, 6) of twists from the anatomical to the skull frame
VECTORS = 107  # vectors (4, 4) that represent the landmarks; see `evaluator.encoding`
REST = 123  # start of the part that depends on the kind of model

# offsets of the fields in a packed bound
ROUNDING = 0  # `SliceHull.softness_mm`
MARGIN = 1  # `SliceHull.offset_mm`
SIDES = 2  # number k of half-planes
HULL = 3  # normals of the half-planes, column-major (2, k), then the curve of the supports


def packed_bound(bound: SliceHull) -> Array:
    """Return a packed bound."""
    head = [np.array([bound.softness_mm, bound.offset_mm, len(bound.directions)]), bound.directions.T]
    return joined([*head, curve_parts(bound.supports)])


def curve_parts(curve: HermiteCurve) -> Array:
    """Return a packed curve: number of knots n, knots (n,), starts (n + 1,), coefficients (n + 1, 4, k)."""
    return joined([[len(curve.knots)], curve.knots, curve.starts, curve.coefficients])


def joined(parts: Iterable[ArrayLike]) -> Array:
    """Return arrays flattened and joined."""
    return np.concatenate([np.asarray(part, dtype=np.float64).ravel() for part in parts])
