"""Rays against triangles, against the linear equations that say the same."""

import numpy as np

from jawusd.geometry.points import meet_triangles


def test_lines_meet_planes_where_linear_equations_say():
    rng = np.random.default_rng(3)
    corners, origin, direction = rng.normal(size=(50, 3, 3)), rng.normal(size=3), 2.5 * rng.normal(size=3)
    u, v, along = meet_triangles(origin, direction, corners)
    for k, (a, b, c) in enumerate(corners):
        expected = np.linalg.solve(np.stack([b - a, c - a, -direction], axis=1), origin - a)
        np.testing.assert_allclose([u[k], v[k], along[k]], expected, rtol=1e-9, atol=1e-9)


def test_a_line_along_a_triangle_is_no_hit_ahead():
    u, v, along = meet_triangles(np.array([0.0, 0, 1]), np.array([1.0, 0, 0]), np.eye(3)[None] * [1, 1, 0])
    assert (u, v, along) == (0, 0, 0)
