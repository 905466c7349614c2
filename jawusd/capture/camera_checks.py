"""Check whether a calibration is plausible: lenses, positions and directions of the cameras."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.finding import Finding
from jawusd.geometry import Camera

# Plausible range of the ratio of focal length to image width; fields of view from 100 down to 3 degrees.
_FOCAL_WIDTHS = (0.4, 20.0)
_SQUARE = 0.03  # maximum relative difference between fx and fy; current cameras have square pixels
_CENTRE_SHARE = 0.15  # maximum offset of the principal point from the image centre, relative to the image width
_LEAST_BASELINE_MM, _MOST_BASELINE_MM = 10.0, 5000.0
_LEAST_ANGLE_DEG = 3.0  # minimum angle between two viewing directions; smaller angles determine depth poorly
_NEAREST_MM, _FARTHEST_MM = 40.0, 5000.0


def camera_findings(cameras: Sequence[Camera], path: str) -> Iterator[Finding]:
    """Yield findings about calibrated cameras, with lengths in mm; `path` is the calibration file."""
    for camera in cameras:
        yield from _lens_findings(camera, path)
    if len(cameras) < 2:
        return
    pairs = list(combinations(cameras, 2))
    baselines = [float(np.linalg.norm(a.centre_world() - b.centre_world())) for a, b in pairs]
    for (a, b), baseline in zip(pairs, baselines, strict=True):
        if not _LEAST_BASELINE_MM <= baseline <= _MOST_BASELINE_MM:
            unit = " Is the calibration in metres?" if max(baselines) < _LEAST_BASELINE_MM else ""
            yield Finding(
                "cameras_together" if baseline < _LEAST_BASELINE_MM else "cameras_far_apart",
                "error" if max(baselines) < _LEAST_BASELINE_MM else "warning",
                f"this camera is {baseline:.4g} mm away from camera {a.name}; the usual range is "
                f"{_LEAST_BASELINE_MM:g} to {_MOST_BASELINE_MM:g} mm.{unit}",
                baseline,
                _LEAST_BASELINE_MM,
                path=path,
                camera=b.name,
                hint="Set calibration_unit_mm to the length unit of the file, or calibrate again.",
            )
    if max(baselines) >= _LEAST_BASELINE_MM:
        yield from _aim_findings(cameras, path)


def _lens_findings(camera: Camera, path: str) -> Iterator[Finding]:
    def warning(kind: str, message: str, value: float, limit: float) -> Finding:
        hint = "Check the calibration of this camera."
        return Finding(kind, "warning", message, value, limit, path=path, camera=camera.name, hint=hint)

    width, height = camera.size_px
    focal = float(camera.K[0, 0] / width)
    if not _FOCAL_WIDTHS[0] <= focal <= _FOCAL_WIDTHS[1]:
        low, high = _FOCAL_WIDTHS
        message = f"its focal length is {focal:.3g} image widths; the usual range is {low:g} to {high:g}"
        yield warning("focal_length", message, focal, high if focal > high else low)
    uneven = float(abs(camera.K[1, 1] / camera.K[0, 0] - 1.0))
    if uneven > _SQUARE:
        message = f"its focal lengths fx and fy differ by {uneven:.1%}; a difference of at most {_SQUARE:.0%} is usual"
        yield warning("pixels_not_square", message, uneven, _SQUARE)
    middle = np.array([width - 1, height - 1]) / 2
    off = float(np.abs(camera.K[:2, 2] - middle).max() / width)
    if off > _CENTRE_SHARE:
        message = f"its principal point is {off:.0%} of the image width off the centre; an offset of at most "
        yield warning("principal_point", message + f"{_CENTRE_SHARE:.0%} is usual", off, _CENTRE_SHARE)
    if (worst := _fold(camera)) is not None:
        message = f"its distortion folds over at {worst:.0%} of the way to the corner: it is not invertible there"
        yield warning("distortion_folds", message, worst, 1.0)


def _fold(camera: Camera) -> float | None:
    """Return the radius where distortion folds over, relative to that of the image corner; None if it does not."""
    width, height = camera.size_px
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], np.float64)
    centre = camera.K[:2, 2]
    share = np.linspace(0.0, 1.0, 101)[:, None]
    folds = []
    for corner in corners:
        # Barrel distortion increases the undistorted radius of the corner, hence the factor 1.5.
        seen = camera.distort_pixels(centre + 1.5 * share * (corner - centre))
        reach = np.linalg.norm(seen - centre, axis=1)
        turned = np.flatnonzero(np.diff(reach) < 0)
        if len(turned) and reach[turned[0]] < np.linalg.norm(corner - centre):
            folds.append(reach[turned[0]] / np.linalg.norm(corner - centre))
    return float(min(folds)) if folds else None


def _aim_findings(cameras: Sequence[Camera], path: str) -> Iterator[Finding]:
    """Yield findings about cameras that do not point at the common target of all cameras."""
    target = common_target(cameras)
    for camera in cameras:
        depth = float(camera.depth(target))
        if not _NEAREST_MM <= depth <= _FARTHEST_MM:
            yield Finding(
                "camera_aim",
                "warning",
                f"the common target of the cameras is {depth:.0f} mm in front of this camera; the usual range is "
                f"{_NEAREST_MM:g} to {_FARTHEST_MM:g} mm",
                depth,
                _NEAREST_MM,
                path=path,
                camera=camera.name,
                hint="Check the pose of this camera in the calibration, and calibration_unit_mm.",
            )
    views = [(target - camera.centre_world()) / np.linalg.norm(target - camera.centre_world()) for camera in cameras]
    angles = [float(np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0)))) for a, b in combinations(views, 2)]
    if max(angles) < _LEAST_ANGLE_DEG:
        yield Finding(
            "views_alike",
            "warning",
            f"all viewing directions lie within {max(angles):.1f} degrees; expected at least "
            f"{_LEAST_ANGLE_DEG:g} degrees",
            max(angles),
            _LEAST_ANGLE_DEG,
            path=path,
            hint="Check the calibration, or place the cameras farther apart.",
        )


def common_target(cameras: Sequence[Camera]) -> Array:
    """Return the point that is closest to the optical axes of all cameras [mm], shape (3,)."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for camera in cameras:
        axis = camera.T_cam_world[2, :3]
        across = np.eye(3) - np.outer(axis, axis)
        A += across
        b += across @ camera.centre_world()
    return np.asarray(np.linalg.lstsq(A, b, rcond=None)[0])
