"""Numbers of the nearest cells against scipy's feature transform, ties included."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from jawusd.meshes.spreading import spread


@pytest.mark.parametrize("share", [0.002, 0.02, 0.3, 0.9])
def test_every_cell_takes_the_number_that_scipy_finds(share):
    rng = np.random.default_rng(int(1000 * share))
    for shape in ((23, 9, 31), (1, 14, 6), (12, 1, 1), (17, 17, 17)):
        numbers = np.where(rng.random(shape) < share, np.arange(np.prod(shape)).reshape(shape), -1).astype(np.int32)
        numbers.flat[rng.integers(numbers.size)] = 7
        nearest = distance_transform_edt(numbers < 0, return_distances=False, return_indices=True)
        expected = numbers[tuple(nearest)]
        away = spread(numbers)
        np.testing.assert_array_equal(numbers, expected)
        np.testing.assert_array_equal(away, ((nearest - np.indices(shape)) ** 2).sum(axis=0))


def test_without_any_numbers_everything_is_farther_than_the_grid_is_wide():
    numbers = np.full((4, 5, 6), -1, np.int32)
    assert (spread(numbers) > 3**2 + 4**2 + 5**2).all() and (numbers == -1).all()
