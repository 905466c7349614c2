"""Points at the same place."""

import numpy as np
import pytest

from jawusd.geometry.points import welded


@pytest.mark.parametrize("count", [0, 1, 500])
def test_places_are_those_that_numpy_finds(count):
    points = np.random.default_rng(3).integers(-2, 3, (count, 3)) / 3.0
    places, index = welded(points)
    expected, inverse = np.unique(points, axis=0, return_inverse=True)
    np.testing.assert_array_equal(places, expected)
    np.testing.assert_array_equal(index, inverse.reshape(-1))


def test_points_that_differ_in_the_last_bit_stay_apart():
    points = np.array([[1.0, 2.0, 3.0], [1.0, 2.0, np.nextafter(3.0, 4.0)], [1.0, 2.0, 3.0], [0.0, 9.0, 9.0]])
    places, index = welded(points)
    assert len(places) == 3 and index.tolist() == [1, 2, 1, 0]
