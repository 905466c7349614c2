"""Surfaces with every fault at once become manifolds of the same shape."""

import numpy as np
import pytest
import trimesh

from jawusd.formats.mesh import Mesh
from jawusd.meshes.remeshing import manifold


def checked(mesh):
    """Return the cleaned mesh after asking trimesh whether it is a manifold."""
    out = manifold(mesh)
    surface = trimesh.Trimesh(out.vertices, out.faces, process=False)
    assert surface.is_winding_consistent
    assert np.unique(surface.edges_sorted, axis=0, return_counts=True)[1].max() <= 2
    assert len(np.unique(out.vertices, axis=0)) == len(out.vertices)
    return surface


def test_a_clean_surface_keeps_its_shape():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=20.0)
    out = checked(Mesh(ball.vertices, ball.faces))
    assert out.is_watertight and out.volume == pytest.approx(ball.volume, rel=1e-12)


def test_a_soup_of_triangles_is_merged():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=20.0)
    soup = ball.vertices[ball.faces].reshape(-1, 3)
    out = checked(Mesh(soup, np.arange(len(soup)).reshape(-1, 3)))
    assert out.is_watertight and len(out.vertices) == len(ball.vertices)


def test_faces_turned_over_are_turned_back():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=20.0)
    faces = ball.faces.copy()
    faces[::7] = faces[::7, ::-1]
    assert abs(checked(Mesh(ball.vertices, faces)).volume) == pytest.approx(ball.volume, rel=1e-12)


def test_a_fin_on_an_edge_and_a_repeated_face_go():
    box = trimesh.creation.box((10, 10, 10))
    a, b = box.edges[0]
    vertices = np.concatenate([box.vertices, [1.1 * box.vertices[[a, b]].mean(0)]])
    faces = np.concatenate([box.faces, [[a, b, 8]], box.faces[:1], [[3, 3, 4]]])
    out = checked(Mesh(vertices, faces))
    assert out.is_watertight and abs(out.volume) == pytest.approx(1000.0)


def test_cones_that_touch_at_their_tips_come_apart():
    cone = trimesh.creation.cone(radius=5.0, height=10.0)
    other = cone.copy()
    other.apply_transform(np.diag([1.0, 1.0, -1.0, 1.0]))
    other.apply_translation([0, 0, 20.0])
    faces = np.concatenate([cone.faces, other.faces + len(cone.vertices)])
    out = checked(Mesh(np.concatenate([cone.vertices, other.vertices]), faces))
    assert out.body_count == 2 and len(out.vertices) == 2 * len(cone.vertices)
    np.testing.assert_allclose(np.abs(out.volume), 2 * cone.volume, rtol=1e-3)
