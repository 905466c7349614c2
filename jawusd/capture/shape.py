"""Errors of lengths in the mouth: measured on the board's corners, and expected from their scatter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.capture.bundle import Bundle, camera_from
from jawusd.capture.scale import triangulated_picks
from jawusd.formats.capture import Bootstrap
from jawusd.geometry import Camera, se3_inverse

_MOUTH_RADIUS_MM = 35.0  # holds both arches through an opening of 40 mm
_DRAWS = 40
_POINTS = 150


@dataclass(frozen=True)
class ShapeError:
    """Sum up errors of distances between points [mm]."""

    mean: float  # mean absolute error
    p95: float  # its 95th percentile
    max: float  # the largest
    distances: int  # how many were compared; 0 = no corner near the mouth was seen by two cameras


def mouth_centre(cameras: list[Camera], bootstrap: Bootstrap | None, T_world_board: Array) -> tuple[Array, str]:
    """Return the middle of the mouth in the world [mm], shape (3,), and what it was found from."""
    picks = triangulated_picks(cameras, bootstrap)
    if picks:
        return np.concatenate([points for _, points in picks.values()]).mean(0), "the picked teeth"
    if len(cameras) == 1:
        return np.median(T_world_board[:, :3, 3], axis=0), "the middle of the boards"
    # The point nearest to all optical axes.
    T = np.stack([se3_inverse(camera.T_cam_world) for camera in cameras])
    across = np.eye(3) - T[:, :3, 2, None] * T[:, None, :3, 2]
    return np.linalg.solve(across.sum(0), (across @ T[:, :3, 3, None]).sum(0))[:, 0], "where the cameras look"


def board_shape_error(cameras: list[Camera], bundle: Bundle, points_mm: Array, centre_mm: Array) -> ShapeError:
    """Compare distances between triangulated corners with those on the board, near the mouth.

    Args:
        points_mm: corners on the board, shape (N, 3).
        centre_mm: middle of the mouth in the world, shape (3,).
    """
    errors = []
    for corners in np.moveaxis(bundle.corners_px, 1, 0):
        enough = np.isfinite(corners[..., 0]).sum(0) >= 2
        if enough.sum() < 2:
            continue
        found = _triangulate(cameras, corners[:, enough])
        near = np.linalg.norm(found - centre_mm, axis=1) < _MOUTH_RADIUS_MM
        errors.append(distance_errors(found[near], points_mm[enough][near]))
    every = np.concatenate([np.empty(0), *errors])
    if not len(every):
        return ShapeError(float("nan"), float("nan"), float("nan"), 0)
    return ShapeError(float(every.mean()), float(np.percentile(every, 95)), float(every.max()), len(every))


def expected_shape_error(cameras: list[Camera], bundle: Bundle, centre_mm: Array) -> float:
    """Return the mean error of distances in the mouth volume [mm] when the cameras err by their covariance.

    Points of the volume are seen with the calibrated cameras and triangulated with cameras drawn from the covariance.
    What the model leaves out (bent boards, other lens terms, rolling shutters) is not in it.
    """
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(_POINTS, 3))
    radius = _MOUTH_RADIUS_MM * rng.uniform(size=(_POINTS, 1)) ** (1 / 3)
    points = centre_mm + radius * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    pixels = np.stack([camera.project(points) for camera in cameras])
    errors = []
    for drawn in rng.multivariate_normal(bundle.parameters, bundle.covariance, _DRAWS, method="eigh"):
        others = [
            replace(camera, K=K, distortion=np.array([*lens, 0.0, 0.0, 0.0]), T_cam_world=T)
            for camera, K, lens, T in zip(cameras, *camera_from(drawn))
        ]
        errors.append(distance_errors(_triangulate(others, pixels), points).mean())
    return float(np.mean(errors))


def distance_errors(found: Array, exact: Array) -> Array:
    """Return the absolute errors of the distances between all pairs of points [mm], shape (n (n - 1) / 2,)."""
    i, j = np.triu_indices(len(found), 1)
    lengths = [np.linalg.norm(points[i] - points[j], axis=1) for points in (found, exact)]
    return np.abs(lengths[0] - lengths[1])


def _triangulate(cameras: list[Camera], pixels: Array) -> Array:
    """Return points (M, 3) seen at distorted pixels (C, M, 2), NaN where unseen: linear, all at once.

    Rows in normalised coordinates, solved for the inhomogeneous point about the median board distance (Hartley &
    Zisserman, section 12.2): with cameras at like distances the algebraic error is the reprojection error.
    """
    rows, right = [], []
    for camera, seen in zip(cameras, pixels):
        pinhole = camera.undistort_pixels(np.nan_to_num(seen, nan=0.0))
        x = np.concatenate([pinhole, np.ones((len(seen), 1))], axis=1) @ np.linalg.inv(camera.K).T
        R, t = camera.T_cam_world[:3, :3], camera.T_cam_world[:3, 3]
        weight = np.where(np.isfinite(seen[:, 0]), 1.0, 0.0)[:, None]
        for axis in (0, 1):
            rows.append(weight * (x[:, axis, None] * R[2] - R[axis]))
            right.append(weight[:, 0] * (t[axis] - x[:, axis] * t[2]))
    A, b = np.stack(rows, axis=1), np.stack(right, axis=1)
    return np.linalg.solve(np.swapaxes(A, 1, 2) @ A, (np.swapaxes(A, 1, 2) @ b[..., None]))[..., 0]
