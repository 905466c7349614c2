"""Skin points relative to a head that is known in some frames only."""

import numpy as np
import pytest

from jawusd.base.errors import FittingError
from jawusd.fitting.shot_skin import in_head
from jawusd.geometry import make_transform, so3_exp, transform_points

FRAMES, FIXED, MOVING = 90, 14, 16


@pytest.fixture
def take():
    """Return points in the world and on the head, poses of the head, and the frames in which these are right."""
    rng = np.random.default_rng(3)
    T = make_transform(so3_exp(0.1 * rng.normal(size=(FRAMES, 3))), 5 * rng.normal(size=(FRAMES, 3)))
    rest = rng.uniform([-40, -50, -10], [40, 30, 10], (FIXED + MOVING, 3))
    on_head = np.repeat(rest[None], FRAMES, axis=0)
    on_head[:, FIXED:] += 6 * rng.normal(size=(FRAMES, 1, 3)) * rng.uniform(0.5, 1, (MOVING, 1))
    seen = np.arange(FRAMES) < 60
    points = transform_points(T, on_head) + 0.03 * rng.normal(size=on_head.shape)
    wrong = T.copy()
    wrong[~seen] = np.eye(4)
    return points, on_head, wrong, seen, rng


def test_the_head_is_known_from_points_that_follow_it(take):
    points, on_head, T, seen, rng = take
    points[70, 3] += [4, 0, 0]  # a point that slips
    X = in_head(points, T, seen)
    assert X.shape == on_head.shape
    points[70, 3] = np.nan
    still = np.isfinite(points[..., 0])
    np.testing.assert_allclose(X[still], on_head[still], atol=0.4)
    assert np.abs(X - on_head)[still].mean() < 0.05


def test_points_that_are_missing_stay_so(take):
    points, on_head, T, seen, rng = take
    hidden = rng.random(points.shape[:2]) < 0.1
    points[hidden] = np.nan
    points[80] = np.nan
    X = in_head(points, T, seen)
    np.testing.assert_array_equal(np.isnan(X), np.isnan(points))
    assert np.nanmean(np.abs(X - on_head)) < 0.05


def test_too_few_points_are_refused(take):
    points, _, T, seen, _ = take
    with pytest.raises(FittingError, match="11 points.*at least 12 are needed.*texture"):
        in_head(points[:, : FIXED + 11], T, seen)
    with pytest.raises(FittingError, match="7 points on the skin follow the head.*at least 8.*[Nn]ose and cheeks"):
        in_head(points[:, FIXED - 7 :], T, seen)
    points[:, 0] = np.nan  # never found
    assert in_head(points, T, seen).shape[1] == FIXED + MOVING - 1
