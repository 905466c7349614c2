"""Picks that start the tracking: vertices of the teeth with their pixels in two cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera, transform_points
from jawusd.geometry.rays import meet_triangles
from jawusd.synthetic.dental_arch import DentalArch
from jawusd.synthetic.surfaces import vertex_normals

# A pick lies this far inside the picture, and on a surface inclined to the ray by at most about 70 degrees.
_BORDER_PX = 10.0
_FACING = 0.35
# Another surface this much nearer to the camera hides a point.
_CLEARANCE_MM = 0.05
_TIPS_PER_TOOTH = 6


@dataclass(frozen=True)
class SeenVertex:
    """A vertex of a scan and its pixels: (camera, x, y) of two cameras."""

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
    """Choose `count` well spread tips and corners of teeth that are visible in at least two cameras.

    Args:
        T_world_arch: pose of the arch, shape (4, 4).
        occluders: meshes that may hide the teeth, world coordinates; the arch itself included.
        noise_px: standard deviation of the picked pixels, per axis.

    Raises:
        ValueError: fewer vertices are visible in two cameras.
    """
    candidates = _tips(arch)
    points = transform_points(T_world_arch, arch.mesh.vertices[candidates])
    normals = vertex_normals(arch.mesh.vertices, arch.mesh.faces)[candidates] @ T_world_arch[:3, :3].T
    facing = np.stack([_seen(camera, points, normals, occluders) for camera in cameras], -1)
    good = np.flatnonzero((facing > 0).sum(-1) >= 2)
    if len(good) < count:
        raise ValueError(f"only {len(good)} tips of teeth are seen by two cameras, {count} are needed")
    picks = []
    for i in spread_out(points[good], count):
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
    # A triangle can hide a point only if the bounding box of its corners in the picture contains the point.
    pixels_of_corners = camera.project_pinhole(corners)
    low, high = pixels_of_corners.min(1), pixels_of_corners.max(1)
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


def spread_out(points: Array, count: int) -> list[int]:
    """Return the indices of well spread points (N, 3): farthest-point choice, from the one farthest off the middle."""
    chosen = [int(np.linalg.norm(points - points.mean(0), axis=1).argmax())]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen
