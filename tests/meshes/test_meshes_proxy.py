"""Stand-ins of few faces: against the formula of the surface that they stand for."""

import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter

from jawusd.formats.mesh import BOUNDARY, GUM, TOOTH, Mesh, crown_face_mask
from jawusd.meshes.remeshing import bone_proxy_of, manifold, proxy_of


def torus(count=(240, 80)):
    """Return a torus of an arch's size, crown on its upper side."""
    surface = trimesh.creation.torus(22, 5, *count)
    labels = np.where(surface.vertices[:, 2] > 3, BOUNDARY, np.where(surface.vertices[:, 2] > 0, TOOTH, GUM))
    return Mesh(surface.vertices, surface.faces, labels=labels.astype(np.uint8))


def off_torus(points):
    """Return how far points (n, 3) lie off the torus [mm]."""
    return np.abs(np.hypot(np.linalg.norm(points[:, :2], axis=1) - 22, points[:, 2]) - 5)


def test_proxies_are_small_and_close():
    mesh = torus()
    proxy = proxy_of(mesh, 1500)
    border = 2 * 2 * 2 * 240  # edges of the zigzag between crown and gum: both sides of two lines
    assert 1500 < len(proxy.faces) <= 1500 + border < 0.1 * len(mesh.faces)
    triangles = proxy.vertices[proxy.faces]
    assert off_torus(proxy.vertices).max() < 0.1 and off_torus(triangles.mean(axis=1)).max() < 0.3
    area, whole = (np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1) / 2 for t in
                   (triangles, mesh.vertices[mesh.faces]))  # fmt: skip
    assert abs(area.sum() / whole.sum() - 1) < 0.01
    crown = crown_face_mask(proxy)
    assert abs(area[crown].sum() / whole[crown_face_mask(mesh)].sum() - 1) < 0.01
    assert (triangles[crown].mean(axis=1)[:, 2] > -0.5).all() and (triangles[~crown].mean(axis=1)[:, 2] < 0.5).all()


def test_bones_are_one_part_and_small_meshes_stay():
    surface = trimesh.creation.icosphere(subdivisions=5, radius=60)
    proxy = proxy_of(Mesh(surface.vertices, surface.faces), 1500)
    assert len(proxy.faces) <= 1500 and crown_face_mask(proxy).all()
    assert np.abs(np.linalg.norm(proxy.vertices, axis=1) - 60).max() < 0.5
    small = torus((20, 8))
    assert len(proxy_of(small, 1500).faces) == len(small.faces)


def porous():
    """Return the surface of a sponge: the sides of the cells that smoothed noise fills."""
    noise = gaussian_filter(np.random.default_rng(1).normal(size=(24, 24, 24)), 2)
    inside = np.pad(noise > np.quantile(noise, 0.6), 1).astype(int)
    corners = []
    for axis in range(3):
        step, (u, v) = np.diff(inside, axis=axis), np.roll(np.eye(3), -1 - axis, axis=0)[:2]
        at = np.argwhere(step != 0)
        sides = at[:, None] + np.eye(3)[axis] + np.array([0 * u, u, u + v, v])
        corners.append(np.where((step[tuple(at.T)] < 0)[:, None, None], sides, sides[:, ::-1]))
    vertices = np.concatenate(corners).reshape(-1, 3)
    quads = np.arange(len(vertices), dtype=np.int32).reshape(-1, 4)
    return manifold(Mesh(vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])))


def crowded_edges(mesh):
    """Return how many edges have more than two faces."""
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return int((np.unique(edges, axis=0, return_counts=True)[1] > 2).sum())


def test_proxies_of_porous_bones_are_manifolds():
    mesh = porous()
    assert crowded_edges(mesh) == 0 < crowded_edges(proxy_of(mesh, 1500))
    proxy = bone_proxy_of(mesh, 1500)
    assert crowded_edges(proxy) == 0 and 0.9 * 1500 < len(proxy.faces) < 0.2 * len(mesh.faces)
    area = [trimesh.Trimesh(found.vertices, found.faces).area for found in (mesh, proxy)]
    assert abs(area[1] / area[0] - 1) < 0.25
