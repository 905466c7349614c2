"""Points of a shape are found in a copy that is moved, scaled, shuffled and has points twice."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jawusd.geometry.points import match_points


def shape(seed, count=400):
    return np.random.default_rng(seed).normal(size=(count, 3)) * [30, 20, 9]


def copied(points, seed, size=0.001, noise=0.0):
    """Return a shuffled copy with a third of the points twice, and of each place the point of the shape it is."""
    rng = np.random.default_rng(seed)
    of = rng.permutation(np.concatenate([np.arange(len(points)), np.arange(0, len(points), 3)]))
    moved = size * (points + noise * rng.normal(size=points.shape)) @ Rotation.random(rng=rng).as_matrix().T
    return (moved + size * rng.normal(size=3) * 100)[of], of


@pytest.mark.parametrize("seed", range(8))
def test_every_chosen_point_is_found(seed):
    points = shape(seed)
    chosen = np.arange(0, len(points), 7)
    moved, of = copied(points, seed, noise=1e-5)
    found = match_points(points, moved, chosen, 0.02)
    np.testing.assert_array_equal(of[found], chosen)


def test_another_shape_or_a_mirrored_one_is_none():
    points, chosen = shape(1), np.arange(50)
    assert match_points(points, copied(shape(2), 1)[0], chosen, 0.02) is None
    assert match_points(points, copied(points * [1, 1, -1], 1)[0], chosen, 0.02) is None
    assert match_points(points, copied(points, 1)[0][:300], chosen, 0.02) is None
    assert match_points(points, copied(points, 1, noise=0.5)[0], chosen, 0.02) is None


def test_of_a_symmetric_shape_the_order_tells():
    half = np.abs(shape(3, 60))
    points = np.concatenate([half * signs for signs in ([1, 1, 1], [-1, -1, 1], [1, -1, -1], [-1, 1, -1])])
    split = np.sort(np.concatenate([np.arange(len(points)), np.arange(0, len(points), 5)]))
    moved = (points @ Rotation.from_rotvec([0.3, 0.2, 1.0]).as_matrix().T)[split]
    chosen = np.arange(len(points))
    np.testing.assert_array_equal(split[match_points(points, moved, chosen, 0.02)], chosen)
