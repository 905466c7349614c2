"""Accuracy of a calibration: check of the scale against the teeth, and errors of lengths in the mouth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import CalibrationError
from jawusd.capture.bundle import Bundle, camera_from
from jawusd.capture.camera_checks import common_target
from jawusd.formats.capture import Bootstrap
from jawusd.geometry import Camera, triangulate

_FEWEST_PICKS = 3  # Minimum number of picked points per dental arch.
_TOLERANCE = 0.03  # Maximum deviation of the size ratio from 1; picked points determine the ratio to about 0.5 %.
_SIGMAS = 4.0
_MOUTH_RADIUS_MM = 35.0  # radius of a sphere that contains both dental arches up to a mouth opening of 40 mm
_DRAWS = 40
_POINTS = 150


@dataclass(frozen=True)
class ScaleCheck:
    """Size of the teeth measured with the cameras, relative to their size in the scan."""

    ratio: float | None  # Measured size divided by scanned size; None if unknown.
    sigma: float | None  # Standard error of the ratio; None if the ratio is unknown.
    reason: str = ""  # reason why the ratio is unknown; empty if it is known


def triangulated_picks(
    cameras: list[Camera], bootstrap: Bootstrap | None
) -> dict[str, tuple[NDArray[np.int64], Array]]:
    """Return the indices of the picked vertices (n,) and their triangulated positions (n, 3) [mm], by arch."""
    known = {camera.name: camera for camera in cameras}
    out = {}
    for jaw in ("upper", "lower"):
        vertices, points = [], []
        for pick in getattr(bootstrap, jaw) if bootstrap else ():
            views = [(known[view.camera], [view.x, view.y]) for view in pick.views if view.camera in known]
            if len({camera.name for camera, _ in views}) >= 2:
                projections = [camera.projection_matrix() for camera, _ in views]
                vertices.append(pick.vertex)
                points.append(triangulate(projections, [camera.undistort_pixels(px) for camera, px in views]))
        if points:
            out[jaw] = np.array(vertices), np.array(points)
    return out


def check_scale(
    cameras: list[Camera], bootstrap: Bootstrap | None, scans: Mapping[str, Array], square_mm: float
) -> ScaleCheck:
    """Compare the spread of triangulated picked points with their spread on the scans (Umeyama 1991).

    `scans` has the vertices (n, 3) [mm] by "upper" and "lower".

    Raises:
        CalibrationError: the measured size of the teeth differs from the scan.
    """
    squares, weights, residuals = [], [], []
    for jaw, (vertices, points) in triangulated_picks(cameras, bootstrap).items():
        if len(points) < _FEWEST_PICKS or jaw not in scans or vertices.max() >= len(scans[jaw]):
            continue
        scan = scans[jaw][vertices]
        a, b = scan - scan.mean(0), points - points.mean(0)
        U, S, Vt = np.linalg.svd(b.T @ a)
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
        spread = float((a * a).sum())
        weights.append(spread)
        squares.append(float((S * sign).sum()) / spread)
        residuals.append((b - squares[-1] * a @ (Vt.T * sign) @ U.T).ravel())
    if not squares:
        return ScaleCheck(None, None, "no picks are seen by two cameras")
    ratio = float(np.average(squares, weights=weights))
    off = np.concatenate(residuals)
    freedom = max(1, len(off) - 7 * len(squares))
    sigma = float(np.sqrt((off @ off) / freedom / sum(weights)))
    return checked_scale(ratio, sigma, square_mm)


def checked_scale(ratio: float, sigma: float, square_mm: float) -> ScaleCheck:
    """Check the square size of the board with a size ratio of the teeth (measured / scanned).

    Raises:
        CalibrationError: the measured size of the teeth differs from the scan.
    """
    if abs(ratio - 1) > max(_TOLERANCE, _SIGMAS * sigma):
        raise CalibrationError(
            f"with this board, the teeth measure {ratio:.3f} (+-{sigma:.3f}) times their size in the scan: squares "
            f"of {square_mm:g} mm would have to be {square_mm / ratio:.2f} mm.",
            hint="Measure the printed board and correct [boards] square_mm, or check the picks and the scan's unit.",
        )
    if _SIGMAS * sigma > 3 * _TOLERANCE:
        return ScaleCheck(None, None, f"the picks are too inaccurate to check it (+-{sigma:.1%})")
    return ScaleCheck(ratio, sigma)


@dataclass(frozen=True)
class ShapeError:
    """Statistics of the errors of distances between points [mm]."""

    mean: float  # mean of the absolute errors
    p95: float  # 95th percentile of the absolute errors,
    max: float  # and their maximum
    distances: int  # number of distances compared; 0 if no corner near the mouth was visible to two cameras


def mouth_centre(cameras: list[Camera], bootstrap: Bootstrap | None, T_world_board: Array) -> tuple[Array, str]:
    """Return the centre of the mouth in world coordinates [mm], shape (3,), and a text that names its source."""
    picks = triangulated_picks(cameras, bootstrap)
    if picks:
        return np.concatenate([points for _, points in picks.values()]).mean(0), "the picked teeth"
    if len(cameras) == 1:
        return np.median(T_world_board[:, :3, 3], axis=0), "the centre of the boards"
    return common_target(cameras), "the intersection of the optical axes"


def board_shape_error(cameras: list[Camera], bundle: Bundle, points_mm: Array, centre_mm: Array) -> ShapeError:
    """Compare distances of corners near the mouth centre (3,) [mm, world] with those on the board (N, 3) [mm]."""
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
    """Return the mean error of distances in the mouth [mm] that the covariance of the cameras implies.

    Points in the mouth are projected with the calibrated cameras and triangulated with cameras drawn from the
    covariance. Bent boards, other lens terms and rolling shutter are not included.
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
    """Triangulate points (M, 3) linearly from distorted pixels (C, M, 2), NaN where hidden.

    The inhomogeneous method in normalised coordinates (Hartley & Zisserman, section 12.2): if the cameras are at
    similar distances, its algebraic error approximates the reprojection error.
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
