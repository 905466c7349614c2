"""Curves in se(3) whose parameter is millimetres at the lower incisal point."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import FittingError
from jawusd.evaluator.curves import HermiteCurve
from jawusd.fitting.coverage import PARAMETERS
from jawusd.geometry import se3_exp, se3_left_jacobian

#: A curve of some parameter t (n,): twists (n, 6) and their derivatives by t (n, 6); the twist is zero at t = 0.
Curve = Callable[[Array], tuple[Array, Array]]

KNOTS = 97
#: Directions of the incisal displacement that opening, laterotrusion and protrusion measure.
MEASURED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

# Share of the mandible's rms speed below which the incisal point counts as standing still or turning back
_SLOWEST = 0.2
_SHORTEST_MM = 0.01  # a curve shorter than this is a network that collapsed


def in_millimetres(
    curve: Curve, limits: tuple[float, float], root: Array, incisor: Array, axis: int
) -> tuple[HermiteCurve, Mask]:
    """Reparametrise a curve by d, the displacement of the incisal point along the curve's own axis [mm].

    Where the incisal point stands still or turns back, d goes on growing with a fifth of the mandible's rms path, so
    that every point of the curve has a parameter.

    Args:
        limits: interval of t that the data reach, containing 0.
        root: L with |L^T xi| = rms displacement of the mandible under a small twist xi [mm], shape (6, 6).
        incisor: incisal point at rest [mm], shape (3,).
        axis: 0 opening, 1 laterotrusion, 2 protrusion.

    Returns:
        The curve over d, through zero at d = 0, and at which of its knots the incisal point advances steadily.

    Raises:
        FittingError: the curve does not move at all.
    """
    t = np.unique(np.append(np.linspace(*limits, KNOTS), 0.0))
    twist, rate = curve(t)
    advance, speed = _incisal_advance(twist, rate, incisor, MEASURED[axis])
    zero = int(np.searchsorted(t, 0.0))
    sense = 1.0 if advance[-1] >= advance[0] else -1.0
    slowest = _SLOWEST * np.linalg.norm(rate @ root, axis=1)
    steady = sense * speed > slowest
    pace = np.where(steady, sense * speed, np.maximum(slowest, 1e-9))
    walked = 0.5 * (pace[1:] + pace[:-1]) * np.diff(t)
    step = np.where(steady[1:] & steady[:-1], sense * np.diff(advance), walked)
    d = np.concatenate([[0.0], np.cumsum(step)])
    d = sense * (d - d[zero])
    if np.ptp(d) < _SHORTEST_MM:
        raise FittingError(
            f"what was learned of the {PARAMETERS[axis]} moves nothing: {np.ptp(d):.2g} mm along its whole range, at "
            f"least {_SHORTEST_MM:g} mm are needed.",
            hint="The networks of this start collapsed. Try another seed or more starts, or the model 'anchored'.",
        )
    order = np.argsort(d)
    slopes = sense * rate / pace[:, None]
    return HermiteCurve(d[order], twist[order], slopes[order]), steady[order]


def straight(direction: Array, knots: Array) -> HermiteCurve:
    """Return the straight curve d -> d * direction, twists per mm (6,), between two knots (2,) [mm]."""
    return HermiteCurve(knots, knots[:, None] * direction, np.stack([direction, direction]))


def translation(axis: int) -> Array:
    """Return the twist per mm (6,) of a pure translation along the axis of a parameter."""
    return np.concatenate([np.zeros(3), MEASURED[axis]])


def _incisal_advance(twist: Array, rate: Array, incisor: Array, direction: Array) -> tuple[Array, Array]:
    """Return how far the incisal point has moved along a direction (n,) [mm], and its speed by the parameter."""
    M = se3_exp(twist)
    point = M[:, :3, :3] @ incisor + M[:, :3, 3]
    spatial = np.einsum("nij,nj->ni", se3_left_jacobian(twist), rate)
    velocity = np.cross(spatial[:, :3], point) + spatial[:, 3:]
    return (point - incisor) @ direction, velocity @ direction
