"""The linear baseline: principal components of the twists, under the mandible metric."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.errors import FittingError
from jawusd.evaluator.models import AdditiveModel
from jawusd.fitting.curves import MEASURED, additive_arrays, straight, translation
from jawusd.fitting.data import TrainingData
from jawusd.fitting.metric import velocity_of
from jawusd.geometry import se3_log
from jawusd.geometry.arrays import Array, Mask

_LARGEST_CONDITION = 1e3


@dataclass(frozen=True)
class PcaFit:
    """Hold a fitted linear model.

    Attributes:
        model: the decoder.
        kept: all training frames, shape (N,); a baseline trims nothing.
        singular_values_mm: of the weighted twists, rms over the mandible, shape (6,).
    """

    model: AdditiveModel
    kept: Mask
    singular_values_mm: Array
    kind = "additive"

    def arrays(self) -> dict[str, Array]:
        """Return the model's own arrays."""
        return additive_arrays(self.model)

    def notes(self) -> dict[str, list[float]]:
        """Return what the header says about the fit."""
        return {"singular_values_mm": self.singular_values_mm.tolist()}


def fit_pca(data: TrainingData, shown: Mask) -> PcaFit:
    """Fit a linear subspace of se(3) through the closed bite.

    The subspace holds the first principal components (as many as there are shown parameters) of log M; not centred, so
    that d = 0 is the closed bite. Its basis is chosen by the incisal velocity: d2 and d3 move the incisal point purely
    sideways and forward at first order, d1 along the mean opening direction of the take.

    Args:
        data: the training data.
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
    curves = [straight(directions[:, i], tuple(limits[i])) for i in range(3)]
    model = AdditiveModel((curves[0], curves[1], curves[2]), data.incisor, limits)
    return PcaFit(model, np.ones(len(data), dtype=bool), singular)


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
        # Along the habitual path: what goes with a millimetre of opening on average over the take.
        d = to_mm @ np.linalg.lstsq(basis, twists.T, rcond=None)[0]
        habit = (d * weights) @ d[0] / ((weights * d[0]) @ d[0])
        directions[:, 0] = directions[:, shown] @ habit
    return directions
