"""Motion carried to another person turns in the frames the source turns in, and stays inside the bound."""

import numpy as np
import pytest
from example_people import person
from scipy.optimize import lsq_linear

from jawusd.library.timing import follow
from jawusd.pipeline.library import retarget


@pytest.mark.parametrize("seed", range(12))
def test_the_nearest_curve_is_that_of_scipy(seed):
    rng = np.random.default_rng(seed)
    count = rng.integers(1, 40)
    original = np.cumsum(rng.normal(size=count))
    carried = rng.uniform(0.3, 2, count) * original + rng.normal(size=count)
    # The same problem in other unknowns: the first value, and the steps in the direction of the original's.
    sums = np.tril(np.ones((count, count)))
    sums[:, 1:] *= np.sign(np.diff(original))
    least = np.concatenate([[-np.inf], 0.1 * np.abs(np.diff(original))])
    found = lsq_linear(sums, carried, bounds=(least, np.full(count, np.inf)), method="bvls", tol=1e-12)
    np.testing.assert_allclose(follow(original, carried, 0.1), sums @ found.x, atol=1e-9)


def test_where_the_original_rests_a_curve_is_free():
    original = np.array([0.0, 1, 1, 1, 0])
    carried = np.array([0.0, 2, 3, 1, 0])
    np.testing.assert_allclose(follow(original, carried, 0.1), carried, atol=1e-12)


def turns(curve):
    """Frames in which a curve turns."""
    steps = np.sign(np.diff(curve))
    return np.flatnonzero(steps[:-1] * steps[1:] < 0) + 1


@pytest.fixture(scope="module")
def pair():
    """Two persons; the second's sideways range falls with the opening, from the first's to a fifth."""
    narrowing = person("narrowing")
    arrays = {name: np.array(value) for name, value in narrowing.arrays.items()}
    fall = np.linspace(1.0, 0.2, len(arrays["slice_d1"]))
    arrays["slice_support"] = arrays["slice_support"] * fall[:, None]
    return person("even"), type(narrowing)(arrays, narrowing.meta)


def test_peaks_stay_in_their_frames_where_shares_alone_move_them(pair):
    frames = np.arange(121.0)
    s = frames / 120
    opening = 15 + 10 * np.sin(10 * np.pi * s + 1)
    d = np.stack([opening, 3 * np.sin(6 * np.pi * s), 0.4 + 0.3 * np.cos(8 * np.pi * s)], axis=1)
    source, target = pair
    shares_alone = target.denormalized(source.normalized(d))
    assert not np.array_equal(turns(shares_alone[:, 1]), turns(d[:, 1]))
    carried = retarget(source, target, frames, d)
    assert target.validate_parameters(carried.d).valid.all()
    for axis in range(3):
        np.testing.assert_array_equal(turns(carried.d[:, axis]), turns(d[:, axis]))
    assert carried.moved_mm.mean() < 0.1
    np.testing.assert_allclose(np.linalg.norm(carried.d - shares_alone, axis=1), carried.moved_mm)


def test_a_motion_that_leaves_the_bound_comes_back_in_and_keeps_its_peaks(pair):
    frames = np.arange(60.0)
    s = frames / 59
    source, target = pair
    _, reach, _, _ = source.ranges(12.0)
    d = np.stack([12 + 4 * np.sin(2 * np.pi * s), 1.2 * reach * np.sin(5 * np.pi * s), np.zeros(60)], axis=1)
    carried = retarget(source, target, frames, d)
    assert carried.outside.sum() > 3 and carried.moved_mm[carried.outside].max() > 0.2
    assert target.validate_parameters(carried.d).valid.all()


def test_to_oneself_nothing_is_changed(pair):
    frames = np.arange(50.0)
    d = np.stack([10 + 8 * np.sin(frames / 5), 2 * np.sin(frames / 3), 0.5 + 0.3 * np.sin(frames / 7)], axis=1)
    carried = retarget(pair[0], pair[0], frames, d)
    np.testing.assert_allclose(carried.d, d, atol=1e-9)
