"""Smoothing over time."""

import numpy as np
import pytest
from scipy.optimize import minimize

from jawusd.geometry import rigidity_defect, se3_exp, se3_inverse, se3_log
from jawusd.tracking.sequence.smoothing import smooth_poses


def _motion(count, rng, noise):
    t = np.arange(count)[:, None]
    speed = np.array([0.02, 0.01, 0.03, 1.0, 2.0, 0.5])
    truth = se3_exp(speed * np.sin(t / 15 + np.arange(6)))
    sigma = np.array([0.001, 0.001, 0.001, 0.05, 0.05, 0.05]) * noise
    measured = se3_exp(rng.normal(size=(count, 6)) * sigma) @ truth
    return truth, measured, np.tile(np.diag(sigma**2), (count, 1, 1))


def _distance(a, b):
    return np.linalg.norm((a - b)[:, :3, 3], axis=1)


def test_noise_is_reduced_for_uniform_motion():
    truth, measured, covariance = _motion(200, np.random.default_rng(0), 1.0)
    smooth = smooth_poses(np.arange(200), measured, covariance, np.zeros(3))
    assert rigidity_defect(smooth).max() < 1e-12
    assert _distance(smooth, truth).mean() < 0.85 * _distance(measured, truth).mean()


def test_uncertain_frames_follow_their_neighbours():
    truth, measured, covariance = _motion(60, np.random.default_rng(1), 0.2)
    measured[30] = se3_exp([0, 0, 0, 0.5, 0, 0]) @ measured[30]
    covariance[30, 3:, 3:] *= 50.0**2
    smooth = smooth_poses(np.arange(60), measured, covariance, np.zeros(3))
    assert _distance(measured, truth)[30] > 0.4 and _distance(smooth, truth)[30] < 0.12


def test_sudden_stop_stays_sudden():
    rng = np.random.default_rng(2)
    y = np.minimum(np.arange(80), 40) * 1.0
    truth = se3_exp(np.column_stack([np.zeros((80, 4)), y, np.zeros(80)]))
    sigma = np.array([0.0005] * 3 + [0.04] * 3)
    measured = se3_exp(rng.normal(size=(80, 6)) * sigma) @ truth
    smooth = smooth_poses(np.arange(80), measured, np.tile(np.diag(sigma**2), (80, 1, 1)), np.zeros(3))
    assert _distance(smooth, truth)[38:43].max() < 0.15


def test_gaps_and_short_runs_stay_as_they_are():
    _, measured, covariance = _motion(40, np.random.default_rng(3), 1.0)
    frames = np.r_[np.arange(20), np.arange(30, 50)]
    measured[[4, 9]] = np.nan
    smooth = smooth_poses(frames, measured, covariance, np.zeros(3))
    assert np.isnan(smooth[[4, 9]]).all() and np.isfinite(np.delete(smooth, [4, 9], 0)).all()
    assert (smooth[:4] == measured[:4]).all() and (smooth[5:9] == measured[5:9]).all()
    assert (smooth[10:] != measured[10:]).any((1, 2)).all()
    # A jump between runs is not motion: each run is smoothed separately.
    alone = smooth_poses(frames[20:], measured[20:], covariance[20:], np.zeros(3))
    assert np.allclose(alone, smooth[20:])


def test_the_result_minimises_the_objective():
    rng = np.random.default_rng(4)
    _, measured, covariance = _motion(7, rng, 1.0)
    centre = np.array([3.0, -5.0, 200.0])
    smooth = smooth_poses(np.arange(7), measured, covariance, centre)
    shift = np.eye(4)
    shift[:3, 3] = -centre
    local, done = shift @ measured @ se3_inverse(shift), shift @ smooth @ se3_inverse(shift)
    x = se3_log(done @ se3_inverse(local))
    adjoint = np.eye(6)
    adjoint[3:, :3] = [[0, centre[2], -centre[1]], [-centre[2], 0, centre[0]], [centre[1], -centre[0], 0]]
    C = adjoint @ covariance @ adjoint.T
    steps = se3_log(local[1:] @ se3_inverse(local[:-1]))
    bend = np.diff(steps, axis=0)
    var = np.einsum("nii->ni", C)
    noise = var[:-2] + 4 * var[1:-1] + var[2:]
    padded = np.pad(bend**2 - noise, ((4, 4), (0, 0)), mode="edge")
    lively = np.stack([padded[k : k + 9].mean(0) for k in range(5)])
    Q = np.maximum(lively, 0.5 * noise)

    def cost(flat):
        z = flat.reshape(7, 6)
        a = bend + z[2:] - 2 * z[1:-1] + z[:-2]
        return np.einsum("ni,nij,nj->", z, np.linalg.inv(C), z) + (a * a / Q).sum()

    best = minimize(cost, np.zeros(42), method="BFGS", options={"gtol": 1e-8})
    assert cost(x.ravel()) == pytest.approx(best.fun, rel=1e-6)
