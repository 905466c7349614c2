"""Margin, its gradient, ranges and projection, against shapely, differences, SLSQP and brute force."""

import numpy as np
import pytest
import shapely
from example_model import example_arrays, example_meta
from scipy.optimize import minimize as scipy_minimize

from jawusd.base.errors import EvaluatorError
from jawusd.evaluator import JawRig

ARRAYS = example_arrays()
RIG = JawRig(ARRAYS, example_meta())


def points(count, seed=0):
    return np.random.default_rng(seed).uniform([-6, -14, -6], [50, 14, 12], (count, 3))


def formula_margin(d):
    """The margin from its definition, one point at a time, supports interpolated by scipy."""
    from scipy.interpolate import CubicHermiteSpline
    from scipy.special import logsumexp

    knots, support = ARRAYS["slice_d1"], ARRAYS["slice_support"]
    slopes = np.zeros_like(support)
    slopes[1:-1] = (support[2:] - support[:-2]) / (knots[2:] - knots[:-2])[:, None]
    reach = CubicHermiteSpline(knots, support, slopes)(np.clip(d[0], knots[0], knots[-1]))
    v = np.concatenate([ARRAYS["slice_directions"] @ d[1:] - reach, [knots[0] - d[0], d[0] - knots[-1]]])
    soft = ARRAYS["slice_softness_mm"]
    return float(ARRAYS["slice_margin_mm"] - soft * logsumexp(v / soft))


def test_margin_is_its_definition():
    d = points(300)
    np.testing.assert_allclose(RIG.margin(d), [formula_margin(x) for x in d], atol=1e-11)


def test_margin_gradient_agrees_with_differences_and_is_finite_far_away():
    d, h = points(500), 1e-5
    numeric = np.stack([(RIG.margin(d + h * e) - RIG.margin(d - h * e)) / (2 * h) for e in np.eye(3)], axis=-1)
    np.testing.assert_allclose(RIG.margin_gradient(d), numeric, atol=1e-6)
    far = np.random.default_rng(1).normal(size=(1000, 3)) * 1e6
    assert np.isfinite(RIG.margin(far)).all()
    gradient = RIG.margin_gradient(far)
    assert np.isfinite(gradient).all()
    assert (np.linalg.norm(gradient, axis=1) > 0.5).all()


def test_sign_agrees_with_shapely_on_sharp_sections():
    """With the rounding taken away, a section is the polygon of its half-planes: shapely decides the sign."""
    arrays = dict(ARRAYS, slice_softness_mm=np.array(1e-9))
    rig = JawRig(arrays, example_meta())
    rng = np.random.default_rng(2)
    checked = 0
    for index in rng.choice(len(ARRAYS["slice_d1"]), 8, replace=False):
        d1 = ARRAYS["slice_d1"][index]
        polygon = shapely.box(-100, -100, 100, 100)
        for n, h in zip(ARRAYS["slice_directions"], ARRAYS["slice_support"][index] + ARRAYS["slice_margin_mm"]):
            across = np.array([-n[1], n[0]])
            far = [(0, 300), (0, -300), (300, -300), (300, 300)]
            half_plane = shapely.Polygon([n * (h - depth) + across * side for depth, side in far])
            polygon = polygon.intersection(half_plane)
        at = rng.uniform([-12, -6], [12, 10], (12500, 2))
        d = np.column_stack([np.full(len(at), d1), at])
        clear = np.abs(shapely.distance(shapely.points(at), polygon.boundary)) > 1e-6
        # v_low and v_high also bind at the ends: the section is the whole story only well inside the openings
        np.testing.assert_array_equal(
            (rig.margin(d) > 0)[clear], shapely.contains_xy(polygon, at[:, 0], at[:, 1])[clear]
        )
        checked += clear.sum()
    assert checked > 99000


def test_polygon_margin_agrees_with_shapely():
    """Sign and distance of the paper's outlines are shapely's, rings with several parts included."""
    square = np.array([[0.0, -9.0], [20.0, -9.0], [20.0, 9.0], [0.0, 9.0]])
    arrays = dict(
        ARRAYS,
        polygon_d1d2=np.concatenate([square, square + [25.0, 1.0], ARRAYS["polygon_d1d2"] * 0.1 + [60.0, 0.0]]),
        polygon_d1d2_counts=np.array([4, 4, len(ARRAYS["polygon_d1d2"])]),
    )
    rig = JawRig(arrays, example_meta())
    d = points(20000, seed=3)
    parts = np.split(arrays["polygon_d1d2"], np.cumsum(arrays["polygon_d1d2_counts"])[:-1])
    lateral = shapely.MultiPolygon([shapely.Polygon(part) for part in parts])
    protrusion = shapely.Polygon(arrays["polygon_d1d3"])
    expected = []
    for shape, columns in ((lateral, [0, 1]), (protrusion, [0, 2])):
        at = d[:, columns]
        distance = shapely.distance(shapely.points(at), shape.boundary)
        expected.append(np.where(shapely.contains_xy(shape, at[:, 0], at[:, 1]), distance, -distance))
    np.testing.assert_allclose(rig.margin(d, bound="polygons"), np.minimum(*expected), atol=1e-9)


def test_unknown_bound_is_refused():
    with pytest.raises(ValueError, match="slices"):
        RIG.margin([0.0, 0.0, 0.0], bound="hull")


def test_ranges_end_on_the_bound():
    """Each range end has margin 0, its inside is valid and just outside is not; sharp polygons contain them."""
    rng = np.random.default_rng(4)
    d = np.stack([rng.uniform(0, 42, 200), rng.uniform(-2, 2, 200), rng.uniform(-0.5, 1, 200)], axis=1)
    ends = RIG.ranges(*d.T)
    found = np.isfinite(ends[0])
    assert found.mean() > 0.9
    for axis, low, high in ((1, ends[0], ends[1]), (2, ends[2], ends[3])):
        for end, outward in ((low, -1), (high, 1)):
            at = d.copy()
            at[:, axis] = end
            np.testing.assert_allclose(RIG.margin(at)[found], 0.0, atol=1e-9)
            at[:, axis] = end + outward * 1e-3
            assert (RIG.margin(at)[found] < 0).all()
            at[:, axis] = end - outward * 1e-3
            assert (RIG.margin(at)[found] > 0).all()


def test_ranges_are_nan_where_the_section_is_missed():
    low2, high2, low3, high3 = RIG.ranges(20.0, 0.0, 30.0)
    assert np.isnan([low2, high2]).all()
    assert low3 < 0 < high3
    assert np.isnan(RIG.ranges(90.0)).all()


def test_project_keeps_valid_points_and_lands_inside():
    d = points(3000, seed=5)
    projected = RIG.project(d)
    inside = RIG.margin(d) >= 0
    np.testing.assert_array_equal(projected[inside], d[inside])
    assert (RIG.margin(projected) >= -1e-12).all()
    assert inside.any() and not inside.all()


def test_project_is_never_farther_than_the_best_of_1000_boundary_points():
    d = points(300, seed=6)
    d = d[RIG.margin(d) < 0]
    rng = np.random.default_rng(7)
    centre = np.array([18.0, 0.0, 1.0])
    rays = rng.normal(size=(1000, 3)) * [3, 1, 0.6]
    low, high = np.zeros(1000), np.full(1000, 100.0)
    for _ in range(60):
        middle = 0.5 * (low + high)
        inside = RIG.margin(centre + middle[:, None] * rays) >= 0
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    boundary = centre + low[:, None] * rays
    best = np.linalg.norm(d[:, None] - boundary, axis=-1).min(axis=1)
    assert (np.linalg.norm(RIG.project(d) - d, axis=1) <= best + 1e-9).all()


def test_project_agrees_with_slsqp():
    d = points(40, seed=8)
    d = d[RIG.margin(d) < -0.1]
    for start, projected in zip(d, RIG.project(d)):
        constraint = {"type": "ineq", "fun": RIG.margin, "jac": RIG.margin_gradient}
        best = scipy_minimize(
            lambda x, start=start: ((x - start) ** 2).sum(),
            projected + 0.01,
            jac=lambda x, start=start: 2 * (x - start),
            constraints=constraint,
            method="SLSQP",
            options={"ftol": 1e-14, "maxiter": 200},
        )
        assert np.linalg.norm(projected - start) <= np.sqrt(best.fun) + 1e-6


def test_an_empty_bound_is_an_error():
    """Supports that leave no section: nothing to project to, and the rig says so."""
    rig = JawRig(dict(ARRAYS, slice_support=ARRAYS["slice_support"] - 50.0), example_meta())
    with pytest.raises(EvaluatorError, match="no valid jaw parameters"):
        rig.project([10.0, 0.0, 0.0])


def test_normalized_counts_in_ranges_and_comes_back():
    low2, high2, low3, high3 = RIG.ranges(20.0)
    np.testing.assert_allclose(RIG.normalized([20.0, high2, high3]), [20 / 42, 1, 1])
    np.testing.assert_allclose(RIG.normalized([20.0, low2, low3]), [20 / 42, -1, -1])
    d = points(500, seed=9)
    np.testing.assert_allclose(RIG.denormalized(RIG.normalized(d)), d, atol=1e-11)


def test_captured_distance_is_the_distance_to_the_nearest_code():
    d = points(300, seed=10)
    brute = np.linalg.norm(d[:, None] - ARRAYS["codes"], axis=-1).min(axis=1)
    np.testing.assert_allclose(RIG.captured_distance(d), brute, atol=1e-9)
    np.testing.assert_array_equal(RIG.captured_distance(ARRAYS["codes"]), 0.0)
    none = JawRig(dict(ARRAYS, codes=np.empty((0, 3))), example_meta())
    assert none.captured_distance([1.0, 0.0, 0.0]) == np.inf


def test_project_finds_the_nearest_of_several_valleys():
    """Supports that wave along d1 give several local answers; none of 20,000 inner points is nearer than ours."""
    wave = 1.0 + 0.25 * np.cos(ARRAYS["slice_d1"] * 0.9)
    rig = JawRig(dict(ARRAYS, slice_support=ARRAYS["slice_support"] * wave[:, None]), example_meta())
    rng = np.random.default_rng(11)
    inner = rng.uniform([-1, -13, -4], [43, 13, 10], (300_000, 3))
    inner = inner[rig.margin(inner) >= 0]
    assert len(inner) > 20_000
    d = rng.uniform([-8, -25, -12], [52, 25, 20], (150, 3))
    d = d[rig.margin(d) < 0]
    nearest = np.array([np.linalg.norm(inner - x, axis=1).min() for x in d])
    assert (np.linalg.norm(rig.project(d) - d, axis=1) <= nearest + 1e-9).all()


def test_ranges_reach_to_the_ends_of_the_opening():
    """Where the bound has closed already: the section at the last opening on the path that is inside."""
    arrays = ARRAYS | {"d_range": ARRAYS["d_range"] + [[-0.8, 0.8], [0, 0], [0, 0]]}
    rig = JawRig(arrays, example_meta())
    for d1 in rig.d_range[0]:
        assert not rig.is_inside([d1, 0.0, 0.0])
        ends = np.array(rig.ranges(d1))
        assert np.isfinite(ends).all() and (ends[[0, 2]] <= 0).all() and (ends[[1, 3]] >= 0).all()
        opening = np.clip(d1, 0.0, 42.0) + np.sign(d1 - 20) * np.linspace(0, 0.8, 8001)
        last = opening[rig.margin(np.column_stack([opening, 0 * opening, 0 * opening])) >= 0][-1]
        for (axis, side), end in zip(((1, 0), (1, 1), (2, 0), (2, 1)), ends):
            corner = np.array([last, 0.0, 0.0])
            corner[axis] = end
            assert abs(float(rig.margin(corner))) < 1e-3, (d1, axis, side)
    np.testing.assert_array_equal(rig.ranges(20.0), RIG.ranges(20.0))
