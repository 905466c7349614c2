"""Final poses from colours are the most likely ones given measurement and model."""

from dataclasses import replace

import numpy as np
import pytest
from example_rig import example_rig
from example_tracks import make_tracks
from scipy.optimize import minimize

from jawusd.geometry import se3_exp, se3_inverse, se3_log, transform_points
from jawusd.tracking.sequence.model_refinement import KinematicPrior, weigh_with_model

COUNT = 60
OFF_MM = 0.1  # distance of the true motion from the model


@pytest.fixture(scope="module")
def truth():
    rig, t, rng = example_rig(), np.arange(COUNT), np.random.default_rng(4)
    d = np.column_stack([9.0 + 6.0 * np.sin(0.3 * t), 1.2 * np.sin(0.25 * t), 0.6 + 0.5 * np.cos(0.2 * t)])
    off = se3_exp(rng.normal(size=(COUNT, 6)) * ([OFF_MM / 60] * 3 + [OFF_MM] * 3))
    return off @ rig.pose(d)


def measured(truth, sigma_mm, arm_mm):
    """Return tracks with errors about the incisal point; rotation errors have a lever arm in mm."""
    rng, point = np.random.default_rng(5), example_rig().landmarks[0]
    about = np.eye(6)
    about[3:, :3] = -np.cross(np.eye(3), point).T  # a rotation about the incisal point moves the origin
    root = about @ np.diag([sigma_mm / arm_mm] * 3 + [sigma_mm] * 3)
    poses = se3_exp(rng.normal(size=(COUNT, 6)) @ root.T) @ truth
    poses[2] = np.nan
    covariance = np.tile(root @ root.T, (COUNT, 1, 1))
    tracks = make_tracks(COUNT)
    lower = tracks.T_world_upper @ poses
    return replace(
        tracks,
        covariance_relative=covariance,
        **dict.fromkeys(("T_upper_lower", "raw_T_upper_lower"), poses),
        **dict.fromkeys(("T_world_lower", "raw_T_world_lower"), lower),
    )


def off_mm(poses, truth):
    landmarks, known = example_rig().landmarks, np.isfinite(poses).all((1, 2))
    away = transform_points(poses[known], landmarks) - transform_points(truth[known], landmarks)
    return np.linalg.norm(away, axis=-1).mean(0)


def test_condyles_improve_and_the_incisal_point_stays(truth):
    tracks = measured(truth, 0.1, 10.0)
    weighed = weigh_with_model(tracks, example_rig())
    before, after = off_mm(tracks.T_upper_lower, truth), off_mm(weighed.T_upper_lower, truth)
    assert after[3:].max() < 0.6 * before[3:].min() and after[0] < 1.1 * before[0]
    np.testing.assert_array_equal(weighed.raw_T_upper_lower, tracks.raw_T_upper_lower)
    np.testing.assert_array_equal(weighed.T_world_upper, tracks.T_world_upper)
    np.testing.assert_allclose(weighed.T_world_lower, weighed.T_world_upper @ weighed.T_upper_lower, atol=1e-12)
    assert np.isnan(weighed.T_upper_lower[2]).all() and not weighed.prior_aided.any()
    assert 0.5 * OFF_MM < weighed.meta["prior_spread_mm"] < 10 * OFF_MM


def test_poses_measured_well_stay(truth):
    tracks = measured(truth, 0.002, 60.0)
    weighed = weigh_with_model(tracks, example_rig())
    assert np.nanmax(np.abs(weighed.T_upper_lower - tracks.T_upper_lower)) < 0.002


def test_the_most_likely_pose_is_found(truth):
    tracks, rig = measured(truth, 0.1, 10.0), example_rig()
    weighed = weigh_with_model(tracks, rig)
    prior = KinematicPrior(rig, weighed.meta["prior_spread_mm"])
    information = np.linalg.inv(tracks.covariance_relative[7])

    def cost(twist):
        pose = se3_exp(twist / scale) @ tracks.T_upper_lower[7]
        away, (deviation, precision) = twist / scale, prior.deviation(pose)
        return away @ information @ away + deviation @ precision @ deviation

    scale = np.array([60.0] * 3 + [1.0] * 3)
    best = minimize(cost, np.zeros(6), method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-9, "maxiter": 8000})
    found = se3_log(weighed.T_upper_lower[7] @ se3_inverse(tracks.T_upper_lower[7]))
    assert cost(found * scale) < cost(np.zeros(6)) - 0.5 and cost(found * scale) < best.fun + 0.01


def test_too_few_poses_leave_tracks_unchanged(truth):
    tracks = measured(truth, 0.1, 10.0)
    few = tracks.T_upper_lower.copy()
    few[10:] = np.nan
    tracks = replace(tracks, raw_T_upper_lower=few)
    assert weigh_with_model(tracks, example_rig()) is tracks
