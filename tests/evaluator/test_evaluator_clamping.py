"""Motions brought inside the bound: inside between samples, without pops, otherwise as they were."""

import numpy as np
import pytest
import shapely
from example_model import example_arrays, example_meta
from key_sets import hollow_rig, measured, random_keys
from scipy.interpolate import CubicHermiteSpline

from jawusd.base.errors import EvaluatorError
from jawusd.evaluator import JawRig

ARRAYS = example_arrays()
RIG = JawRig(ARRAYS, example_meta())


def section(d1, depth):
    """The section of the bound at an opening as a polygon, rounded corners left out: the soft one lies inside it."""
    knots, support = ARRAYS["slice_d1"], ARRAYS["slice_support"]
    slopes = np.zeros_like(support)
    slopes[1:-1] = (support[2:] - support[:-2]) / (knots[2:] - knots[:-2])[:, None]
    reach = CubicHermiteSpline(knots, support, slopes)(d1) + float(ARRAYS["slice_margin_mm"]) - depth
    shape = shapely.box(-50, -50, 50, 50)
    for (x, y), h in zip(ARRAYS["slice_directions"], reach):
        far = np.array([[h * x - 200 * y, h * y + 200 * x], [h * x + 200 * y, h * y - 200 * x]])
        back = far[::-1] - 400 * np.array([x, y])
        shape = shape.intersection(shapely.Polygon(np.concatenate([far, back])))
    return shape


def test_sideways_past_the_bound_stops_there_without_a_pop():
    """The keys (20, 6, 0) and (20, 11, 0): opening and protrusion stay, no step is longer, the end is the bound."""
    frames = np.arange(101.0)
    wanted = RIG.interpolate([0.0, 100.0], [[20.0, 6.0, 0.0], [20.0, 11.0, 0.0]], frames)
    kept = RIG.keep_inside(frames, wanted)
    assert kept.given.all()  # a straight line to the bound needs no further sample
    step = np.linalg.norm(np.diff(kept.d, axis=0), axis=1)
    assert step.max() <= 0.05 * 1.05 and (np.diff(kept.d[:, 1]) >= -1e-9).all()
    assert (kept.d[:, [0, 2]] == [20.0, 0.0]).all()
    clear = [section(20.0, 0.3).contains(shapely.Point(d[1:])) for d in wanted]
    assert 5 < sum(clear) < 90
    np.testing.assert_array_equal(kept.d[clear], wanted[clear])
    edge = section(20.0, 0.0).boundary
    assert edge.distance(shapely.Point(kept.d[-1, 1:])) < 0.3  # softness
    assert section(20.0, 0.0).contains(shapely.Point(kept.d[-1, 1:])) and RIG.margin(kept.d[-1]) == pytest.approx(0.01)


def test_what_is_inside_stays_bit_by_bit():
    rng = np.random.default_rng(0)
    keys = RIG.project(rng.uniform([2, -4, -1], [38, 4, 3], (30, 3)))
    times = np.cumsum(rng.uniform(0.5, 3, 30))
    kept = RIG.keep_inside(times, keys)
    np.testing.assert_array_equal(kept.times, times)
    np.testing.assert_array_equal(kept.d, keys)
    alone = RIG.keep_inside([3.0], keys[:1])
    np.testing.assert_array_equal(alone.d, keys[:1])


@pytest.mark.parametrize("rig", [RIG, hollow_rig()], ids=["example", "hollow"])
@pytest.mark.parametrize("method", ["linear", "smooth"])
@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_random_keys(rig, method, spread):
    sets = [measured(rig, *random_keys(rig, seed, spread), method) for seed in range(12)]
    for found in sets:
        assert found.ratio <= 1.05 and found.local_ratio <= 1.05 and found.margin_mm >= -1e-8
        assert found.overshoot_mm <= 0.1 or found.forced
    assert np.mean([found.overshoot_mm > 0.05 for found in sets]) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("rig", [RIG, hollow_rig()], ids=["example", "hollow"])
def test_one_pose_is_brought_where_it_would_stay(rig):
    """As a motion that stands still there, inside, and in small steps for small steps."""
    low, high = rig.d_range.T
    start, end = np.random.default_rng(2).uniform(low - 4, high + 4, (2, 12, 3))
    ways = start[:, None] + np.linspace(0, 1, 401)[:, None] * (end - start)[:, None]
    for way in ways[:5:2]:  # projected, two of the hollow rig's would jump by 6 mm and more
        found = np.array([rig.keep_inside([0.0], [d]).d[0] for d in way])
        assert rig.is_inside(found).all()
        np.testing.assert_array_equal(found[rig.is_inside(way)], way[rig.is_inside(way)])
        still = np.array([rig.keep_inside([0.0, 1.0], [d, d]).d[0] for d in way[::40]])
        np.testing.assert_allclose(found[::40], still, atol=2e-3)
        assert np.linalg.norm(np.diff(found, axis=0), axis=1).max() < 0.6


def test_projecting_frame_by_frame_pops():
    """What the bound's own nearest points would do to the same keys: the guard above can fail."""
    rig, worst = hollow_rig(), []
    for seed in range(12):
        frames, keys = random_keys(rig, seed, 0.3)
        at = np.arange(frames[0], frames[-1] + 1)
        wanted = rig.interpolate(frames, keys, at)
        steps = [np.linalg.norm(np.diff(d, axis=0), axis=1).max() for d in (rig.project(wanted), wanted)]
        worst.append(steps[0] / steps[1])
    assert max(worst) > 2


def test_a_way_round_takes_its_time_from_before_and_after():
    """Between keys that see each other only through a waist, the ends give way by little; holds stay holds."""
    rig = hollow_rig()
    keys = rig.project(np.array([[8.0, 5.0, 0.5], [8.0, 5.0, 0.5], [32.0, 3.5, 0.5], [32.0, 3.5, 0.5]]))
    frames = np.arange(0.0, 61.0)
    wanted = rig.interpolate([0.0, 20.0, 40.0, 60.0], keys, frames)
    kept = rig.keep_inside(frames, wanted)
    d = kept.d[kept.given]
    assert rig.margin(wanted).min() < -1.0
    assert np.abs(np.diff(d[:20], axis=0)).max() < 1e-9 and np.abs(np.diff(d[41:], axis=0)).max() < 1e-9
    moved = np.linalg.norm(d - wanted, axis=1)
    assert moved[[0, -1]].max() < 1.0 and len(kept.times) > len(frames)


def test_far_away_and_empty():
    far = RIG.keep_inside([0.0, 1.0, 2.0], [[1e6, -1e6, 1e6], [20.0, 0.0, 0.0], [-1e6, 1e6, 0.0]])
    assert RIG.is_inside(far.d).all()
    with pytest.raises(ValueError, match="finite"):
        RIG.keep_inside([0.0], [[np.nan, 0, 0]])
    nothing = JawRig(ARRAYS | {"slice_margin_mm": np.array(-30.0)}, example_meta())
    with pytest.raises(EvaluatorError, match="bound of the rig is empty"):
        nothing.keep_inside([0.0], [[20.0, 0, 0]])
