"""Undistorted plates: a world point appears where a pinhole camera projects it, in the plate of the right frame."""

import shutil

import cv2
import numpy as np
import pytest
from run_jawusd import program

from jawusd.cameras.calibration import save_calibration
from jawusd.geometry import Camera, make_transform
from jawusd.media.writers import VideoWriter
from jawusd.pipeline.pictures import write_plates
from jawusd.pipeline.workspace import open_capture
from jawusd.rig.cameras import PLATE

SIZE = (320, 240)
K = np.array([[300.0, 0, 155], [0, 290, 118], [0, 0, 1]])
CAMERAS = [
    Camera("left", SIZE, K, np.array([-0.25, 0.08, 0.002, -0.001, 0]), make_transform(np.eye(3), [-6, 0, 150.0])),
    Camera("right", SIZE, K, np.zeros(5), make_transform(np.eye(3), [6, 0, 150.0])),
]
OFFSETS = {"left": 0, "right": 4}
FRAMES = np.arange(3, 9)


def point(frame):
    """Return the position of a bright ball at a reference frame, in a corner of the picture: world [mm]."""
    return np.array([48.0 - 2 * frame, 38.0, 4.0])


@pytest.fixture
def capture(tmp_path):
    folder = tmp_path / "capture"
    folder.mkdir()
    for name in ("upper.ply", "lower.ply"):
        (folder / name).write_text("ply\n")
    save_calibration(folder / "calibration.toml", CAMERAS)
    for camera in CAMERAS:
        with VideoWriter(folder / f"{camera.name}.mp4", SIZE, 25.0, quality_crf=2) as out:
            for own in range(12):
                picture = np.full((SIZE[1], SIZE[0], 3), 40, np.uint8)
                centre = camera.project(point(own + OFFSETS[camera.name])[None])[0]
                cv2.circle(picture, np.round(centre * 16).astype(int).tolist(), 5 * 16, (250,) * 3, -1, shift=4)
                out.write(picture)
    cameras = "".join(f'[[camera]]\nname = "{c.name}"\nvideo = "{c.name}.mp4"\n' for c in CAMERAS)
    (folder / "capture.toml").write_text(
        'format = "jawusd-capture/1"\nname = "ball"\nunits = "mm"\nfps = 25.0\ncalibration = "calibration.toml"\n'
        '[scans]\nupper_teeth = "upper.ply"\nlower_teeth = "lower.ply"\n' + cameras
    )
    return folder


def ball_px(path):
    """Return the centre of the bright ball of a picture [px]."""
    weight = np.clip(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(float) - 100, 0, None)
    y, x = np.mgrid[: weight.shape[0], : weight.shape[1]]
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


def test_plates_show_what_a_pinhole_camera_sees(capture, tmp_path):
    told = []
    patterns = write_plates(
        open_capture(capture), OFFSETS, FRAMES, tmp_path / "rig", lambda name, done, total: told.append((done, total))
    )
    assert patterns == ["plates/left/left.%06d.jpg", "plates/right/right.%06d.jpg"] and told[-1] == (12, 12)
    for camera in CAMERAS:
        for frame in FRAMES:
            path = tmp_path / "rig" / (PLATE.format(name=camera.name) % frame)
            if frame < OFFSETS[camera.name]:
                assert not path.exists()  # the camera was not recording yet
                continue
            expected = camera.project_pinhole(point(frame)[None])[0]
            assert np.abs(ball_px(path) - expected).max() < 0.25
    bent = np.abs(CAMERAS[0].project(point(5)[None]) - CAMERAS[0].project_pinhole(point(5)[None])).max()
    assert bent > 1  # so that the test would detect distorted footage


def test_the_command_needs_a_built_rig(capture, tmp_path):
    shutil.copytree(capture, tmp_path / "copy")
    done = program("plates", tmp_path / "copy", tmp_path / "no_rig")
    assert done.returncode == 3 and "tracks.npz" in done.stderr


def test_plates_of_light_are_light(capture, tmp_path):
    """The same ball as EXR, far above white, is undistorted and keeps its brightness."""
    from clip_files import write_picture

    from jawusd.media.pictures import read_stored
    from jawusd.media.video import Video
    from jawusd.rig.cameras import LIGHT_PLATE

    pictures = [frame.image for frame in Video(capture / "left.mp4").frames(colour="rgb")]
    for number, image in enumerate(pictures, 1001):
        write_picture(capture / "exr" / f"left.{number}.exr", image, "exr")
    text = (capture / "capture.toml").read_text().replace('"left.mp4"', '"exr/left.####.exr"')
    (capture / "capture.toml").write_text(text)
    opened = open_capture(capture)
    patterns = write_plates(opened, OFFSETS, FRAMES, tmp_path / "rig", lambda *_: None)
    assert patterns == [LIGHT_PLATE.format(name="left"), PLATE.format(name="right")]
    for frame in FRAMES:
        light = read_stored(tmp_path / "rig" / (patterns[0] % frame))[0].astype(np.float32)
        weight = np.clip(light.mean(-1) - 0.2, 0, None)
        y, x = np.mgrid[: weight.shape[0], : weight.shape[1]]
        centre = np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
        assert np.abs(centre - CAMERAS[0].project_pinhole(point(frame)[None])[0]).max() < 0.25
        assert light.max() == pytest.approx((250 / 255) ** 2.2, abs=0.03)
