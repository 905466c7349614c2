"""Scan preparation: crown-gum line, edge table, colours."""

import numpy as np
import pytest
import trimesh
from bumpy_teeth import GREY, RED, arch, jaw_poses, make_cameras, render_masks, vertex_error_mm
from scipy.spatial import cKDTree

from jawusd.base.errors import TrackingError
from jawusd.formats.mesh import Mesh
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.gingival_margin import crown_gum_segments
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import View


def _painted(parts):
    """Join trimesh parts with colours into one Mesh."""
    starts = np.cumsum([0, *(len(p.vertices) for p, _ in parts)])
    return Mesh(
        np.concatenate([p.vertices for p, _ in parts]),
        np.concatenate([p.faces + s for (p, _), s in zip(parts, starts)]),
        np.concatenate([np.tile(c, (len(p.vertices), 1)) for p, c in parts]).astype(np.uint8),
    )


def test_crown_gum_line_of_ball_and_plate_is_a_circle():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=5.0)
    plate = trimesh.creation.box((20.0, 0.0, 20.0)).subdivide().subdivide()
    plate.apply_translation([0.0, 3.0, 0.013])
    vertices = np.concatenate([ball.vertices, plate.vertices])
    segments, directions = crown_gum_segments(
        vertices, ball.faces.astype(np.int32), (plate.faces + len(ball.vertices)).astype(np.int32)
    )
    assert np.allclose(segments[..., 1], 3.0, atol=1e-9)
    radius = np.linalg.norm(segments[..., [0, 2]], axis=-1)
    assert abs(radius - 4.0).max() < 0.02
    # The ball's surface crosses the circle along its meridians.
    along = segments[:, 1] - segments[:, 0]
    middle = segments.mean(1)
    assert np.abs(np.einsum("si,si->s", directions, along) / np.linalg.norm(along, axis=1)).max() < 1e-9
    assert np.abs(np.einsum("si,si->s", directions, middle) / np.linalg.norm(middle, axis=1)).max() < 0.05
    # The plate is a flat box: top and bottom lie in one plane, so every piece is found twice.
    total = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum()
    assert total == pytest.approx(2 * 2 * np.pi * 4.0, rel=0.01)


def test_crown_gum_line_agrees_with_a_brute_force_search():
    rng = np.random.default_rng(5)
    # No two triangles share a corner, since rounding decides whether touching triangles intersect.
    vertices = rng.normal(size=(165, 3)) * 3
    crown, gum = np.split(np.arange(165, dtype=np.int32).reshape(-1, 3), [25])
    segments, directions = crown_gum_segments(vertices, crown, gum)
    count = 0
    for a in vertices[crown]:
        for b in vertices[gum]:
            ends = _crossings(a, b) + _crossings(b, a)
            count += len(ends) >= 2 and max(np.linalg.norm(p - ends[0]) for p in ends) > 1e-3
    assert len(segments) == count > 20


def _crossings(a, b):
    """Return where the sides of triangle a pass through triangle b, by solving for the barycentric coordinates."""
    out = []
    for k in range(3):
        p, q = a[k], a[(k + 1) % 3]
        system = np.column_stack([q - p, b[0] - b[1], b[0] - b[2]])
        if abs(np.linalg.det(system)) < 1e-12:
            continue
        t, u, v = np.linalg.solve(system, b[0] - p)
        if 0 <= t <= 1 and u >= 0 and v >= 0 and u + v <= 1:
            out.append(p + t * (q - p))
    return out


def test_no_line_without_gum_or_without_contact():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=5.0)
    far = ball.copy().apply_translation([30.0, 0, 0])
    assert prepare_scan(_painted([(ball, RED)]), "upper").gingival_margin.shape == (0, 2, 3)
    assert prepare_scan(_painted([(ball, RED), (far, GREY)]), "upper").gingival_margin.shape == (0, 2, 3)


def test_edge_table_agrees_with_trimesh():
    mesh = arch(True)
    scan = prepare_scan(mesh, "upper")
    assert scan.painted
    crown = trimesh.Trimesh(scan.vertices, scan.crown_faces, process=False)
    assert len(scan.edges) == len(crown.edges_unique)
    inner = scan.edges[scan.edges[:, 3] >= 0]
    assert (inner[:, 2] != inner[:, 3]).all()
    expected = {tuple(sorted(pair)) for pair in crown.face_adjacency.tolist()}
    assert {tuple(sorted(pair)) for pair in inner[:, 2:].tolist()} == expected
    for edge in scan.edges[::97]:
        assert set(edge[:2]) <= set(scan.crown_faces[edge[2]])


def test_open_mesh_has_border_edges():
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=5.0)
    cap = Mesh(sphere.vertices, sphere.faces[sphere.triangles_center[:, 1] > 0])
    scan = prepare_scan(cap, "lower")
    outline = trimesh.Trimesh(scan.vertices, scan.crown_faces, process=False).outline()
    assert (scan.edges[:, 3] < 0).sum() == sum(len(e.points) - 1 for e in outline.entities)


def test_triangle_soup_is_welded():
    mesh = arch(False)
    soup = Mesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3))
    scan = prepare_scan(soup, "lower")
    assert len(scan.vertices) == len(np.unique(mesh.vertices, axis=0))
    assert not scan.painted and len(scan.gum_faces) == 0


def test_colours_that_are_not_labels_count_as_crown():
    mesh = arch(True)
    ivory = np.tile([230, 215, 190], (len(mesh.vertices), 1)).astype(np.uint8)
    scan = prepare_scan(Mesh(mesh.vertices, mesh.faces, ivory), "upper")
    assert not scan.painted and len(scan.crown_faces) == len(mesh.faces)


def test_green_counts_as_crown():
    mesh = arch(True)
    colors = mesh.colors.copy()
    colors[: len(colors) // 3] = [40, 190, 60]
    assert len(prepare_scan(Mesh(mesh.vertices, mesh.faces, colors), "upper").crown_faces) == len(
        prepare_scan(mesh, "upper").crown_faces
    )


def test_scan_with_too_few_faces_is_refused():
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    with pytest.raises(TrackingError, match="upper teeth scan has 12 tooth faces; at least 100"):
        prepare_scan(Mesh(box.vertices, box.faces), "upper")


@pytest.fixture(scope="module")
def dense():
    """The same arch with faces as small as those of intra-oral scanners."""
    mesh = arch(True)
    vertices, faces, colors = np.asarray(mesh.vertices), np.asarray(mesh.faces), np.asarray(mesh.colors, float)
    for _ in range(3):
        vertices, faces, attributes = trimesh.remesh.subdivide(vertices, faces, vertex_attributes={"c": colors})
        colors = attributes["c"]
    red = np.linalg.norm(colors - RED, axis=1) < np.linalg.norm(colors - GREY, axis=1)
    return Mesh(vertices, faces, np.where(red[:, None], RED, GREY).astype(np.uint8))


def test_dense_scans_are_thinned_without_changing_shape_or_centre(dense):
    scan = prepare_scan(dense, "upper")
    thin = scan.thin
    assert len(scan.crown_faces) > 60_000 and 0.8 * 20_000 < len(thin.crown_faces) < 1.2 * 20_000
    np.testing.assert_array_equal(thin.centre, scan.centre)
    spacing_mm = np.linalg.norm(scan.vertices[scan.crown_faces[:, 0]] - scan.vertices[scan.crown_faces[:, 1]], axis=1)
    away_mm = cKDTree(scan.vertices).query(thin.vertices)[0]
    assert np.percentile(away_mm, 99) < spacing_mm.max() / 2
    assert thin.thin is None and prepare_scan(arch(True), "upper").thin is None


def test_a_dense_scan_aligns_like_the_plain_one(dense):
    config, poses, camera = TrackingConfig(), jaw_poses(2), make_cameras()
    meshes = (arch(True), arch(False))
    plain = [prepare_scan(mesh, name) for mesh, name in zip(meshes, ("upper", "lower"))]
    views = [
        View(c.projection_matrix(), c.centre_world(), render_masks(meshes, poses[1], c, (7.5, -16.0)), np.ones(2, bool))
        for c in camera
    ]
    gates = config.gates_from(0.0)
    first = ContourSolver(plain, config).solve(poses[0], views, gates)
    second = ContourSolver([prepare_scan(dense, "upper"), plain[1]], config).solve(poses[0], views, gates)
    assert vertex_error_mm(meshes[0], second.poses[0], first.poses[0]) < 0.01
    assert vertex_error_mm(meshes[1], second.poses[1], first.poses[1]) < 0.01
