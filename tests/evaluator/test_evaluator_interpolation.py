"""Interpolation between keys: straight, smooth, and never outside the bound."""

import numpy as np
import pytest
from example_model import example_arrays, example_meta
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator, interp1d

from jawusd.evaluator import JawRig

ARRAYS = example_arrays()
RIG = JawRig(ARRAYS, example_meta())


def keys_inside(count, seed, spread=1.0):
    rng = np.random.default_rng(seed)
    d = RIG.project(rng.uniform([-6, -14, -6], [50, 14, 12], (count, 3)) * spread)
    return np.cumsum(rng.uniform(2.0, 9.0, count)), d


def test_linear_is_scipys_and_holds_outside():
    frames, keys = keys_inside(8, 0)
    at = np.linspace(frames[0] - 5, frames[-1] + 5, 301)
    expected = interp1d(frames, keys, axis=0, bounds_error=False, fill_value=(keys[0], keys[-1]))(at)
    np.testing.assert_allclose(RIG.interpolate(frames, keys, at), expected, atol=1e-12)


@pytest.mark.parametrize("method", ["linear", "smooth"])
def test_keys_are_met_exactly(method):
    frames, keys = keys_inside(9, 1)
    np.testing.assert_allclose(RIG.interpolate(frames, keys, frames, method), keys, atol=1e-12)


@pytest.mark.parametrize("seed", range(8))
def test_smooth_never_leaves_the_bound_between_keys_on_it(seed):
    """Keys on and inside the bound, among them far corners that a plain cubic overshoots."""
    frames, keys = keys_inside(12, seed + 10)
    at = np.linspace(frames[0], frames[-1], 20001)
    assert RIG.margin(RIG.interpolate(frames, keys, at, "smooth")).min() > -1e-8


def test_smooth_is_scipys_monotone_curve():
    """With a hold before the first and after the last key, as the motion starts and stops there."""
    for seed in range(20):
        frames, keys = keys_inside(9, seed, spread=0.1)
        held = np.concatenate([[frames[0] - 1], frames, [frames[-1] + 1]])
        oracle = PchipInterpolator(held, np.concatenate([keys[:1], keys, keys[-1:]]))
        at = np.linspace(frames[0], frames[-1], 1001)
        for inside in (False, True):
            found = RIG.interpolate(frames, keys, at, "smooth", inside=inside)
            np.testing.assert_allclose(found, oracle(at), atol=1e-10)


def test_given_tangents_are_those_of_the_curve_and_others_stay_monotone():
    frames, keys = keys_inside(6, 3, spread=0.5)
    given = np.full((6, 3), np.nan)
    given[2], given[4, 1], given[0, 2] = (0.5, -0.8, 0.0), 0.3, 1.0
    at = np.linspace(frames[0], frames[-1], 2001)
    plain = RIG.interpolate(frames, keys, at, "smooth", inside=False)
    bent = RIG.interpolate(frames, keys, at, "smooth", inside=False, tangents=given)
    for axis in range(3):
        held = np.concatenate([[frames[0] - 1], frames, [frames[-1] + 1]])
        slopes = PchipInterpolator(held, np.pad(keys[:, axis], 1, mode="edge")).derivative()(frames)
        known = np.isfinite(given[:, axis])
        slopes[known] = given[known, axis]
        oracle = CubicHermiteSpline(frames, keys[:, axis], slopes)
        np.testing.assert_allclose(bent[:, axis], oracle(at), atol=1e-9)
    assert np.abs(bent - plain).max() > 0.2
    unbent = RIG.interpolate(frames, keys, at, "smooth", inside=False, tangents=np.full((6, 3), np.nan))
    np.testing.assert_array_equal(unbent, plain)
    lines = RIG.interpolate(frames, keys, at, tangents=given)
    np.testing.assert_array_equal(lines, RIG.interpolate(frames, keys, at))
    inside = RIG.interpolate(frames, keys, at, "smooth", tangents=10 * given)
    assert RIG.margin(inside).min() > -1e-8  # the bound also holds curves with given tangents
    for wrong in (given[:-1], np.where(np.isnan(given), np.inf, given)):
        with pytest.raises(ValueError, match="tangents must have shape"):
            RIG.interpolate(frames, keys, at, "smooth", tangents=wrong)


def test_smooth_holds_and_never_overshoots():
    """The keys of holds and extremes that a curve through points alone leaves by 9.9 mm and by 1 mm."""
    frames, keys = np.array([0.0, 10.0, 30.0, 40.0]), np.zeros((4, 3))
    keys[:, 0] = [0, 20, 20, 5]
    at = np.linspace(0, 40, 4001)
    d = RIG.interpolate(frames, keys, at, "smooth")
    assert d[:, 0].max() == 20.0 and (d[(at >= 10) & (at <= 30), 0] == 20.0).all()
    keys[:, 0] = [10, 0, 0, 15]
    d = RIG.interpolate(frames, keys, at, "smooth")
    assert d[:, 0].min() == 0.0 and not d[:, 1:].any()
    for seed in range(20):
        frames, keys = keys_inside(7, seed)
        keys[2] = keys[3]
        at = np.linspace(frames[0], frames[-1], 3001)
        piece = np.clip(np.searchsorted(frames, at, side="right") - 1, 0, 5)
        low, high = np.minimum(keys[:-1], keys[1:])[piece], np.maximum(keys[:-1], keys[1:])[piece]
        d = RIG.interpolate(frames, keys, at, "smooth", inside=False)
        assert (d >= low - 1e-12).all() and (d <= high + 1e-12).all()


def test_the_bound_is_at_work():
    """Without it some of the keys above lead out by tenths of a millimetre."""
    worst = []
    for seed in range(8):
        frames, keys = keys_inside(12, seed + 10)
        at = np.linspace(frames[0], frames[-1], 2001)
        worst.append(RIG.margin(RIG.interpolate(frames, keys, at, "smooth", inside=False)).min())
    assert min(worst) < -0.2


def test_smooth_survives_a_bound_that_is_hollow_along_d1():
    """Sections with a waist: the straight line between valid keys is not valid, the smooth curve is."""
    waist = 1.0 - 0.85 * np.exp(-(((ARRAYS["slice_d1"] - 20.0) / 5.0) ** 2))
    rig = JawRig(dict(ARRAYS, slice_support=ARRAYS["slice_support"] * waist[:, None]), example_meta())
    keys = np.array([[8.0, 5.0, 0.5], [32.0, 3.5, 0.5], [33.0, -3.0, 0.0], [6.0, -5.0, 1.0]])
    frames = np.array([0.0, 10.0, 15.0, 30.0])
    assert (rig.margin(keys) > 0).all()
    at = np.linspace(0.0, 30.0, 20001)
    assert rig.margin(rig.interpolate(frames, keys, at)).min() < -1.0
    assert rig.margin(rig.interpolate(frames, keys, at, "smooth")).min() > -1e-8


def test_smooth_has_a_continuous_velocity():
    frames, keys = keys_inside(10, 3, spread=0.1)
    assert RIG.margin(RIG.interpolate(frames, keys, np.linspace(frames[0], frames[-1], 2001), "smooth")).min() > 0.05
    at = np.linspace(frames[0] - 1, frames[-1] + 1, 200001)
    d = RIG.interpolate(frames, keys, at, "smooth")
    velocity = np.diff(d, axis=0) / np.diff(at)[:, None]
    linear = np.diff(RIG.interpolate(frames, keys, at), axis=0) / np.diff(at)[:, None]
    jump, linear_jump = (np.abs(np.diff(v, axis=0)).max() for v in (velocity, linear))
    assert jump < 0.01 < linear_jump


def test_keys_outside_are_still_met_smoothly():
    """There is nothing to guard when a key itself is outside: the curve goes through it."""
    frames, keys = np.array([0.0, 5.0, 10.0]), np.array([[5.0, 0, 0], [20.0, 30.0, 0], [5.0, 0, 0]])
    np.testing.assert_allclose(RIG.interpolate(frames, keys, [5.0], "smooth"), keys[1:2], atol=1e-12)


def test_shapes_and_single_keys():
    frames, keys = keys_inside(4, 4)
    for method in ("linear", "smooth"):
        assert RIG.interpolate(frames, keys, 3.0, method).shape == (3,)
        assert RIG.interpolate(frames, keys, np.zeros((2, 0, 3)), method).shape == (2, 0, 3, 3)
        assert np.isnan(RIG.interpolate(frames, keys, [np.nan], method)).all()
        np.testing.assert_array_equal(RIG.interpolate([5.0], keys[:1], [0.0, 9.0], method), np.tile(keys[:1], (2, 1)))


@pytest.mark.parametrize(
    ("frames", "keys", "message"),
    [
        ([0.0, 1.0], np.zeros((3, 3)), "shape"),
        ([], np.zeros((0, 3)), "shape"),
        ([0.0, 0.0], np.zeros((2, 3)), "increase"),
        ([0.0, np.nan], np.zeros((2, 3)), "finite"),
    ],
)
def test_wrong_keys_are_refused(frames, keys, message):
    with pytest.raises(ValueError, match=message):
        RIG.interpolate(frames, keys, [0.0])


def test_unknown_method_is_refused():
    with pytest.raises(ValueError, match='"linear" or "smooth"'):
        RIG.interpolate([0.0], np.zeros((1, 3)), [0.0], method="cubic")
