"""The registration error of scans and the constant error of a take, from closed-bite frames."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from jawusd.formats.tracks import TRACKED
from jawusd.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log
from jawusd.tracking.contour.equations import OutlineSums, Solution, translation
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.sequence.closed_bite import (
    _ARCH_MM,
    _BITE_MM,
    _NEW_PER_FRAME,
    STEADY,
    RestFrames,
    closed_bite,
    registration_findings,
    registration_unknown,
    rest_frames,
)

POINT = np.array([3.0, -4.0, 20.0])
REST = RestFrames(dict.fromkeys(range(4), 1.0), True, POINT, POINT + (0, -5, 0), False)
FRAMES = np.arange(12)
SIGMA = np.r_[np.full(3, 0.002), np.full(3, 0.04)]  # sigma of a pose about the point [rad, mm]


def _take(registration=None, steady=((0,) * 6, (0,) * 6), seed=0):
    """Return poses and covariances of a jaw that rests in four frames and then opens."""
    rng = np.random.default_rng(seed)
    there, back = translation(POINT), translation(-POINT)
    opening = [np.zeros(6)] * 4 + [np.array([0.03 * k, 0, 0, 0, -0.8 * k, 0.1]) for k in range(1, 9)]
    poses, covariance = np.empty((12, 2, 4, 4)), np.empty((12, 2, 6, 6))
    moved = np.eye(4) if registration is None else there @ se3_exp(np.asarray(registration, float)) @ back
    for k, twist in enumerate(opening):
        head = se3_exp(np.r_[rng.normal(size=3) * 0.2, rng.normal(size=3) * 5]) @ translation([10, 20, 200])
        true = head, head @ there @ se3_exp(twist) @ back @ moved
        for r in (0, 1):
            poses[k, r] = true[r] @ there @ se3_exp(np.asarray(steady[r], float)) @ back
            A = se3_adjoint(poses[k, r] @ there)
            covariance[k, r] = A @ np.diag(SIGMA**2) @ A.T
    return poses, covariance


def _parts(covariance):
    """Return covariances by outlines of single frames and by habits."""
    return 0.3 * covariance, 0.7 * covariance


def test_with_a_good_registration_the_constant_error_is_removed():
    steady = (0, 0, 0, 0, 0.05, 0), (0, 0, 0, 0, -0.05, 0)
    poses, covariance = _take(steady=steady)
    bite = closed_bite(FRAMES, poses, *_parts(covariance), REST)
    exact, _ = _take()
    before, after = (
        np.abs(se3_log(se3_inverse(T[:, 1] @ translation(POINT)) @ exact[:, 1] @ translation(POINT))[:, 4]).max()
        for T in (poses, bite.correct(poses, False))
    )
    assert before == pytest.approx(0.05, rel=1e-6)
    assert after < 0.4 * before
    assert np.linalg.norm(bite.registration[3:]) < 0.03
    assert not registration_findings(bite.report(REST))


@pytest.mark.parametrize(
    ("mm", "degrees"),
    [((0, 1, 0), (0, 0, 0)), ((0.6, 0, -0.8), (0, 0, 0)), ((0, 0, 0), (0, 3, 0)), ((1, 0, 0), (3, 0, 0))],
)
def test_a_bad_registration_is_measured_and_corrected(mm, degrees):
    wrong = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    scan = np.eye(4)
    scan[:3, :3], scan[:3, 3] = wrong, np.array(mm) + REST.lower - wrong @ REST.lower  # the lower scan as it was given
    poses, covariance = _take()
    poses[:, 1] = poses[:, 1] @ se3_inverse(scan)
    bite = closed_bite(FRAMES, poses, *_parts(covariance), REST)
    report = bite.report(REST)
    assert np.linalg.norm(report["shift_mm"]) == pytest.approx(np.linalg.norm(mm), rel=0.2, abs=0.05)
    assert np.linalg.norm(report["turn_deg"]) == pytest.approx(np.linalg.norm(degrees), rel=0.2, abs=0.05)
    (finding,) = registration_findings(report)
    assert finding.severity == "warning" and "mm" in finding.message and "degrees" in finding.message
    relative = se3_inverse(bite.correct(poses, True)[:4, 0]) @ bite.correct(poses, True)[:4, 1]
    left = relative @ np.append(REST.lower, 1.0) - np.append(REST.lower, 1.0)
    assert np.linalg.norm(left, axis=1).max() < 0.1
    assert np.degrees(np.linalg.norm(se3_log(relative)[:, :3], axis=1)).max() < 0.3
    (note,) = registration_findings({**report, "applied": True})
    assert note.severity == "note"


def test_what_remains_is_the_conditional_covariance():
    """Sample constant errors, registration and noise; the residual covariance of a linear regression must match."""
    poses, covariance = _take()
    bite = closed_bite(FRAMES, poses, *_parts(covariance), REST)
    upper, lower, both = bite.spread
    registration = np.diag(np.r_[np.full(3, (_BITE_MM / _ARCH_MM) ** 2), np.full(3, _BITE_MM**2)])
    outline = 0.3 / (0.7 + 0.3 * STEADY) * both  # `both` is the steady part of outline and habits
    noise = (1.0 - STEADY) * outline / (1.0 + 3 * _NEW_PER_FRAME)  # four closed frames
    rng = np.random.default_rng(1)
    u, v, r, n = (
        multivariate_normal(np.zeros(6), c, seed=rng).rvs(100_000) for c in (upper, lower, registration, noise)
    )
    seen = v - u + r + n
    scale = np.sqrt(np.diag(both))
    for error, remaining in zip((u, v, v - u), bite.remaining, strict=True):
        left = error - seen @ np.linalg.lstsq(seen, error, rcond=None)[0]
        assert np.cov(left.T) / np.outer(scale, scale) == pytest.approx(remaining / np.outer(scale, scale), abs=0.01)


def test_the_closed_bite_reduces_covariances():
    poses, covariance = _take()
    bite = closed_bite(FRAMES, poses, *_parts(covariance), REST)
    A = se3_adjoint(translation(POINT))
    steady = np.tile(A @ bite.spread[2] @ A.T, (12, 1, 1))
    noise = np.diag(SIGMA**2)
    reduced = bite.reduce(steady + noise, steady, np.tile(np.eye(4), (12, 1, 1)), 2)
    expected = noise + A @ bite.remaining[2] @ A.T
    assert reduced[0] == pytest.approx(expected, abs=1e-9 * np.abs(expected).max())


def _records(poses):
    nothing = (
        OutlineSums.zeros(2),
        np.zeros((2, 3)),
        np.zeros((2, 6, 6)),
        np.zeros((2, 6, 6)),
        np.zeros((2, 2)),
    )
    status, used = np.full(2, TRACKED, np.int8), np.ones((2, 2), bool)
    return {k: FrameRecord(Solution(p, *nothing), status, used, np.zeros((2, 2))) for k, p in enumerate(poses)}


def test_rest_frames_are_those_around_the_named_one_or_the_most_closed():
    poses, _ = _take()
    up, probes = np.array([0.0, 1.0, 0.0]), POINT + np.random.default_rng(2).normal(size=(30, 3)) * 10
    for named in (1, None):
        found = rest_frames(_records(poses), named, up, POINT, probes)
        assert list(found) == [0, 1, 2, 3] and min(found.values()) > 0.99
    assert rest_frames(_records(poses), 99, up, POINT, probes) == {}


def test_the_weight_of_a_rest_frame_falls_to_zero_with_its_motion():
    poses, _ = _take()
    up, probes = np.array([0.0, 1.0, 0.0]), POINT + np.random.default_rng(2).normal(size=(30, 3)) * 10
    weights = []
    for moved_mm in np.linspace(0, 0.13, 14):
        poses[3, 1] = poses[3, 0] @ translation([0, -moved_mm, 0])
        weights.append(rest_frames(_records(poses), 1, up, POINT, probes).get(3, 0.0))
    assert weights[0] > 0.99 and weights[-1] == 0
    assert (np.diff(weights) <= 0).all() and np.diff(weights).min() > -0.2


def test_a_frame_at_the_limit_of_rest_does_not_change_the_result():
    poses, covariance = _take(steady=((0,) * 6, (0, 0, 0, 0, -0.1, 0)))
    poses[3, 1] = poses[3, 1] @ translation([0, -0.12, 0])
    with_it, without = (
        closed_bite(FRAMES, poses, *_parts(covariance), replace(REST, weights={0: 1.0, 1: 0.8} | more))
        for more in ({3: 1e-6}, {})
    )
    assert np.abs(with_it.steady - without.steady).max() < 1e-6


def test_one_frame_with_closed_teeth_is_enough():
    poses, covariance = _take(steady=((0,) * 6, (0, 0, 0, 0, -0.1, 0)))
    bite = closed_bite(FRAMES, poses, *_parts(covariance), replace(REST, weights={1: 1.0}))
    assert bite.frames == (1,)
    assert bite.steady[1, 4] == pytest.approx(-0.05, abs=0.02)


@pytest.mark.parametrize(("named", "words"), [(True, "rest_frame is not tracked"), (False, "no frame shows")])
def test_a_take_without_a_closed_bite_has_a_note(named, words):
    found = registration_unknown(RestFrames({}, named, POINT, POINT, False))
    assert found.kind == "registration_unknown" and found.severity == "note" and words in found.message


def test_without_rest_frames_there_is_no_result():
    poses, covariance = _take()
    poses[:4] = np.nan
    assert closed_bite(FRAMES, poses, *_parts(covariance), REST) is None
