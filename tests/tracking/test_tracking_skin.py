"""The factor of facial skin against dense algebra, and takes with skin alone."""

import numpy as np
import pytest
import small_take
from example_model import LANDMARKS_ANATOMICAL, example_arrays, example_meta

from jawusd.evaluator import JawRig
from jawusd.evaluator.skin import SkinJaw
from jawusd.formats.performance import SolveState
from jawusd.formats.tracks import LOST, load_tracks, save_tracks
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.performance import skin as module
from jawusd.tracking.performance.results import tracks_of
from jawusd.tracking.performance.shot import solve_by_skin
from jawusd.tracking.performance.skin import SkinFactor, SkinFilter
from jawusd.tracking.performance.system import TakeSystem

FPS = 25.0


def spread(rng, count):
    """Return random covariances (count, 3, 3)."""
    A = rng.normal(size=(count, 3, 4))
    return A @ np.swapaxes(A, 1, 2) / 4


def slow_error(count, fps):
    """Return correlations (count, count) of the slow error, and the share and the enlargement of the variances."""
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    return np.exp(-apart / (module._SLOW_S * fps)), module._SHARE, max(1.0, module._FAST_S * fps)


@pytest.mark.parametrize("count", [1, 2, 9])
@pytest.mark.parametrize("wider", [1.0, 2.25])
def test_the_factor_is_a_measurement_with_slow_and_fast_errors(count, wider):
    """The posterior of d with a prior in each frame, by the covariance of all measurements."""
    rng = np.random.default_rng(count)
    C, prior, measured = spread(rng, count), spread(rng, count), rng.normal(size=(count, 3))
    known = np.arange(count) != 4
    factor = SkinFactor(SkinJaw(np.where(known[:, None], measured, np.nan), C, known), FPS, wider)
    system = TakeSystem(count, 6, 2)
    for k in range(count):
        precision = np.zeros((8, 8))
        precision[:3, :3] = wider * np.linalg.inv(prior[k])
        system.add_frame(k, precision, np.zeros(8))
    system.add_shared(np.ones(2), np.zeros(2))
    d, slow = rng.normal(size=(2, count, 3))  # the solution does not depend on where it starts
    for k in range(count):
        right = np.zeros(8)
        right[:3] = -wider * np.linalg.inv(prior[k]) @ d[k]
        system.add_frame(k, np.zeros((8, 8)), right)
    factor.add(system, d, slow, 0)
    found = d + system.solve()[0][:, :3]
    covariance = wider * system.covariance().own[:, :3, :3]

    alike, share, enlarged = slow_error(count, FPS)
    L = np.linalg.cholesky(C)
    error = share * np.einsum("kl,kab,lcb->kalc", alike, L, L)
    own, P = np.zeros_like(error), np.zeros_like(error)
    for k in range(count):
        own[k, :, k] = (1 - share) * enlarged * C[k]
        P[k, :, k] = prior[k]
    rows = np.repeat(known, 3)
    P, S = P.reshape(3 * count, -1), (error + own).reshape(3 * count, -1)
    gain = P[:, rows] @ np.linalg.inv((P + S)[np.ix_(rows, rows)])
    np.testing.assert_allclose(found.ravel(), gain @ measured.ravel()[rows], atol=1e-9)
    posterior = P - gain @ P[rows]
    for k in range(count):
        np.testing.assert_allclose(covariance[k], posterior[3 * k :, 3 * k :][:3, :3], atol=1e-9)


def test_the_filter_finds_what_the_factor_finds_in_the_last_frame():
    """Frames of different priors, one without a face."""
    rng, count = np.random.default_rng(3), 7
    C, prior, measured, d = spread(rng, count), spread(rng, count), *rng.normal(size=(2, count, 3))
    known = np.arange(count) != 3
    by_skin = SkinJaw(np.where(known[:, None], measured, np.nan), C, known)
    factor, system = SkinFactor(by_skin, FPS), TakeSystem(count, 6, 0)
    slow = SkinFilter()
    for k in range(count):
        precision = np.zeros((6, 6))
        precision[:3, :3] = np.linalg.inv(prior[k])
        system.add_frame(k, precision, np.zeros(6))
        one = SkinJaw(*(part[k] for part in by_skin))
        found, covariance, used = slow.fuse(one, d[k], prior[k], seen=True, seconds=1 / FPS)
        assert used == known[k]
    factor.add(system, d, np.zeros((count, 3)), 0)
    np.testing.assert_allclose(found, (d + system.solve()[0][:, :3])[-1], atol=1e-9)
    np.testing.assert_allclose(covariance, system.covariance().own[-1, :3, :3], atol=1e-9)


def test_a_predicted_jaw_does_not_correct_the_slow_error():
    one = SkinJaw(np.array([2.0, 0, 0]), 0.5 * np.eye(3), np.array(True))
    zero, sure = np.zeros(3), 1e-4 * np.eye(3)
    seen, predicted = SkinFilter(), SkinFilter()
    seen.fuse(one, zero, sure, seen=True, seconds=0.04)
    predicted.fuse(one, zero, sure, seen=False, seconds=0.04)
    unknown = 100.0 * np.eye(3)
    corrected, covariance, _ = seen.fuse(one, zero, unknown, seen=False, seconds=0.04)
    as_told, wider, _ = predicted.fuse(one, zero, unknown, seen=False, seconds=0.04)
    assert corrected[0] < 0.8 < 1.95 < as_told[0]
    assert covariance[0, 0] < 0.7 * wider[0, 0]


@pytest.fixture(scope="module")
def jaw():
    same = {"T_anatomical_skull": np.eye(4), "T_rest": np.eye(4), "landmarks": LANDMARKS_ANATOMICAL}
    return JawRig({**example_arrays(), **same}, example_meta())


def test_skin_alone_is_solved_and_stored(jaw, tmp_path):
    """Errors are drawn from the model, so that sigma must be honest; the head is the world."""
    rng, count = np.random.default_rng(5), 240
    t = np.arange(count)
    true = np.column_stack([9 + 4 * np.sin(0.2 * t), 1.2 * np.sin(0.17 * t), 0.6 + 0.5 * np.cos(0.2 * t)])
    C = np.diag([0.6, 0.3, 0.3]) ** 2
    alike, share, enlarged = slow_error(count, FPS)
    slow = np.linalg.cholesky(alike + 1e-9 * np.eye(count)) @ rng.normal(size=(count, 3))
    fast = np.sqrt(1 - share) * rng.normal(size=(count, 3))
    measured = true + (np.sqrt(share) * slow + fast) @ np.sqrt(C)
    familiar = (t < 100) | (t > 104)
    measured[~familiar] = np.nan
    scans = tuple(prepare_scan(mesh, row) for mesh, row in zip(small_take.MESHES, small_take.ROWS))
    by_skin = SkinJaw(measured, np.tile(C, (count, 1, 1)), familiar)
    found = solve_by_skin(jaw, scans, lambda frames, d, seen, heads: by_skin, range(7, 7 + count), FPS)
    assert found.frames[0] == 7 and found.camera_names == ()
    np.testing.assert_array_equal(found.state == SolveState.SKIN, familiar)
    np.testing.assert_array_equal(found.state == SolveState.CARRIED, ~familiar)
    away, noisy = found.d - true, measured[familiar] - true[familiar]
    assert np.sqrt((away[familiar] ** 2).mean()) < np.sqrt((noisy**2).mean())
    assert 0.4 < (away**2 / found.sigma_d**2).mean() < 1.6
    save_tracks(tmp_path / "take.npz", tracks_of(found, jaw))
    tracks = load_tracks(tmp_path / "take.npz")
    np.testing.assert_array_equal(tracks.solved.state, found.state)
    np.testing.assert_array_equal(tracks.T_world_upper, np.broadcast_to(np.eye(4), (count, 4, 4)))
    assert (tracks.status == LOST).all() and not tracks.covariance_upper.any()
    np.testing.assert_allclose(tracks.T_world_lower, jaw.pose(found.d), atol=1e-9)
