"""Calibration from projected corners, compared with the true cameras, and all its errors."""

import numpy as np
import pytest
from boards import CENTRE, board, capture_of, detections, opencv_pixels, poses, studio
from scipy.spatial.transform import Rotation

from jawusd.base.errors import CalibrationError
from jawusd.capture.boards import BoardDetections, board_points, board_symmetries
from jawusd.capture.bundle import _Problem
from jawusd.capture.calibrate import calibrate_capture, calibrate_detections
from jawusd.capture.initial_guess import initial_cameras
from jawusd.geometry import se3_inverse, triangulate

CAMERAS = studio()


def distance_error(found, truth, radius=15.0):
    """Return the mean error of distances in a ball where the boards were [mm]."""
    points = np.random.default_rng(9).uniform(-radius, radius, (200, 3))
    points = CENTRE + points[np.linalg.norm(points, axis=1) < radius]
    pixels = np.stack([f.undistort_pixels(opencv_pixels(t, points)) for f, t in zip(found, truth, strict=True)], 1)
    seen = np.array([triangulate([c.projection_matrix() for c in found], views) for views in pixels])
    i, j = np.triu_indices(len(points), 1)
    return np.abs(np.linalg.norm(seen[i] - seen[j], axis=1) - np.linalg.norm(points[i] - points[j], axis=1)).mean()


def altered(found, **changes):
    fields = {name: getattr(found, name) for name in BoardDetections.__dataclass_fields__}
    return BoardDetections(**(fields | changes))


@pytest.mark.parametrize(("cols", "rows", "turns"), [(9, 6, (0, 2)), (7, 7, (0, 1, 2, 3)), (8, 6, (0, 2))])
def test_distances_survive_whatever_order_the_corners_come_in(tmp_path, cols, rows, turns):
    rng = np.random.default_rng(0)
    boards = board(cols=cols, rows=rows)
    found = detections(CAMERAS, boards, poses(24, rng), rng)
    corners = found.corners_px.copy()
    for c in range(3):
        for v in range(24):
            grid = corners[c, v].reshape(rows, cols, 2)
            corners[c, v] = np.rot90(grid, turns[rng.integers(len(turns))]).reshape(-1, 2)
    corners[1, 3, 5] += 30  # an outlier corner
    corners[2, 4:7] = np.nan  # views one camera missed
    capture = capture_of(CAMERAS, boards, tmp_path)
    cameras, report = calibrate_detections(altered(found, corners_px=corners), capture, {})
    assert distance_error(cameras, CAMERAS) < 0.02
    assert np.array_equal(cameras[0].T_cam_world, np.eye(4)) and [c.name for c in cameras] == ["c0", "c1", "c2"]
    assert all(0.12 < figures["rms_px"] < 0.16 for figures in report["cameras"].values())  # 0.1 px per axis
    assert report["cameras"]["c2"]["views"] == 21
    assert any("are outliers and were discarded" in note for note in report["notes"])


@pytest.mark.slow
def test_the_expected_error_is_what_repeated_calibrations_show(tmp_path):
    boards, errors, expected = board(), [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        found = detections(CAMERAS, boards, poses(14, rng), rng, noise_px=0.3)
        cameras, report = calibrate_detections(found, capture_of(CAMERAS, boards, tmp_path), {})
        errors.append(distance_error(cameras, CAMERAS, radius=35.0))
        expected.append(report["expected_shape_mm"])
    assert 0.4 < np.mean(expected) / np.mean(errors) < 2.5


def test_the_jacobian_is_the_slope_of_the_residuals():
    rng, boards = np.random.default_rng(1), board()
    found = detections(CAMERAS, boards, poses(8, rng), rng)
    points = board_points(boards)
    start = initial_cameras(found.names, found.sizes_px, found.corners_px, points, board_symmetries(boards))
    problem = _Problem(start.corners_px, points)
    x = problem.pack(start)
    J = problem.jacobian(x).toarray()
    for k in range(len(x)):
        h = 1e-6 * max(1.0, abs(x[k]))
        step = np.eye(len(x))[k] * h
        slope = (problem.residuals(x + step) - problem.residuals(x - step)) / (2 * h)
        assert np.abs(J[:, k] - slope).max() < 1e-5 * max(1.0, np.abs(slope).max())


def test_clips_that_are_not_simultaneous_are_refused(tmp_path):
    rng, boards = np.random.default_rng(2), board()
    found = detections(CAMERAS, boards, poses(20, rng), rng)
    corners = found.corners_px.copy()
    corners[1] = np.roll(corners[1], 3, axis=0)  # as if trimmed at the start
    with pytest.raises(CalibrationError, match=r"c0 and c1 are inconsistent.*of 20 agree.*synchronous"):
        calibrate_detections(altered(found, corners_px=corners), capture_of(CAMERAS, boards, tmp_path), {})


def test_too_few_views_are_refused_per_camera_and_per_pair(tmp_path):
    rng, boards = np.random.default_rng(3), board()
    found = detections(CAMERAS, boards, poses(20, rng), rng)
    few, apart = found.corners_px.copy(), found.corners_px.copy()
    few[1, 5:] = np.nan
    apart[0, 12:] = np.nan
    apart[1, :10] = np.nan
    apart[2, 12:] = np.nan
    with pytest.raises(CalibrationError, match=r"camera c1: .* in 5 images; at least 6 .*40 poses"):
        calibrate_detections(altered(found, corners_px=few), capture_of(CAMERAS, boards, tmp_path), {})
    with pytest.raises(CalibrationError, match=r"c1 shares 2 sharp board views with"):
        calibrate_detections(altered(found, corners_px=apart), capture_of(CAMERAS, boards, tmp_path), {})


def picked(rng, noise_px=1.0):
    """Return scans and picks of four points per jaw in two cameras, with mouse accuracy."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix(), CENTRE
    scans, picks = {}, {}
    for jaw, y in (("upper", 4.0), ("lower", -4.0)):
        scans[jaw] = np.array([[-25.0, y, -20], [25, y, -20], [-10, y, 10], [12, y, 9], [0, y, 12]])
        pixels = [opencv_pixels(c, scans[jaw] @ T[:3, :3].T + T[:3, 3]) for c in CAMERAS]
        picks[jaw] = [
            {"vertex": v, "views": [
                {"camera": f"c{c}", "x": pixels[c][v, 0] + rng.normal(0, noise_px),
                 "y": pixels[c][v, 1] + rng.normal(0, noise_px)} for c in (0, 1 + v % 2)]}
            for v in range(5)
        ]  # fmt: skip
    return scans, {"frame": 0, **picks}


@pytest.mark.slow
def test_a_wrong_square_size_is_told_by_the_teeth(tmp_path):
    rng = np.random.default_rng(4)
    scans, picks = picked(rng)
    found = detections(CAMERAS, board(), poses(20, rng), rng)
    _, report = calibrate_detections(found, capture_of(CAMERAS, board(), tmp_path, picks), scans)
    assert report["scale"]["ratio"] == pytest.approx(1.0, abs=0.03) and report["mouth_from"] == "the picked teeth"
    wrong = board(square_mm=6.0)
    with pytest.raises(CalibrationError, match=r"1\.\d+ .* times their size .*of 6 mm would have to be (4\.9|5\.0)"):
        calibrate_detections(found, capture_of(CAMERAS, wrong, tmp_path, picks), scans)
    _, unchecked = calibrate_detections(found, capture_of(CAMERAS, wrong, tmp_path), scans)
    assert any("square_mm alone" in note for note in unchecked["notes"])
    scans, careless = picked(rng, noise_px=60.0)
    _, unsure = calibrate_detections(found, capture_of(CAMERAS, board(), tmp_path, careless), scans)
    assert unsure["scale"]["ratio"] is None and "too inaccurate" in unsure["scale"]["reason"]


@pytest.mark.slow
def test_advice_names_what_was_done_badly(tmp_path):
    rng, boards = np.random.default_rng(5), board()
    capture = capture_of(CAMERAS, boards, tmp_path)
    found = detections(CAMERAS, boards, poses(45, rng, CENTRE + [-8, -6, 0]), rng)
    well = calibrate_detections(found, capture, {})[1]
    assert not any("views of the board" in a or "mm from the mouth" in a for a in well["advice"])
    far = poses(20, rng, CENTRE + [0, 0, 90.0])
    advice = " ".join(calibrate_detections(detections(CAMERAS, boards, far, rng), capture, {})[1]["advice"])
    assert "uses 20 views" in advice and "mm from the mouth" in advice
    noisy = detections(CAMERAS, boards, poses(45, rng), rng, noise_px=0.8)
    advice = " ".join(calibrate_detections(noisy, capture, {})[1]["advice"])
    assert "px rms (a good value is below 0.5 px)" in advice and "% of the image" in advice


def test_one_camera_alone_is_calibrated(tmp_path):
    rng, boards = np.random.default_rng(6), board(videos=("a",))
    found = detections(CAMERAS[:1], boards, poses(20, rng), rng)
    cameras, report = calibrate_detections(found, capture_of(CAMERAS[:1], boards, tmp_path), {})
    assert cameras[0].K[0, 0] == pytest.approx(900, rel=0.01)
    assert report["board_shape"]["distances"] == 0 and np.isnan(report["expected_shape_mm"])


def test_a_capture_without_boards_is_refused(tmp_path):
    capture = capture_of(CAMERAS, board(), tmp_path).model_copy(update={"boards": None})
    with pytest.raises(CalibrationError, match=r"capture\.toml: has no \[boards\]"):
        calibrate_capture(capture, {}, print)


def test_world_is_the_first_camera(tmp_path):
    rng, boards = np.random.default_rng(7), board()
    found = detections(CAMERAS, boards, poses(40, rng), rng, noise_px=0.02)
    cameras, _ = calibrate_detections(found, capture_of(CAMERAS, boards, tmp_path), {})
    for a, b in zip(cameras, CAMERAS, strict=True):
        gap = a.T_cam_world @ se3_inverse(b.T_cam_world)
        assert np.degrees(Rotation.from_matrix(gap[:3, :3]).magnitude()) < 0.1
