"""Annotations of a synthetic capture: masks with the defects of manual segmentation, and bootstrap picks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.formats.capture import Pick, PickView
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera, transform_points
from jawusd.geometry.points import meet_triangles
from jawusd.meshes.surfaces import vertex_normals
from jawusd.synthetic.dental_arch import DentalArch

# Outline jitter: amplitude and cell size [px] at an image height of 1080 px, fraction of the variance that is constant
# over time, and frame-to-frame correlation of the variable part.
_WOBBLE_PX, _CELL_PX = 0.7, 36.0
_REFERENCE_HEIGHT = 1080.0
_CONSTANT_SHARE = 0.5
_KEEP = 0.6
_HOLE_CHANCE, _SPECK_CHANCE = 0.12, 0.08
_FINE = 4
# Minimum distance of a pick from the image border, and minimum cosine between viewing ray and normal (70 degrees).
_BORDER_PX = 10.0
_FACING = 0.35
# Minimum distance of a surface in front of a point for the surface to occlude the point.
_CLEARANCE_MM = 0.05
_TIPS_PER_TOOTH = 6


class Outline:
    """Jitter of a mask's outline, as a displacement field that varies over time."""

    def __init__(self, size_px: tuple[int, int], rng: np.random.Generator) -> None:
        """Initialise the field for masks of a given width and height."""
        scale = size_px[1] / _REFERENCE_HEIGHT
        self._rng = rng
        cells = tuple(int(np.ceil(s / (_CELL_PX * scale))) + 3 for s in size_px[::-1])
        self._amplitude_px = _WOBBLE_PX * scale
        self._constant = rng.normal(size=(*cells, 2))
        self._varying = rng.normal(size=(*cells, 2))

    def next(self) -> Array:
        """Return the displacement field over the image for the next frame [px], shape (rows, columns, 2)."""
        fresh = self._rng.normal(size=self._varying.shape)
        self._varying = _KEEP * self._varying + np.sqrt(1.0 - _KEEP**2) * fresh
        field = np.sqrt(_CONSTANT_SHARE) * self._constant + np.sqrt(1.0 - _CONSTANT_SHARE) * self._varying
        field = _refined(_refined(field, 0), 1)
        return self._amplitude_px * field


def _refined(field: Array, axis: int) -> Array:
    """Interpolate along an axis with cosine weights, normalised to equal variance at and between nodes."""
    t = np.arange(_FINE) / _FINE
    b = 0.5 - 0.5 * np.cos(np.pi * t)
    a = 1.0 - b
    norm = np.hypot(a, b)
    field = np.moveaxis(field, axis, 0)
    shape = (1, _FINE) + (1,) * (field.ndim - 1)
    between = (a / norm).reshape(shape) * field[:-1, None] + (b / norm).reshape(shape) * field[1:, None]
    return np.moveaxis(between.reshape(-1, *field.shape[1:]), 0, axis)


def drawn_mask(coverage: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Threshold the coverage (h, w), 0..255, to a mask (h, w), 0 or 255; sometimes add a small hole or speck."""
    mask = coverage > 127
    hole, speck = rng.random() < _HOLE_CHANCE, rng.random() < _SPECK_CHANCE
    place, radius = rng.random(2), rng.uniform(1.2, 3.5, 2) * len(mask) / _REFERENCE_HEIGHT * 1.5
    if mask.any():
        rows, columns = np.nonzero(mask)
        pick = int(place[0] * len(rows))
        if hole:
            _ellipse(mask, rows[pick], columns[pick], radius, False)
        if speck:
            drop = (8.0 + 22.0 * place[1]) * len(mask) / _REFERENCE_HEIGHT
            _ellipse(mask, rows.max() + drop, columns[pick], radius, True)
    return np.where(mask, np.uint8(255), np.uint8(0))


def _ellipse(mask: Mask, row: float, column: float, radius: Array, value: bool) -> None:
    """Set the pixels of a small ellipse to a value."""
    y, x = np.ogrid[: mask.shape[0], : mask.shape[1]]
    mask[((y - row) / radius[0]) ** 2 + ((x - column) / radius[1]) ** 2 <= 1.0] = value


def choose_picks(
    arch: DentalArch,
    T_world_arch: Array,
    cameras: list[Camera],
    occluders: list[Mesh],
    count: int,
    noise_px: float,
    rng: np.random.Generator,
) -> tuple[Pick, ...]:
    """Choose `count` well-distributed tips and corners of teeth that are visible in at least two cameras.

    Args:
        T_world_arch: pose of the arch, shape (4, 4).
        occluders: meshes that may occlude the teeth, including the arch itself, in world coordinates.
        noise_px: standard deviation of the picked image points, per axis.

    Raises:
        ValueError: too few vertices are visible in two cameras.
    """
    candidates = _tips(arch)
    points = transform_points(T_world_arch, arch.mesh.vertices[candidates])
    normals = vertex_normals(arch.mesh.vertices, arch.mesh.faces)[candidates] @ T_world_arch[:3, :3].T
    facing = np.stack([_seen(camera, points, normals, occluders) for camera in cameras], -1)
    good = np.flatnonzero((facing > 0).sum(-1) >= 2)
    if len(good) < count:
        raise ValueError(f"only {len(good)} tips of teeth are visible in two cameras; expected {count}")
    picks = []
    for i in spread_out(points[good], count):
        k = good[i]
        views = []
        for c in sorted(np.argsort(-facing[k])[:2]):
            x, y = cameras[c].project(points[k]) + rng.normal(0.0, noise_px, 2)
            views.append(PickView(camera=cameras[c].name, x=float(x), y=float(y)))
        picks.append(Pick(vertex=int(candidates[k]), views=tuple(views)))
    return tuple(picks)


def _tips(arch: DentalArch) -> NDArray[np.int64]:
    """Return vertices at the occlusal end of the crowns on the facial side, where an annotator would click."""
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
    """Return the cosine between normals and viewing rays, 0 for occluded or back-facing points, shape (N,)."""
    eye = camera.centre_world()
    rays = eye - points
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    facing = np.einsum("ni,ni->n", rays, normals)
    pixels = camera.project(points)
    limit = np.array(camera.size_px) - 1 - _BORDER_PX
    facing[((pixels < _BORDER_PX) | (pixels > limit)).any(1)] = 0.0
    facing[facing < _FACING] = 0.0
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in occluders])
    # A triangle can occlude a point only if its bounding box in the image contains the point.
    pixels_of_corners = camera.project_pinhole(corners)
    low, high = pixels_of_corners.min(1), pixels_of_corners.max(1)
    at = camera.project_pinhole(points)
    for i in np.flatnonzero(facing):
        if _hits(points[i], eye, corners[((low <= at[i]) & (at[i] <= high)).all(1)]):
            facing[i] = 0.0
    return facing


def _hits(point: Array, eye: Array, corners: Array) -> bool:
    """Return whether any triangle (N, 3, 3) lies between a point and the camera."""
    direction = eye - point
    u, v, along = meet_triangles(point, direction, corners)
    nearest = _CLEARANCE_MM / np.linalg.norm(direction)
    return bool(((u >= 0) & (v >= 0) & (u + v <= 1) & (along > nearest) & (along < 1)).any())


def spread_out(points: Array, count: int) -> list[int]:
    """Select points (N, 3) by farthest-point sampling, starting with the one farthest from the mean; return indices."""
    chosen = [int(np.linalg.norm(points - points.mean(0), axis=1).argmax())]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen
