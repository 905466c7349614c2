"""Calibrate the cameras of a capture from images of calibration boards, and estimate the accuracy of the result."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import CalibrationError
from jawusd.capture.boards import BoardDetections, board_points, board_symmetries, find_boards
from jawusd.capture.bundle import Bundle, adjust, camera_from
from jawusd.capture.camera_checks import common_target
from jawusd.capture.initial_guess import initial_cameras
from jawusd.formats.capture import Bootstrap, Capture
from jawusd.formats.notes import CalibrationNotes, CameraFigures
from jawusd.geometry import Camera, transform_points, triangulate

_ENOUGH_VIEWS = 40  # recommended number of views; the resulting shape error is a quarter of that with 20 views
_GOOD_RMS_PX = 0.5
# Distance between the centre of the mouth and the nearest board corner above which advice is given.
_FAR_MM = 40.0
_GRID = (8, 5)  # numbers of columns and rows of image cells for which the board's coverage is computed
_LITTLE_COVERAGE = 0.5
_LARGE_EXPECTED_MM = 0.05  # expected error above which advice is given; half of the typical tracking error of 0.1 mm
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


#: Function that measures the scale of the calibration, given the cameras and the failed check of the picked points. The
#: `reason` in that check explains why the picked points do not determine the scale.
MeasureScale = Callable[[list[Camera], ScaleCheck], ScaleCheck]


def calibrate_capture(
    capture: Capture,
    scans: Mapping[str, Array],
    progress: Callable[[int, int], None],
    scale_without_picks: MeasureScale | None = None,
) -> tuple[list[Camera], CalibrationNotes]:
    """Calibrate the cameras from the boards of a capture.

    Args:
        scans: vertices of the teeth scans [mm] by "upper" and "lower", shape (n, 3); picked points are indices of them.
        scale_without_picks: measures the size of the teeth if the picked points are too few.

    Raises:
        CalibrationError: there are no boards, or the boards do not determine the calibration.
        CaptureError: a clip cannot be read.
    """
    if capture.boards is None:
        raise CalibrationError(
            "has no [boards] table.",
            path=capture.file,
            hint="Film a chessboard at the position of the teeth and list the clips in [boards], or set "
            "a calibration file.",
        )
    names = tuple(camera.name for camera in capture.cameras)
    return calibrate_detections(find_boards(names, capture.boards, progress), capture, scans, scale_without_picks)


def calibrate_detections(
    detections: BoardDetections,
    capture: Capture,
    scans: Mapping[str, Array],
    scale_without_picks: MeasureScale | None = None,
) -> tuple[list[Camera], CalibrationNotes]:
    """Calibrate the cameras from detected corners; arguments and CalibrationError as for `calibrate_capture`."""
    boards = capture.boards
    if boards is None:
        raise CalibrationError("has no [boards] table.", path=capture.file)
    points = board_points(boards)
    start = initial_cameras(
        detections.names, detections.sizes_px, detections.corners_px, points, board_symmetries(boards)
    )
    bundle = adjust(start, points)
    lenses = np.hstack([bundle.distortion, np.zeros((len(bundle.K), 3))])
    cameras = [
        Camera(name, size, K, lens, T)
        for name, size, K, lens, T in zip(detections.names, detections.sizes_px, bundle.K, lenses, bundle.T_cam_world)
    ]
    scale = check_scale(cameras, capture.bootstrap, scans, boards.square_mm)
    if scale.ratio is None and scale_without_picks is not None:
        scale = scale_without_picks(cameras, scale)
    centre, source = mouth_centre(cameras, capture.bootstrap, bundle.T_world_board)
    expected = expected_shape_error(cameras, bundle, centre) if len(cameras) > 1 else float("nan")
    figures = {camera.name: _camera_figures(c, camera, bundle, detections) for c, camera in enumerate(cameras)}
    return cameras, CalibrationNotes(
        cameras=figures,
        views=len(bundle.T_world_board),
        board_shape=board_shape_error(cameras, bundle, points, centre),
        expected_shape_mm=expected,
        mouth_mm=(float(centre[0]), float(centre[1]), float(centre[2])),
        mouth_from=source,
        scale=asdict(scale),
        advice=list(_advice(figures, bundle, points, centre, expected)),
        notes=[*detections.notes, *_notes(detections, bundle, scale)],
    )


def _camera_figures(c: int, camera: Camera, bundle: Bundle, detections: BoardDetections) -> CameraFigures:
    seen = np.isfinite(bundle.corners_px[c, ..., 0])
    pixels = bundle.corners_px[c][seen]
    cells = np.floor(pixels / camera.size_px * _GRID).astype(int)
    covered = {(x, y) for x, y in cells.tolist()}
    corners = {"top left": (0, 0), "top right": (1, 0), "bottom left": (0, 1), "bottom right": (1, 1)}
    # A corner region of the image is a quarter as wide and a quarter as high as the image.
    share = pixels / camera.size_px
    empty = [name for name, (right, low) in corners.items() if not ((np.abs(share - [right, low]) < 0.25).all(1)).any()]
    return {
        "views": int(seen.any(1).sum()),
        "rms_px": float(np.sqrt(np.nansum(bundle.residuals_px[c] ** 2) / max(1, seen.sum()))),
        "coverage": len(covered) / (_GRID[0] * _GRID[1]),
        "empty_corners": empty,
        "blurred": detections.blurred[camera.name],
        "missed": detections.missed[camera.name],
    }


def _advice(
    figures: Mapping[str, CameraFigures], bundle: Bundle, points_mm: Array, centre_mm: Array, expected_mm: float
) -> Iterator[str]:
    fewest = min(figures, key=lambda name: figures[name]["views"])
    if figures[fewest]["views"] < _ENOUGH_VIEWS:
        yield (
            f"camera {fewest} uses {figures[fewest]['views']} views of the board; {_ENOUGH_VIEWS} or more give a more "
            "accurate result."
        )
    corners = transform_points(bundle.T_world_board, points_mm)
    distance = float(np.median(np.linalg.norm(corners - centre_mm, axis=-1).min(1)))
    if distance > _FAR_MM:
        yield (
            f"the board was held {distance:.0f} mm from the mouth (median of its nearest corner); hold it at the "
            f"position of the teeth, within {_FAR_MM:.0f} mm."
        )
    for name, figure in figures.items():
        if figure["rms_px"] > _GOOD_RMS_PX:
            yield (
                f"camera {name} has a reprojection error of {figure['rms_px']:.2f} px rms (a good value is "
                f"below {_GOOD_RMS_PX:g} px): check for blur, a bent board, a zoom or a camera that moved."
            )
        if figure["coverage"] < _LITTLE_COVERAGE or figure["empty_corners"]:
            corners_left = ", ".join(figure["empty_corners"])
            unseen = f"the corners {corners_left}" if corners_left else "parts of the image"
            yield (
                f"camera {name}: the board covered {figure['coverage']:.0%} of the image and never reached {unseen}; "
                "the lens model is extrapolated there, so keep the teeth out of that area."
            )
    if expected_mm > _LARGE_EXPECTED_MM:
        yield (
            f"the expected error of distances in the mouth is {expected_mm:.3f} mm: add views, tilted up to 30 "
            "degrees, with the whole board visible in all cameras."
        )


def _notes(detections: BoardDetections, bundle: Bundle, scale: ScaleCheck) -> Iterator[str]:
    found, used = (int(np.isfinite(one.corners_px[..., 0]).sum()) for one in (detections, bundle))
    if found > used:
        yield f"{found - used} of {found} corners are outliers and were discarded."
    if scale.ratio is None:
        yield f"the scale relies on [boards] square_mm alone: {scale.reason}."


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


def mouth_centre(cameras: list[Camera], bootstrap: Bootstrap | None, T_world_board: Array) -> tuple[Array, str]:
    """Return the centre of the mouth in world coordinates [mm], shape (3,), and a text that names its source."""
    picks = triangulated_picks(cameras, bootstrap)
    if picks:
        return np.concatenate([points for _, points in picks.values()]).mean(0), "the picked teeth"
    if len(cameras) == 1:
        return np.median(T_world_board[:, :3, 3], axis=0), "the centre of the boards"
    return common_target(cameras), "the intersection of the optical axes"


def board_shape_error(cameras: list[Camera], bundle: Bundle, points_mm: Array, centre_mm: Array) -> dict[str, float]:
    """Compare distances of corners near the mouth centre (3,) [mm, world] with those on the board (N, 3) [mm].

    Return the `board_shape` of `CalibrationNotes`.
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
        return {"mean": float("nan"), "p95": float("nan"), "max": float("nan"), "distances": 0}
    p95 = float(np.percentile(every, 95))
    return {"mean": float(every.mean()), "p95": p95, "max": float(every.max()), "distances": len(every)}


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
