"""The anatomical frame of a made-up dental arch, in any scan frame."""

import numpy as np
import pytest

from jawusd.geometry import (
    anatomical_frame,
    find_landmarks,
    landmark_frame,
    make_transform,
    mandible_metric,
    random_rotation,
    se3_exp,
    transform_points,
)


def arch(height_mm, width_mm, seed, side_gap=0.0):
    """A horseshoe of points with uneven density between left and right."""
    rng = np.random.default_rng(seed)
    x = np.concatenate([rng.uniform(-1, 0, 3000), rng.uniform(0, 1, 5000)]) * width_mm
    z = -45 * (x / width_mm) ** 2 + rng.uniform(-4, 0, 8000)
    y = height_mm + rng.uniform(0, 8, 8000) * np.sign(height_mm)
    return np.stack([x, y, z], -1)


UPPER, LOWER = arch(0.5, 30, 0), arch(-0.5, 28, 1)


def test_frame_follows_the_scans_wherever_they_lie():
    base = anatomical_frame(UPPER, LOWER)
    np.testing.assert_allclose(base[:3, :3], np.eye(3), atol=0.03)
    rng = np.random.default_rng(2)
    for _ in range(5):
        G = make_transform(random_rotation(rng), rng.normal(size=3) * 80)
        moved = anatomical_frame(transform_points(G, UPPER), transform_points(G, LOWER))
        np.testing.assert_allclose(moved @ G, base, atol=1e-3)


def test_swapped_jaws_turn_the_frame_upside_down():
    """The guard behind 'swapped jaws': up must come from the scans' order, not from their axes."""
    swapped = anatomical_frame(LOWER, UPPER)
    assert swapped[1, 1] < -0.9


def mandible(condyle):
    rng = np.random.default_rng(3)
    sides = []
    for s in (1, -1):
        head = condyle * [s, 1, 1] + rng.uniform(-1, 1, (400, 3)) * [9, 4, 4] - [0, 4, 0]
        coronoid = np.array([s * 45.0, condyle[1] + 2, condyle[2] + 28]) + rng.uniform(-2, 2, (200, 3))
        body = np.stack([s * rng.uniform(5, 45, 500), rng.uniform(-40, -20, 500), rng.uniform(-60, 0, 500)], -1)
        sides += [head, coronoid, body]
    return np.concatenate(sides)


def test_landmarks_are_found_on_the_mandible_not_on_the_coronoid():
    condyle = np.array([50.0, 35.0, -80.0])
    A = anatomical_frame(UPPER, LOWER)
    found = find_landmarks(LOWER, mandible(condyle), A)
    np.testing.assert_allclose(found[3], condyle + [0, -4, 0], atol=2.5)
    np.testing.assert_allclose(found[4], condyle * [-1, 1, 1] + [0, -4, 0], atol=2.5)
    assert found[1, 0] > 10 and found[2, 0] < -10
    np.testing.assert_allclose(found[0], [0, -0.5, -2], atol=2.0)


def test_without_a_mandible_the_condyles_stand_at_mean_adult_places():
    A = anatomical_frame(UPPER, LOWER)
    found = transform_points(A, find_landmarks(LOWER, None, A))
    width = found[1, 0] - found[2, 0]
    assert np.linalg.norm(found[3] - found[4]) == pytest.approx(99.6 + 0.6 * (width - 44), abs=1e-9)
    assert np.linalg.norm(found[3] - found[0]) == pytest.approx(103.3, abs=1e-9)


def test_landmarks_alone_give_the_frame_wherever_they_lie():
    at_home = np.array([[0.0, 0, 0], [22, 0, -26], [-22, 0, -26], [50, 36, -80], [-50, 36, -80]])
    np.testing.assert_allclose(landmark_frame(at_home), np.eye(4), atol=1e-12)
    moved = se3_exp([0.5, -1.2, 2.0, 30, -80, 15.0])
    np.testing.assert_allclose(landmark_frame(transform_points(moved, at_home)) @ moved, np.eye(4), atol=1e-9)


def test_metric_measures_mean_squared_displacement():
    p = mandible(np.array([50.0, 35.0, -80.0]))
    xi = np.random.default_rng(4).normal(size=6) * [1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4]
    moved = transform_points(se3_exp(xi), p) - p
    assert xi @ mandible_metric(p) @ xi == pytest.approx((moved**2).sum(1).mean(), rel=1e-4)
