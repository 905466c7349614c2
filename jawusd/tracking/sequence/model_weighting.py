"""Poses of colours weighed against the fitted model: where they tell little, the jaw's own motion tells more.

Borders of colours hold the incisal point as well as masks do, but molars and condyles less, as their errors reach over
whole teeth. With the model, condyles of seven mouths were off by 0.22 to 0.59 mm in place of 0.30 to 1.13, molars by
0.11 to 0.16 in place of 0.12 to 0.27, and incisal points by as much as before (-0.014 to +0.005 mm).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.formats.tracks import Tracks, TracksMeta
from jawusd.geometry import orthonormalise, se3_exp, se3_inverse, se3_log
from jawusd.tracking.sequence.kinematic_prior import KinematicPrior

_FEWEST = 15  # poses, below which a model says nothing of its own spread
_ROUNDS = 3  # the model bends little over what poses are off


def weigh_with_model(tracks: Tracks, jaw: JawRig) -> Tracks:
    """Return tracks whose final relative poses are the likeliest by their covariance and by the model.

    The mean of two Gaussians, linearised again `_ROUNDS` times, with the prior of Zoss et al. 2018 as `KinematicPrior`
    has it, its width being the rms distance of all raw poses from the model. The upper teeth stay; raw poses,
    covariances and sigmas are as measured. `prior_spread_mm` in the meta data holds the width.

    Args:
        tracks: of colours, without a model.
        jaw: the model fitted to them.
    """
    known = np.isfinite(tracks.raw_T_upper_lower).all((1, 2)) & np.isfinite(tracks.T_upper_lower).all((1, 2))
    known &= np.isfinite(tracks.covariance_relative).all((1, 2))
    if known.sum() < _FEWEST:
        return tracks
    distance_mm = jaw.encode(tracks.raw_T_upper_lower[known])[1]
    spread_mm = float(np.sqrt(np.mean(distance_mm**2)))
    prior = KinematicPrior(jaw, spread_mm)
    relative, lower = tracks.T_upper_lower.copy(), tracks.T_world_lower.copy()
    for k in np.flatnonzero(known).tolist():
        relative[k] = _likeliest(relative[k], tracks.covariance_relative[k], prior)
        lower[k] = tracks.T_world_upper[k] @ relative[k]
    meta: TracksMeta = {**tracks.meta, "prior_spread_mm": spread_mm}
    return replace(tracks, T_upper_lower=relative, T_world_lower=lower, meta=meta)


def _likeliest(measured: Array, covariance: Array, prior: KinematicPrior) -> Array:
    """Return the likeliest T_upper_lower (4, 4) by a measured one, the covariance of its left twist, and the model."""
    information, pose = np.linalg.inv(covariance), measured
    for _ in range(_ROUNDS):
        deviation, precision = prior.deviation(pose)
        away = se3_log(pose @ se3_inverse(measured))
        step = np.linalg.solve(information + precision, precision @ deviation + information @ away)
        pose = orthonormalise(se3_exp(-step) @ pose)
    return pose
