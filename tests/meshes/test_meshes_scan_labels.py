"""Crown and gum told apart by shape: arches of several kinds, dirt, other frames, and scans without gum."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from jawusd.formats.mesh import Mesh, tooth_labels
from jawusd.geometry import so3_exp
from jawusd.media.overlay import COLOURS, label_sheet
from jawusd.meshes.scan_labels import label_scan
from jawusd.meshes.scan_surface import ScanSurface
from jawusd.synthetic.dental_arch import ArchShape, build_arch
from jawusd.synthetic.teeth import LOWER, UPPER


def pieces(upper: bool) -> Mesh:
    """An arch whose crowns dip as closed pieces into a gum of its own, painted."""
    shape = ArchShape(0.017, 2.9e-5, 0.0 if upper else 2.8, np.zeros((2, 7)), 0.0)
    return build_arch(UPPER if upper else LOWER, shape, 0.35, upper, 3).mesh


def bumps(step: float = 0.5) -> tuple[Mesh, np.ndarray]:
    """One surface over a horseshoe: round crowns with steep walls on a gum ridge; and which vertices are crown."""
    x, z = np.meshgrid(np.arange(-34, 34.1, step), np.arange(-48, 6.1, step), indexing="ij")
    angle = np.linspace(-1.15, 1.15, 12)
    centres = np.stack([30 * np.sin(angle) / np.sin(1.15), 44 * np.cos(angle) - 44 + 1.0], 1) * [0.85, 1.0]
    line = np.stack([np.interp(np.linspace(0, 11, 400), np.arange(12), centres[:, k]) for k in (0, 1)], 1)
    flat = np.stack([x.ravel(), z.ravel()], 1)
    away = cKDTree(line).query(flat)[0]
    distance = cKDTree(centres).query(flat)[0]
    ridge = 4.0 * np.exp(-((away / 5.0) ** 2))
    crown = distance < 3.4
    y = ridge + np.where(crown, 6.0 * np.minimum((3.4 - distance) / 1.4, 1.0), 0.0)
    n, m = x.shape
    a = (np.arange(n - 1)[:, None] * m + np.arange(m - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + m], 1), np.stack([a + 1, a + m + 1, a + m], 1)])
    vertices = np.stack([flat[:, 0], y, flat[:, 1]], 1)
    faces = faces[(away < 9.0)[faces].all(1)]
    used, index = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used], index.reshape(-1, 3)), crown[used]


@pytest.mark.parametrize("upper", [True, False])
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (1.1, -2.0, 0.4)])
def test_crowns_that_are_pieces(upper: bool, turn: tuple[float, float, float]) -> None:
    mesh = pieces(upper)
    R = so3_exp(np.array(turn))
    other = R @ (mesh.vertices.mean(0) + [0.0, -9.0 if upper else 9.0, -2.0])
    found = label_scan(Mesh(mesh.vertices @ R.T, mesh.faces), other)
    np.testing.assert_array_equal(found.labels > 0, tooth_labels(mesh) > 0)
    assert found.up @ R @ [0.0, -1.0 if upper else 1.0, 0.0] > 0.97
    assert found.weak_share == 0


def test_natural_colours_tell_what_the_shape_does_not() -> None:
    rng = np.random.default_rng(4)
    mesh, crown = bumps()
    soft = mesh.vertices * [1.0, 0.65, 1.0]  # low crowns
    other = soft.mean(0) + [0.0, 12.0, 0.0]
    shade = rng.normal(1.0, 0.03, (len(crown), 1))
    colors = np.clip(np.where(crown[:, None], (214, 204, 180), (196, 116, 112)) * shade, 0, 255).astype(np.uint8)
    plain = label_scan(Mesh(soft, mesh.faces), other)
    coloured = label_scan(Mesh(soft, mesh.faces, colors), other)
    wrong = [((found.labels > 0) != crown).mean() for found in (plain, coloured)]
    assert wrong[1] < 0.02 < wrong[0]
    assert coloured.weak_share < plain.weak_share
    stone = np.clip(np.array([130, 183, 191]) * shade, 0, 255).astype(np.uint8)  # a cast: no colours to go by
    np.testing.assert_array_equal(label_scan(Mesh(soft, mesh.faces, stone), other).labels, plain.labels)


def test_crowns_alone_are_crown_all_over() -> None:
    mesh = pieces(True)
    teeth = tooth_labels(mesh) > 0
    alone = Mesh(mesh.vertices[teeth], mesh.faces[teeth[mesh.faces].all(1)])
    assert (label_scan(alone, None).labels > 0).all()


@pytest.mark.parametrize("flipped", [False, True])
def test_one_surface_is_cut_along_its_creases(flipped: bool) -> None:
    mesh, crown = bumps()
    faces = mesh.faces[:, ::-1] if flipped else mesh.faces
    found = label_scan(Mesh(mesh.vertices, faces), mesh.vertices.mean(0) + [0.0, 12.0, 0.0])
    assert ((found.labels > 0) != crown).mean() < 0.03
    assert found.weak_share < 0.5


def test_dirt_changes_nothing() -> None:
    mesh, crown = bumps()
    rng = np.random.default_rng(0)
    pick = mesh.faces[rng.integers(len(mesh.faces), size=200)]
    empty = pick.copy()
    empty[:, 2] = empty[:, 0]
    crumb = trimesh.creation.icosphere(subdivisions=1, radius=0.3)
    place = mesh.vertices[np.flatnonzero(~crown)[3000]] + [0.0, 0.4, 0.0]
    vertices = np.concatenate([mesh.vertices, crumb.vertices + place])
    faces = np.concatenate([mesh.faces, pick, empty, crumb.faces + len(mesh.vertices)])
    soup = Mesh(vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3))
    other = mesh.vertices.mean(0) + [0.0, 12.0, 0.0]
    clean = label_scan(mesh, other).labels
    dirty = label_scan(soup, other).labels.reshape(-1, 3)
    assert (dirty[: len(mesh.faces)] == clean[mesh.faces]).mean() > 0.995
    assert (dirty[-len(crumb.faces) :] == 0).all()


def test_the_surface_counts_what_it_drops() -> None:
    mesh, _ = bumps(step=2.0)
    faces = np.concatenate([mesh.faces, mesh.faces[:7], np.repeat(mesh.faces[:5, :1], 3, axis=1)])
    surface = ScanSurface.of(Mesh(mesh.vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)))
    assert (surface.repeated, surface.empty, len(surface.vertices)) == (7, 5, len(mesh.vertices))
    assert surface.merged == faces.size - len(mesh.vertices) and surface.piece.max() == 0


def test_curvature_of_a_ball_from_inside() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=5.0)
    inside = ScanSurface.of(Mesh(ball.vertices, ball.faces[:, ::-1]))
    assert np.median(inside.creases(inside.edges())) == pytest.approx(1 / 5.0, rel=0.05)
    outside = ScanSurface.of(Mesh(ball.vertices, ball.faces))
    assert outside.creases(outside.edges()).max() == 0.0


def test_the_picture_shows_each_label() -> None:
    mesh = pieces(True)
    labels = tooth_labels(mesh)
    sheet = label_sheet([("upper", mesh, labels)], np.eye(4), ["upper"])
    assert sheet.ndim == 3 and sheet.dtype == np.uint8
    seen = sheet.reshape(-1, 3).astype(float)
    for colour in COLOURS[:3].astype(float):  # shaded: of the same hue
        cosine = seen @ colour / np.maximum(np.linalg.norm(seen, axis=1) * np.linalg.norm(colour), 1e-9)
        assert (cosine > 0.9999).sum() > 500
