"""Picks that start the tracking: vertices of the teeth with the pixels where two cameras see them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera, transform_points
from jawusd.geometry.arrays import Array
from jawusd.geometry.rays import meet_triangles
from jawusd.synthetic.dental_arch import DentalArch
from jawusd.synthetic.surfaces import vertex_normals

# A pick lies this far inside the picture, and on a surface not turned away by more than about 70 degrees.
_BORDER_PX = 10.0
_FACING = 0.35
# Another surface this much nearer to the camera hides a point.
_CLEARANCE_MM = 0.05
_TIPS_PER_TOOTH = 6


@dataclass(frozen=True)
class SeenVertex:
    """A vertex and where two cameras see it.

    Attributes:
        vertex: index into the scan.
        views: per camera its name and the pixel, x and y.
    """

    vertex: int
    views: tuple[tuple[str, float, float], ...]


def choose_picks(
    arch: DentalArch,
    T_world_arch: Array,
    cameras: list[Camera],
    occluders: list[Mesh],
    count: int,
    noise_px: float,
    rng: np.random.Generator,
) -> list[SeenVertex]:
    """Choose well spread tips and corners of teeth that at least two cameras see.

    Args:
        arch: the row of teeth.
        T_world_arch: its pose, shape (4, 4).
        cameras: the cameras.
        occluders: what may hide the teeth, world coordinates; the row itself included.
        count: how many.
        noise_px: standard deviation of the picked pixels, per axis.
        rng: draws the noise.

    Returns:
        `count` picks.

    Raises:
        ValueError: fewer vertices are seen by two cameras.
    """
    candidates = _tips(arch)
    points = transform_points(T_world_arch, arch.mesh.vertices[candidates])
    normals = vertex_normals(arch.mesh.vertices, arch.mesh.faces)[candidates] @ T_world_arch[:3, :3].T
    facing = np.stack([_seen(camera, points, normals, occluders) for camera in cameras], -1)
    good = np.flatnonzero((facing > 0).sum(-1) >= 2)
    if len(good) < count:
        raise ValueError(f"only {len(good)} tips of teeth are seen by two cameras, {count} are needed")
    picks = []
    for i in _spread(points[good], count):
        k = good[i]
        views = []
        for c in sorted(np.argsort(-facing[k])[:2]):
            x, y = cameras[c].project(points[k]) + rng.normal(0.0, noise_px, 2)
            views.append((cameras[c].name, float(x), float(y)))
        picks.append(SeenVertex(int(candidates[k]), tuple(views)))
    return picks


def _tips(arch: DentalArch) -> NDArray[np.int64]:
    """Vertices at the occlusal end of the crowns, on the facial side: what a person would click on."""
    vertices = arch.mesh.vertices
    up = 1.0 if vertices[arch.tooth == 0, 1].mean() < vertices[arch.tooth != 0, 1].mean() else -1.0
    chosen = []
    for k in np.unique(arch.tooth[arch.tooth != 0]):
        own = np.flatnonzero(arch.tooth == k)
        height = up * vertices[own, 1]
        tips = own[height > height.max() - 1.2]
        chosen.append(tips[:: max(1, len(tips) // _TIPS_PER_TOOTH)])
    return np.concatenate(chosen)


def _seen(camera: Camera, points: Array, normals: Array, occluders: list[Mesh]) -> Array:
    """How squarely a camera sees points: cosine of normal and ray, 0 where hidden or turned away, shape (N,)."""
    eye = camera.centre_world()
    rays = eye - points
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    facing = np.einsum("ni,ni->n", rays, normals)
    pixels = camera.project(points)
    limit = np.array(camera.size_px) - 1 - _BORDER_PX
    facing[((pixels < _BORDER_PX) | (pixels > limit)).any(1)] = 0.0
    facing[facing < _FACING] = 0.0
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in occluders])
    # a triangle can only hide a point if its corners, in the picture, do not all lie to one side of it
    seen_at = camera.project_pinhole(corners)
    low, high = seen_at.min(1), seen_at.max(1)
    at = camera.project_pinhole(points)
    for i in np.flatnonzero(facing):
        if _hits(points[i], eye, corners[((low <= at[i]) & (at[i] <= high)).all(1)]):
            facing[i] = 0.0
    return facing


def _hits(point: Array, eye: Array, corners: Array) -> bool:
    """Tell whether a triangle (N, 3, 3) lies between a point and the eye."""
    direction = eye - point
    u, v, along = meet_triangles(point, direction, corners)
    nearest = _CLEARANCE_MM / np.linalg.norm(direction)
    return bool(((u >= 0) & (v >= 0) & (u + v <= 1) & (along > nearest) & (along < 1)).any())


def _spread(points: Array, count: int) -> list[int]:
    """Farthest-point choice, starting with the point farthest from the middle."""
    chosen = [int(np.linalg.norm(points - points.mean(0), axis=1).argmax())]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen
