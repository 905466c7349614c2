"""Metric, spline, path, gauge and bounds against brute force, scipy and shapely."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from shapely import MultiPoint, Point, Polygon

from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.models import AdditiveModel
from jawusd.fitting import gauge_fit
from jawusd.fitting.additive import straight
from jawusd.fitting.bounds import alpha_shape, fit_slice_hull, valid_box
from jawusd.fitting.gauge_fit import SMALLEST_MINOR, fit_gauge, fit_path, path_gauge, smallest_minor
from jawusd.fitting.metric import MandibleMetric
from jawusd.fitting.spline import SplineBasis, choose_smoothing, farthest_points, ridge_solve, within
from jawusd.geometry import make_transform, se3_exp, transform_points


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(0).normal(size=(400, 3)) * [40, 20, 30] + [0, -20, -40]


def motions(rng, count):
    return se3_exp(rng.normal(size=(count, 6)) * [0.1, 0.1, 0.1, 5, 5, 5])


def distances(a, b, points):
    return np.linalg.norm(transform_points(a, points) - transform_points(b, points), axis=1)


def test_metric_equals_distances_of_all_points(points):
    rng = np.random.default_rng(1)
    metric = MandibleMetric.of_points(points)
    a, b = motions(rng, 70), motions(rng, 70)
    distance = np.stack([distances(s, t, points) for s, t in zip(a, b, strict=True)])
    np.testing.assert_allclose(metric.rms(a, b), np.sqrt((distance**2).mean(1)), rtol=1e-10)
    np.testing.assert_allclose(metric.largest(a, b), distance.max(1), rtol=1e-10)
    assert len(metric.extremes) < len(points)
    least = metric.largest_at_least(a, b)
    assert (least <= distance.max(1) + 1e-9).all() and (least > 0).all()


def test_metric_works_on_points_in_one_plane(points):
    flat = points * [1, 0, 1]
    a, b = motions(np.random.default_rng(2), 3), motions(np.random.default_rng(3), 3)
    expected = [distances(s, t, flat).max() for s, t in zip(a, b, strict=True)]
    np.testing.assert_allclose(MandibleMetric.of_points(flat).largest(a, b), expected)


def test_best_rotation_is_that_of_scipy(points):
    rng = np.random.default_rng(4)
    metric, incisor, target = MandibleMetric.of_points(points), np.array([1.0, -2.0, 3.0]), motions(rng, 5)
    at = rng.normal(size=(5, 3))
    found = metric.best_rotation(target, incisor, at)
    for R, T, where in zip(found, target, at, strict=True):
        expected, _ = Rotation.align_vectors(transform_points(T, points) - where, points - incisor)
        np.testing.assert_allclose(R, expected.as_matrix(), atol=1e-9)


def test_nearest_pose_is_that_of_scipy(points):
    rng = np.random.default_rng(5)
    metric = MandibleMetric.of_points(points)
    ends = np.array([-10.0, 10.0])
    curves = tuple(straight(rng.normal(size=6) * [0.02, 0.02, 0.02, 1, 1, 1], ends) for _ in range(3))
    model = AdditiveModel(curves, np.zeros(3), np.array([[-10.0, 10.0]] * 3))
    target = make_transform(*model.decode(rng.normal(size=(4, 3)) * 3)) @ se3_exp(rng.normal(size=(4, 6)) * 0.01)
    d, motion = metric.nearest(model, target)
    for row, T, M in zip(d, target, motion, strict=True):
        there = transform_points(T, points)

        def displacement(x, there=there):
            return (transform_points(make_transform(*model.decode(x[None]))[0], points) - there).ravel()

        np.testing.assert_allclose(row, least_squares(displacement, row + 0.1, xtol=1e-12).x, atol=1e-5)
        np.testing.assert_allclose(M, make_transform(*model.decode(row[None]))[0])


def test_spline_without_smoothing_is_scipys_cubic_interpolant():
    rng = np.random.default_rng(6)
    q = np.concatenate([np.zeros((1, 3)), rng.normal(size=(40, 3))])
    values = np.sin(q) @ rng.normal(size=(3, 2))
    basis = SplineBasis.on_centres(q)
    columns = basis.columns(q)
    fitted = ridge_solve(columns.T @ columns, columns.T @ values, 1e-12 * np.eye(columns.shape[1]))
    at = rng.normal(size=(30, 3))
    expected = RBFInterpolator(q, values, kernel="cubic", degree=1)(at)
    np.testing.assert_allclose(basis.columns(at) @ fitted, expected, atol=1e-4)


def test_spline_energy_is_positive_and_its_weights_meet_the_side_conditions():
    rng = np.random.default_rng(7)
    basis = SplineBasis.on_centres(rng.normal(size=(30, 3)))
    assert np.linalg.eigvalsh(basis.energy[:-3, :-3]).min() > 0
    weights = basis.weights(rng.normal(size=(len(basis.energy), 2)))
    np.testing.assert_allclose(np.column_stack([np.ones(30), basis.centres]).T @ weights[:30], 0, atol=1e-10)


def test_stiffest_spline_is_a_straight_line():
    rng = np.random.default_rng(8)
    q = rng.normal(size=(50, 3))
    slope = rng.normal(size=(3, 1))
    basis = SplineBasis.on_centres(q[:20])
    columns = basis.columns(q)
    values = q @ slope + 0.1 * np.sin(5 * q[:, :1])
    penalty = 1e8 * basis.energy + 1e-12 * np.eye(len(basis.energy))
    fitted = ridge_solve(columns.T @ columns, columns.T @ values, penalty)
    straight_fit = np.linalg.lstsq(q, values, rcond=None)[0]
    np.testing.assert_allclose(columns @ fitted, q @ straight_fit, atol=1e-5)


def test_farthest_points_spread_and_skip_repeats():
    rng = np.random.default_rng(9)
    cloud = np.repeat(rng.normal(size=(30, 3)), 2, axis=0)
    assert len(farthest_points(cloud, 50)) == 30
    few = farthest_points(cloud, 8)
    assert np.linalg.norm(few[0]) == pytest.approx(np.linalg.norm(cloud, axis=1).min())
    gap = np.linalg.norm(few[:, None] - few[None], axis=-1)[np.triu_indices(8, 1)].min()
    cover = np.linalg.norm(cloud[:, None] - few[None], axis=-1).min(1).max()
    assert cover <= gap  # Gonzalez: no point is farther from the chosen ones than those are from each other


@pytest.mark.parametrize(("wave", "noise", "expected"), [(0.0, 0.3, "stiff"), (3.0, 0.0, "loose")])
def test_cross_validation_smooths_noise_and_keeps_signal(wave, noise, expected):
    rng = np.random.default_rng(10)
    q = rng.normal(size=(200, 3))
    values = q[:, :1] + wave * np.sin(2 * q[:, 1:2]) + noise * rng.normal(size=(200, 1))
    basis = SplineBasis.on_centres(farthest_points(q, 40))
    grid = 10.0 ** np.arange(-6.0, 5.0)
    tail = 1e-9 * np.eye(len(basis.energy))
    folds = np.arange(200) // 20 % 5
    chosen = choose_smoothing(basis.columns(q), values, np.ones(200), basis.energy, tail, grid, folds)
    assert (chosen >= 10) == (expected == "stiff")


def test_trimming_keeps_normal_noise_and_small_residuals():
    rng = np.random.default_rng(11)
    residual = np.abs(rng.normal(size=1000))
    assert within(residual, 6.0, 0.0).all()
    spoiled = np.concatenate([residual, [20.0, 30.0]])
    np.testing.assert_array_equal(np.flatnonzero(~within(spoiled, 6.0, 0.0)), [1000, 1001])
    assert within(spoiled, 6.0, 40.0).all()


def test_path_follows_the_habit_not_the_excursions():
    rng = np.random.default_rng(12)
    opening = rng.uniform(0, 40, 800)
    habit_z = -0.3 * opening - 0.004 * opening**2
    u = np.stack([0.02 * opening, -opening, habit_z], axis=1) + rng.normal(size=(800, 3)) * 0.05
    u[rng.random(800) < 0.3, 2] += 6.0
    gx, gz, _, _ = fit_path(u, np.ones(800)).path(np.linspace(2, 38, 20))
    at = np.linspace(2, 38, 20)
    np.testing.assert_allclose(gx, 0.02 * at, atol=0.1)
    np.testing.assert_allclose(gz, -0.3 * at - 0.004 * at**2, atol=0.25)


def example_gauge(drop=0.4):
    path = path_gauge(np.array([[1.0, 0, 0, 0, 0], [-8.0, -4.0, 0, 0, 0]]), 40.0, (0.0, 40.0))
    arch = np.array([0.5, -0.3, 0, 0, 0, 0, 0])
    return path, replace(path, glide_arch=arch, glide_drop=np.array([drop, drop, 0, 0]))


def test_gauge_is_found_again_from_its_own_displacements():
    path, gauge = example_gauge()
    rng = np.random.default_rng(13)
    d = np.stack([rng.exponential(6.0, 3000).clip(0, 40), rng.uniform(-9, 9, 3000), rng.normal(0, 1.5, 3000)], axis=1)
    d[::3, 0] = 0.0  # gliding with closed teeth
    found = fit_gauge(gauge.displacement(d), np.ones(3000), path, np.ones(3, bool))
    slides = np.array([[0.0, 7, 0], [0, -7, 0], [0, 0, 6.0], [10, 6, 0]])
    np.testing.assert_allclose(found.gauge.displacement(slides), gauge.displacement(slides), atol=0.45)
    assert found.stiffness == 1.0 and found.smallest_minor > SMALLEST_MINOR


def test_folding_gauge_is_noticed():
    box = np.array([[0.0, 40.0], [-9.0, 9.0], [-2.0, 8.0]])
    assert smallest_minor(example_gauge(0.4)[1], box) > SMALLEST_MINOR
    assert smallest_minor(example_gauge(2.5)[1], box) < 0


def test_gauge_is_stiffened_until_it_is_invertible():
    path, gauge = example_gauge(1.7)
    rng = np.random.default_rng(14)
    d = np.stack([rng.uniform(0, 40, 2000), rng.uniform(-9, 9, 2000), rng.uniform(-2, 8, 2000)], axis=1)
    d[::2, 0] = 0.0
    u = gauge.displacement(d)
    found = fit_gauge(u, np.ones(2000), path, np.ones(3, bool))
    assert found.stiffness > 1.0
    back = found.gauge.inverse(u)
    box = np.stack([back.min(0), back.max(0)], axis=1)
    assert smallest_minor(found.gauge, box) >= SMALLEST_MINOR
    np.testing.assert_allclose(found.gauge.displacement(back), u, atol=1e-9)


def test_hopeless_glide_surface_is_given_up():
    path, gauge = example_gauge(0.4)
    rng = np.random.default_rng(15)
    u = gauge.displacement(rng.uniform([0, -9, -2], [40, 9, 8], (600, 3)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gauge_fit, "SMALLEST_MINOR", 0.999999)
        found = fit_gauge(u, np.ones(600), path, np.ones(3, bool))
    assert found.stiffness is None and found.smallest_minor == 1.0
    assert not found.gauge.glide_arch.any() and not found.gauge.glide_drop.any()


def rings(vertices, counts):
    return [Polygon(ring) for ring in np.split(vertices, np.cumsum(counts)[:-1])]


def test_large_alpha_gives_the_convex_hull():
    cloud = np.random.default_rng(16).normal(size=(200, 2)) * [20, 5]
    (shape,) = rings(*alpha_shape(cloud, 1e6))
    assert shape.exterior.is_ccw
    assert shape.area == pytest.approx(MultiPoint(cloud).convex_hull.area)


def test_alpha_shape_is_the_union_of_small_triangles():
    rng = np.random.default_rng(17)
    cloud = rng.uniform(-1, 1, (400, 2))
    cloud = cloud[(cloud[:, 0] < 0) | (cloud[:, 1] < 0)] * [40, 10]  # an L
    low, span = cloud.min(0), np.ptp(cloud, axis=0)
    shapes = rings(*alpha_shape(cloud, 0.12))
    area = sum(shape.area for shape in shapes)
    assert 0.85 < area / (0.75 * span.prod()) < 1.0
    assert not any(shape.contains(Point(low + span * [0.8, 0.8])) for shape in shapes)
    inside = sum(shape.buffer(1e-6).contains(MultiPoint(cloud).geoms[i]) for i in range(0, 200, 10) for shape in shapes)
    assert inside >= 18
    areas = [sum(s.area for s in rings(*alpha_shape(cloud, alpha))) for alpha in (0.05, 0.1, 0.2, 0.4)]
    assert areas == sorted(areas)


def test_alpha_shape_of_separate_clouds_has_several_rings():
    rng = np.random.default_rng(18)
    cloud = np.concatenate([rng.uniform(0, 1, (150, 2)), rng.uniform(0, 1, (100, 2)) * 0.5 + [5, 0]])
    vertices, counts = alpha_shape(cloud, 0.1)
    assert len(counts) == 2 and counts.sum() == len(vertices)


@pytest.mark.parametrize("cloud", [np.c_[np.linspace(0, 40, 50), np.zeros(50)], np.zeros((20, 2))])
def test_alpha_shape_of_a_line_or_a_point_has_an_area(cloud):
    vertices, counts = alpha_shape(cloud, 0.2)
    assert counts.tolist() == [len(vertices)] and len(vertices) >= 3
    assert rings(vertices, counts)[0].area > 0


def envelope(rng, count):
    """Random walks in a shield-shaped volume: sections shrink with opening."""
    d1 = rng.uniform(0, 45, count)
    angle, radius = rng.uniform(0, 2 * np.pi, count), np.sqrt(rng.random(count))
    shrink = 1 - 0.7 * d1 / 45
    return np.stack([d1, 10 * shrink * radius * np.cos(angle), 6 * shrink * radius * np.sin(angle) + 2], axis=1)


def test_slice_hull_contains_the_captured_and_rejects_the_far():
    rng = np.random.default_rng(19)
    arrays, _ = fit_slice_hull(envelope(rng, 1200))
    bound = SliceHull(arrays)
    assert (bound.signed_distance(envelope(rng, 2000)) < 0).mean() > 0.95
    outside = envelope(rng, 2000)
    outside[:, 1:] = (outside[:, 1:] - [0, 2]) / np.linalg.norm((outside[:, 1:] - [0, 2]) / [10, 6], axis=1)[:, None]
    outside[:, 1:] = outside[:, 1:] * 1.5 + [0, 2]
    assert (bound.signed_distance(outside) > 0).mean() > 0.95
    assert bound.signed_distance(np.array([[-2.0, 0, 2]])) > 0  # teeth cannot close further


def test_box_contains_everything_within_the_bound():
    rng = np.random.default_rng(20)
    arrays, _ = fit_slice_hull(envelope(rng, 600))
    box = valid_box(arrays)
    wide = box + np.array([-5.0, 5.0])
    d = wide[:, 0] + (wide[:, 1] - wide[:, 0]) * rng.random((20000, 3))
    d = d[SliceHull(arrays).signed_distance(d) < 0]
    assert len(d) > 500
    assert (d >= box[:, 0]).all() and (d <= box[:, 1]).all()


def test_tolerance_grows_with_what_a_left_out_exercise_adds():
    rng = np.random.default_rng(21)
    alike = envelope(rng, 1000)
    farther = alike.copy()
    blocks = np.arange(1000) // 50 % 5  # of frames held out together
    farther[blocks == 4, 1:] = [0.0, 2.0] + 1.3 * (alike[blocks == 4, 1:] - [0.0, 2.0])
    (_, small), (_, large) = fit_slice_hull(alike), fit_slice_hull(farther)
    assert 0.0 <= small["tolerance_mm"] < large["tolerance_mm"] <= 1.0
    assert small["held_out_p95_mm"] == small["tolerance_mm"] and small["held_out_share"] >= 0.95


def test_share_of_held_out_frames_states_what_the_largest_tolerance_leaves_out():
    rng = np.random.default_rng(21)
    d = envelope(rng, 1000)
    blocks = np.arange(1000) // 50 % 5
    d[blocks == 4, 1:] *= 2.5
    _, found = fit_slice_hull(d)
    hulls = [SliceHull(fit_slice_hull(d[blocks != k])[0]) for k in range(5)]
    beyond_mm = np.concatenate([hull.signed_distance(d[blocks == k]) for k, hull in enumerate(hulls)])
    assert found["tolerance_mm"] == 1.0 and found["held_out_share"] == (beyond_mm <= 1.0).mean() < 0.9
    assert found["held_out_p95_mm"] == pytest.approx(np.quantile(beyond_mm, 0.95)) and found["held_out_p95_mm"] > 1.0


def test_flat_section_still_contains_its_frames():
    d = np.zeros((100, 3))
    d[:, 0] = np.linspace(0, 40, 100)
    assert (SliceHull(fit_slice_hull(d)[0]).signed_distance(d) < 0).all()
