"""capture.toml and calibration.toml: what is read, and one clear error for each way they can be wrong."""

import cv2
import numpy as np
import pytest

from jawusd.base.errors import CalibrationError, CaptureError, FormatError, UnitsError, VersionError
from jawusd.cameras.calibration import load_calibration, save_calibration
from jawusd.formats.capture import load_capture

CAPTURE = """
format = "jawusd-capture/1"
name = "actor"
units = "mm"
fps = 24.0
calibration = "calibration.toml"
frames = [30, 90]
[scans]
upper_teeth = "upper.ply"
lower_teeth = "lower.ply"
[[camera]]
name = "cam0"
masks.upper = "masks/%06d.png"
masks.lower = "masks/l%06d.png"
[[camera]]
name = "cam1"
video = "cam1.mp4"
[sync]
method = "flash"
reference = "cam1"
[bootstrap]
frame = 30
[[bootstrap.upper]]
vertex = 3
views = [{ camera = "cam0", x = 1.5, y = 2.0 }, { camera = "cam1", x = 3, y = 4 }]
"""

CALIBRATION = """
[cam_0]
name = "left"
size = [1920, 1080]
matrix = [[2870.0, 0.0, 968.3], [0.0, 2860.0, 534.1], [0.0, 0.0, 1.0]]
distortions = [-0.03, 0.012, 0.0003, -0.0004, 0.0]
rotation = [0.1, -0.2, 0.3]
translation = [1.0, 2.0, 200.0]
[cam_1]
name = "right"
size = [1280, 720]
matrix = [[1900.0, 0.0, 640], [0.0, 1900.0, 360], [0.0, 0.0, 1.0]]
distortions = []
rotation = [0, 0, 0]
translation = [0, 0, 0]
[metadata]
error = 0.1
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "masks").mkdir()
    for name in ("upper.ply", "lower.ply", "cam1.mp4"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "calibration.toml").write_text(CALIBRATION)
    (tmp_path / "capture.toml").write_text(CAPTURE)
    return tmp_path


def edit(folder, old, new):
    text = (folder / "capture.toml").read_text()
    assert old in text
    (folder / "capture.toml").write_text(text.replace(old, new))


def test_a_capture_is_read_with_absolute_paths(folder):
    capture = load_capture(folder)
    assert capture.frames == (30, 90) and capture.reference == "cam1"
    assert capture.scans.upper_teeth == folder / "upper.ply" and capture.scans.mandible is None
    assert str(capture.cameras[0].masks.upper).endswith("masks/%06d.png")
    assert capture.bootstrap.upper[0].views[1].x == 3
    assert load_capture(folder / "capture.toml") == capture


@pytest.mark.parametrize(
    ("old", "new", "error", "words"),
    [
        ('jawusd-capture/1"', 'jawusd-capture/2"', VersionError, "Update jawusd"),
        ('"jawusd-capture/1"', '"other/1"', FormatError, 'expected "jawusd-capture/1"'),
        ('units = "mm"', 'units = "m"', UnitsError, 'must be "mm"'),
        ("fps = 24.0", "fps = -1", FormatError, "fps"),
        ("fps = 24.0", "fsp = 24.0", FormatError, "fsp"),
        ("frames = [30, 90]", "frames = [90, 30]", FormatError, "one past the last"),
        ('reference = "cam1"', 'reference = "cam7"', FormatError, "cameras are cam0, cam1"),
        ('camera = "cam1", x', 'camera = "cam9", x', FormatError, "cam9"),
        ('name = "cam1"', 'name = "cam0"', FormatError, "must be unique"),
        ('video = "cam1.mp4"', "", FormatError, "has neither video nor masks"),
        ('"upper.ply"', '"missing.ply"', CaptureError, "missing.ply"),
        ('masks.upper = "masks/', 'masks.upper = "nomasks/', CaptureError, "there is no folder"),
        ('"upper.ply"', '"../../../etc/hostname"', CaptureError, "--allow-outside"),
        ('"upper.ply"', '"/etc/hostname"', CaptureError, "--allow-outside"),
        ("[scans]", "[scans", FormatError, "not valid TOML"),
    ],
)
def test_each_fault_in_a_capture_is_named(folder, old, new, error, words):
    edit(folder, old, new)
    with pytest.raises(error, match=words.replace("[", r"\[")) as caught:
        load_capture(folder)
    assert "capture.toml" in str(caught.value)


def test_a_link_out_of_the_folder_is_refused_unless_allowed(folder):
    outside = folder.parent / "outside.ply"
    outside.write_bytes(b"x")
    (folder / "upper.ply").unlink()
    (folder / "upper.ply").symlink_to(outside)
    with pytest.raises(CaptureError, match="is outside"):
        load_capture(folder)
    assert load_capture(folder, allow_outside=True).scans.upper_teeth == folder / "upper.ply"


@pytest.mark.parametrize("target", ["/dev/zero", "../outside.png", "missing/../../outside.png"])
def test_a_mask_that_links_out_of_the_folder_is_refused_unless_allowed(target, folder):
    (folder / "masks" / "000000.png").write_bytes(b"x")
    (folder / "masks" / "000001.png").symlink_to("000000.png")
    assert load_capture(folder)
    (folder / "masks" / "000007.png").symlink_to(target if target[0] == "/" else f"../{target}")
    with pytest.raises(CaptureError, match="000007.png leads outside"):
        load_capture(folder)
    assert load_capture(folder, allow_outside=True)


def test_missing_capture_is_one_error(tmp_path):
    with pytest.raises(FormatError, match="no such file"):
        load_capture(tmp_path / "nothing")


def test_calibration_reads_opencv_rodrigues(folder):
    left, right = load_calibration(folder / "calibration.toml")
    expected = cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0]
    np.testing.assert_allclose(left.T_cam_world[:3, :3], expected, atol=1e-12)
    assert left.name == "left" and right.size_px == (1280, 720) and right.distortion.size == 0


def test_calibration_round_trip(folder, tmp_path):
    cameras = load_calibration(folder / "calibration.toml")
    save_calibration(tmp_path / "again.toml", cameras)
    for a, b in zip(cameras, load_calibration(tmp_path / "again.toml"), strict=True):
        np.testing.assert_array_equal(a.K, b.K)
        np.testing.assert_allclose(a.T_cam_world, b.T_cam_world, atol=1e-14)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("rotation = [0.1, -0.2, 0.3]", "rotation = [[1.0,0,0],[0,1.1,0],[0,0,1]]", "not orthonormal"),
        ("rotation = [0.1, -0.2, 0.3]", "rotation = [[1.0,0,0],[0,1,0],[0,0,-1]]", "not orthonormal"),
        ("rotation = [0.1, -0.2, 0.3]", "rotation = [0.1, -0.2]", "shape"),
        ("rotation = [0.1, -0.2, 0.3]", "", 'no "rotation"'),
        ("translation = [1.0, 2.0, 200.0]", "translation = [1.0, nan, 200.0]", "not finite"),
        ("[2870.0, 0.0, 968.3]", "[-2870.0, 0.0, 968.3]", "fx, fy > 0"),
        ("size = [1920, 1080]", "size = [1920.5, 1080]", "whole numbers"),
        ("distortions = [-0.03, 0.012, 0.0003, -0.0004, 0.0]", 'distortions = ["a"]', "not an array of numbers"),
        ('name = "right"', 'name = "left"', "same name"),
        ("[cam_0]\nname", "[cam_0]\nfisheye = true\nname", "fisheye"),
    ],
)
def test_each_fault_in_a_calibration_is_named(folder, old, new, words):
    path = folder / "calibration.toml"
    assert old in CALIBRATION
    path.write_text(CALIBRATION.replace(old, new))
    with pytest.raises(CalibrationError, match=words):
        load_calibration(path)


def test_a_file_without_cameras_is_no_calibration(tmp_path):
    (tmp_path / "c.toml").write_text("[metadata]\n")
    with pytest.raises(CalibrationError, match="no camera tables"):
        load_calibration(tmp_path / "c.toml")
