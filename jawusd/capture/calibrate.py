"""Calibrate the cameras of a capture from images of calibration boards, and estimate the accuracy of the result."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import CalibrationError
from jawusd.capture.boards import BoardDetections, board_points, board_symmetries, find_boards
from jawusd.capture.bundle import Bundle, adjust
from jawusd.capture.initial_guess import initial_cameras
from jawusd.capture.scale import (
    ScaleCheck,
    board_shape_error,
    check_scale,
    expected_shape_error,
    mouth_centre,
)
from jawusd.formats.capture import Capture
from jawusd.formats.notes import CalibrationNotes, CameraFigures
from jawusd.geometry import Camera, transform_points

#: Function that measures the scale of the calibration, given the cameras and the failed check of the picked points. The
#: `reason` in that check explains why the picked points do not determine the scale.
MeasureScale = Callable[[list[Camera], ScaleCheck], ScaleCheck]

_ENOUGH_VIEWS = 40  # recommended number of views; the resulting shape error is a quarter of that with 20 views
_GOOD_RMS_PX = 0.5
# Distance between the centre of the mouth and the nearest board corner above which advice is given.
_FAR_MM = 40.0
_GRID = (8, 5)  # numbers of columns and rows of image cells for which the board's coverage is computed
_LITTLE_COVERAGE = 0.5
_LARGE_EXPECTED_MM = 0.05  # expected error above which advice is given; half of the typical tracking error of 0.1 mm


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
    """Calibrate the cameras from detected corners; see `calibrate_capture`.

    Raises:
        CalibrationError: the corners do not determine the calibration.
    """
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
        board_shape=asdict(board_shape_error(cameras, bundle, points, centre)),
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
