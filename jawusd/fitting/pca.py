"""The linear baseline: principal components of the twists, under the mandible metric."""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import FittingError
from jawusd.evaluator.models import AdditiveModel
from jawusd.fitting.curves import MEASURED, straight, translation
from jawusd.fitting.data import TrainingData
from jawusd.fitting.form import FittedForm
from jawusd.fitting.metric import velocity_of
from jawusd.geometry import se3_log

_LARGEST_CONDITION = 1e3


def fit_pca(data: TrainingData, shown: Mask) -> FittedForm:
    """Fit a linear subspace of se(3) through the closed bite to all frames.

    The subspace holds the first principal components (as many as there are shown parameters) of log M; not centred, so
    that d = 0 is the closed bite. Its basis is chosen by the incisal velocity: d2 and d3 move the incisal point purely
    sideways and forward at first order, d1 along the mean opening direction of the take.

    The note `singular_values_mm` holds those of the weighted twists, rms over the mandible.

    Args:
        shown: which parameters the data show, shape (3,); the others become translations without rotation.

    Raises:
        FittingError: the components do not move the incisal point in as many independent directions.
    """
    L = data.metric.twist_root()
    twists = se3_log(data.motion)
    weights = data.weights / data.weights.sum()
    _, singular, Vt = np.linalg.svd((twists @ L) * np.sqrt(weights)[:, None], full_matrices=False)
    basis = np.linalg.solve(L.T, Vt[: int(shown.sum())].T)
    directions = _semantic_directions(basis, twists, weights, data.incisor, shown)
    reach = np.linalg.lstsq(directions, twists.T, rcond=None)[0]
    limits = np.stack([np.minimum(reach.min(1), -1.0), np.maximum(reach.max(1), 1.0)], axis=1)
    d1, d2, d3 = (straight(directions[:, i], limits[i]) for i in range(3))
    model = AdditiveModel((d1, d2, d3), data.incisor, limits)
    return FittedForm(model, np.ones(len(data), dtype=bool), {"singular_values_mm": singular.tolist()})


def _semantic_directions(basis: Array, twists: Array, weights: Array, incisor: Array, shown: Mask) -> Array:
    """Return the twists per mm of d1, d2, d3 as columns, shape (6, 3)."""
    measure = MEASURED[shown] @ velocity_of(incisor)
    to_mm = measure @ basis
    if np.linalg.cond(to_mm) > _LARGEST_CONDITION:
        raise FittingError(
            "the principal components do not move the incisal point in independent directions.",
            hint="Check the units and the anatomical frame of the poses, or use the model 'anchored'.",
        )
    directions = np.stack([translation(axis) for axis in range(3)], axis=1)
    directions[:, shown] = basis @ np.linalg.inv(to_mm)
    if shown[0]:
        # Along the habitual path: the mean motion per millimetre of opening over the take.
        d = to_mm @ np.linalg.lstsq(basis, twists.T, rcond=None)[0]
        habit = (d * weights) @ d[0] / ((weights * d[0]) @ d[0])
        directions[:, 0] = directions[:, shown] @ habit
    return directions
