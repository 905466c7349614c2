"""Compiled: poses to the nearest parameters, and verdicts on them, for one row."""

from __future__ import annotations

from math import isnan, sqrt
from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator.batching import LARGEST
from jawusd.evaluator.formula import ON_BOUND_MM
from jawusd.evaluator.verdicts import RIGID_TOLERANCE, Reason
from jawusd.fast.descent import DISPLACEMENT, PARAMETERS, Normal, Problem, descend, normal_scratch
from jawusd.fast.forms import parameters_at
from jawusd.fast.hull import signed_distance
from jawusd.fast.motion import Scratch, displaced, motion, scratch
from jawusd.fast.packing import (
    ANCHORED_KIND,
    FROM_CLOSED,
    GRID,
    INCISOR,
    KIND,
    SIDES,
    STARTS,
    TO_ANATOMICAL,
    VECTORS,
)
from jawusd.fast.rigid import device

NOT_FINITE, _NOT_RIGID = Reason.NOT_FINITE.value, Reason.NOT_RIGID.value
_OFF_MODEL, _OUTSIDE_BOUNDS = Reason.OFF_MODEL.value, Reason.OUTSIDE_BOUNDS.value


class Encoding(NamedTuple):
    """The memory of one call that encodes."""

    w: Scratch
    n: Normal
    target: Array
    x: Array
    product: Array


@device
def encoding_scratch(model: Array) -> Encoding:
    """Return the memory of one call that encodes."""
    return Encoding(scratch(model), normal_scratch(), np.empty((3, 4)), np.empty(3), np.empty((4, 4)))


@device
def encode(model: Array, T: Array, e: Encoding) -> float:
    """Write to e.x the d [mm] whose pose is nearest to T (4, 4), and return the residual [mm]."""
    vectors = model[VECTORS : VECTORS + 16].reshape(4, 4)
    M = e.w.M
    _measured(model, T, e.product, M)
    for i in range(3):
        for j in range(4):
            total = 0.0
            for k in range(4):
                total += M[i, k] * vectors[k, j]
            e.target[i, j] = total
    p0, p1, p2 = model[INCISOR], model[INCISOR + 1], model[INCISOR + 2]
    for i in range(3):
        e.x[i] = M[i, 0] * p0 + M[i, 1] * p1 + M[i, 2] * p2 + M[i, 3] - model[INCISOR + i]
    if model[KIND] == ANCHORED_KIND:
        # the nearest pose does not depend on the chart: searching over the displacement spares the gauge
        descend(model, Problem(DISPLACEMENT, vectors, e.target), e.x, e.w, e.n)
        u = (e.x[0], e.x[1], e.x[2])
        displaced(model, u, e.w)
        e.x[0], e.x[1], e.x[2] = parameters_at(model, u)
        if isnan(e.x[0]):
            return np.nan
    else:
        _read_off(model, e.x)
        descend(model, Problem(PARAMETERS, vectors, e.target), e.x, e.w, e.n)
        motion(model, e.x[0], e.x[1], e.x[2], e.w)
    return _residual_mm(vectors, e)


@device
def _measured(model: Array, T: Array, half: Array, M: Array) -> None:
    """Write the first three rows of L^-1 T Q^-1 to M."""
    for i in range(4):
        for k in range(4):
            total = 0.0
            for j in range(4):
                total += T[i, j] * model[FROM_CLOSED + 4 * j + k]
            half[i, k] = total
    for i in range(3):
        for k in range(4):
            total = 0.0
            for j in range(4):
                total += model[TO_ANATOMICAL + 4 * i + j] * half[j, k]
            M[i, k] = total


@device
def _read_off(model: Array, x: Array) -> None:
    """Replace the incisal displacement x by the d of the start whose displacement is nearest."""
    count = int(model[STARTS])
    at = model[GRID + 3 * count :]
    best, least = 0, np.inf
    for i in range(count):
        a, b, c = at[3 * i] - x[0], at[3 * i + 1] - x[1], at[3 * i + 2] - x[2]
        square = a * a + b * b + c * c
        if square < least:
            best, least = i, square
    for i in range(3):
        x[i] = model[GRID + 3 * best + i]


@device
def _residual_mm(vectors: Array, e: Encoding) -> float:
    """Return the distance [mm] of the images under the motion in e.w to their targets."""
    total = 0.0
    for i in range(3):
        for j in range(4):
            image = e.w.M[i, 3] * vectors[3, j]
            for k in range(3):
                image += e.w.M[i, k] * vectors[k, j]
            total += (image - e.target[i, j]) ** 2
    return sqrt(total)


@device
def finite(T: Array) -> bool:
    """Tell whether all of T (4, 4) are numbers a jaw can have."""
    for i in range(4):
        for k in range(4):
            if not abs(T[i, k]) < LARGEST:  # also false for NaN
                return False
    return True


@device
def rigid(T: Array) -> bool:
    """Tell whether T (4, 4) is rigid to the evaluator's tolerance: `geometry.rigidity_defect`."""
    defect = max(abs(T[3, 0]), abs(T[3, 1]), abs(T[3, 2]), abs(T[3, 3] - 1.0))
    for i in range(3):
        for k in range(i, 3):
            total = T[i, 0] * T[k, 0] + T[i, 1] * T[k, 1] + T[i, 2] * T[k, 2] - (1.0 if i == k else 0.0)
            defect = max(defect, abs(total))
    x = T[1, 1] * T[2, 2] - T[1, 2] * T[2, 1]
    y = T[1, 2] * T[2, 0] - T[1, 0] * T[2, 2]
    z = T[1, 0] * T[2, 1] - T[1, 1] * T[2, 0]
    return defect <= RIGID_TOLERANCE and T[0, 0] * x + T[0, 1] * y + T[0, 2] * z >= 0.0


@device
def judge(
    model: Array,
    bound: Array,
    T: Array,
    judging: bool,
    residual_limit: float,
    margin_limit: float,
    e: Encoding,
    v: Array,
) -> tuple[int, float, float]:
    """Return reason, residual and margin [mm] of a pose T (4, 4), its d in e.x: `evaluator.verdicts.judge`.

    Without `judging` only d and the residual; the reason is 0 wherever there are any.
    """
    e.x[:] = np.nan
    if not finite(T):
        return NOT_FINITE, np.nan, np.nan
    if not rigid(T):
        return _NOT_RIGID, np.nan, np.nan
    residual = encode(model, T, e)
    if not judging:
        return 0, residual, np.nan
    out, _, _ = signed_distance(bound, e.x[0], e.x[1], e.x[2], v)
    reason = 0 if residual <= residual_limit else _OFF_MODEL
    return reason | outside(-out, margin_limit), residual, -out


@device
def outside(margin: float, margin_limit: float) -> int:
    """Return the reason against a margin [mm], 0 if there is none."""
    return 0 if margin >= margin_limit - ON_BOUND_MM else _OUTSIDE_BOUNDS


@device
def hull_scratch(bound: Array) -> Array:
    """Return the memory of one call for the hull."""
    return np.empty(int(bound[SIDES]))
