"""Signed distances and depths of shapes that have them in closed form."""

import numpy as np
import pytest
import trimesh

from jawusd.geometry import se3_inverse, so3_exp, transform_points
from jawusd.meshes.collision import FARTHEST_MM, STEP_MM, Pair, distances, solid, tips_box
from jawusd.meshes.solid import distance_grid, outer_faces

RADIUS = 6.0
DIAGONAL_MM = 3.0**0.5 * STEP_MM  # of a cell: values are linear between its corners


def ball(centre=(0.0, 0.0, 0.0), radius=RADIUS):
    mesh = trimesh.creation.icosphere(4, radius)
    return np.asarray(mesh.triangles) + centre


def shifted(shift):
    T = np.eye(4)
    T[:3, 3] = shift
    return T


def whole(corners, up):
    return solid(corners, up, tips_box(corners, up, 20.0))


def test_depth_of_two_balls_is_their_overlap():
    # the deepest point of a ball of the same size inside another is as deep as both overlap
    pair = Pair(whole(ball(), 1.0), whole(ball(), -1.0))
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(60, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    apart = rng.uniform(2 * RADIUS - 3.0, 2 * RADIUS + 1.0, 60)
    depth = pair.depth(np.array([shifted(a * n) for a, n in zip(apart, directions)]))
    np.testing.assert_allclose(depth, 2 * RADIUS - apart, atol=0.06)


def test_no_point_is_passed_over():
    """Against all points of both surfaces, of rough balls, one pose after the other as unlike as can be."""
    rng = np.random.default_rng(4)
    rough = [ball() * (1.0 + 0.04 * np.sin(5.0 * ball() + phase)) for phase in (0.0, 2.0)]
    pair = Pair(whole(rough[0], 1.0), whole(rough[1], -1.0))
    poses = np.array([shifted(v) for v in rng.normal(0.0, 6.0, (40, 3))])
    poses[:, :3, :3] = [so3_exp(w) for w in rng.normal(0.0, 1.0, (40, 3))]
    every = [
        max(
            -distances(pair.upper.grid, transform_points(T, pair.lower.samples.points)).min(),
            -distances(pair.lower.grid, transform_points(se3_inverse(T), pair.upper.samples.points)).min(),
            -FARTHEST_MM,
        )
        for T in poses
    ]
    np.testing.assert_allclose(pair.depth(poses), every, atol=1e-12)
    assert np.ptp(every) > 5.0


@pytest.mark.parametrize("limit_mm", [-2.0, -0.4, 0.0, 0.7])
def test_what_is_deeper_than_a_limit_is_told_without_its_depth(limit_mm):
    pair = Pair(whole(ball(), 1.0), whole(ball(), -1.0))
    poses = np.array([shifted(v) for v in np.random.default_rng(1).normal(0.0, 7.0, (60, 3))])
    deeper = pair.depth(poses) > limit_mm
    assert (pair.is_deeper(poses, limit_mm) == deeper).all() and deeper.any()
    assert deeper.all() == (limit_mm < -FARTHEST_MM)


def test_surfaces_far_apart_are_as_far_as_can_be_told():
    pair = Pair(whole(ball(), 1.0), whole(ball(), -1.0))
    assert pair.depth(shifted([0.0, -40.0, 0.0])[None]) == -FARTHEST_MM


def test_a_scan_open_above_has_an_inside():
    corners = ball()
    cap = corners[corners[:, :, 1].max(axis=1) < 3.0]  # the upper part is missing, as behind the gum of a scan
    found = whole(cap, 1.0)
    assert found.entering > 0.9
    grid = found.grid
    points = grid.origin + grid.step_mm * np.stack(np.indices(grid.values.shape), axis=-1)
    exact = np.linalg.norm(points, axis=-1) - RADIUS
    below = points[..., 1] < 0.0
    for inside_mm, outside_mm, error_mm in ((0.5, 0.5, 0.01), (2.5, FARTHEST_MM + DIAGONAL_MM, 0.08)):
        low = below & (exact > -inside_mm) & (exact < outside_mm)  # deep, the nearest face is that of a cell nearby
        np.testing.assert_allclose(grid.values[low], exact[low], atol=error_mm)
    far = below & (exact > FARTHEST_MM + DIAGONAL_MM)
    assert (grid.values[far] > FARTHEST_MM + DIAGONAL_MM - 0.01).all() and (grid.values[far] < exact[far] + 0.08).all()


def test_a_surface_that_goes_on_beyond_the_grid_is_not_passed_over():
    """A wall just outside, nearer than any value within the band of its part inside."""
    corners = ball(radius=20.0) * [1.0, 0.05, 1.0]  # a lens 2 mm thick
    box = np.array([[-4.0, 1.9, -4.0], [4.0, 12.0, 4.0]])  # above it: it touches the box in its middle alone
    outer, _ = outer_faces(corners, -1.0)
    grid = distance_grid(corners, outer, box, STEP_MM, -1.0, 1.0)
    points = grid.origin + grid.step_mm * np.stack(np.indices(grid.values.shape), axis=-1)
    shape = trimesh.Trimesh(**trimesh.triangles.to_kwargs(corners))
    some = points.reshape(-1, 3)[::37]
    exact = trimesh.proximity.closest_point_naive(shape, some)[1]
    assert (grid.values.ravel()[::37] < exact + 0.1).all()


def test_distances_deep_inside_a_rough_solid_are_those_to_its_nearest_face():
    """Beyond the values near faces the nearest face has to be found among those of other values."""
    corners = ball()
    corners = corners * (1.0 + 0.15 * np.sin(9.0 * corners / RADIUS).prod(axis=2, keepdims=True))
    grid = whole(corners, 1.0).grid
    points = grid.origin + grid.step_mm * np.stack(np.indices(grid.values.shape), axis=-1)
    deep = (grid.values < -1.0) & (grid.values > -3.0)
    oracle = trimesh.Trimesh(**trimesh.triangles.to_kwargs(corners))
    exact = trimesh.proximity.closest_point_naive(oracle, points[deep][::60])[1]
    excess = -grid.values[deep][::60] - exact
    assert len(exact) > 300 and np.abs(excess).max() < 0.05
    assert (excess > 0.01).mean() < 0.02


def test_faces_inside_other_parts_are_no_surface():
    corners = np.concatenate([ball(), ball((5.0, 0.0, 0.0))])
    outer, entering = outer_faces(corners, 1.0)
    middle = corners.mean(axis=1)
    inside = np.minimum(np.linalg.norm(middle, axis=1), np.linalg.norm(middle - [5.0, 0.0, 0.0], axis=1)) < RADIUS - 0.1
    assert entering > 0.9
    assert outer[~inside].mean() > 0.99
    assert not outer[inside].any()


def test_triangles_wound_the_other_way_are_told():
    assert outer_faces(ball()[:, ::-1], 1.0)[1] < 0.1
    assert outer_faces(ball()[:, ::-1], -1.0)[1] < 0.1


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_depth_grows_with_height_on_either_side(up):
    pair = Pair(whole(ball(), up), whole(ball(), -up))
    heights = np.linspace(10.0, 13.0, 7)
    depth = pair.depth(np.array([shifted([0.0, -up * h, 0.0]) for h in heights]))
    np.testing.assert_allclose(depth, 12.0 - heights, atol=0.05)


def test_a_grid_far_from_every_triangle_has_finite_distances():
    corners = ball()
    far = np.array([[40.0, 40.0, 40.0], [42.0, 43.0, 44.0]])
    grid = distance_grid(corners, np.ones(len(corners), bool), far, STEP_MM, 1.0, 1.0)
    assert np.isfinite(grid.values).all() and grid.values.min() >= 0.0 and grid.values.max() >= 1.0
