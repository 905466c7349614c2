"""Clips whose pixels are not square: calibrated as stored, or as shown."""

import numpy as np
import pytest

from jawusd.base.errors import CalibrationError
from jawusd.cameras.calibration import save_calibration
from jawusd.geometry import Camera
from jawusd.media.writers import VideoWriter
from jawusd.pipeline.cameras import load_cameras
from jawusd.pipeline.workspace import open_capture

STORED = Camera("a", (64, 48), np.array([[50.0, 0, 30.0], [0, 100.0, 22.0], [0, 0, 1]]), np.zeros(0), np.eye(4))


@pytest.fixture
def folder(tmp_path):
    for name in ("u.ply", "l.ply"):
        (tmp_path / name).touch()
    with VideoWriter(tmp_path / "a.mp4", (64, 48), 24.0) as writer:
        for _ in range(3):
            writer.write(np.zeros((48, 64), np.uint8))
    return tmp_path


def cameras(folder, camera, more=""):
    save_calibration(folder / "cal.toml", [camera])
    (folder / "capture.toml").write_text(
        'format = "jawusd-capture/1"\nname = "x"\nfps = 24.0\ncalibration = "cal.toml"\n'
        f'[scans]\nupper_teeth = "u.ply"\nlower_teeth = "l.ply"\n[[camera]]\nname = "a"\nvideo = "a.mp4"\n{more}'
    )
    return load_cameras(open_capture(folder))


def test_a_calibration_of_the_widened_picture_fits_the_clip(folder):
    """A world point projects to the same place, at half the pixel width."""
    widened = STORED.scaled((128, 48))
    points = np.array([[0.1, -0.05, 1.0], [-0.2, 0.1, 1.3]])
    for calibrated in (widened, STORED):
        (found,) = cameras(folder, calibrated, "pixel_aspect = 2.0\n")
        assert found.size_px == (64, 48)
        assert np.allclose(found.project(points), STORED.project(points), atol=1e-9)


def test_without_the_aspect_it_is_another_shape(folder):
    with pytest.raises(CalibrationError, match="the aspect ratios differ"):
        cameras(folder, STORED.scaled((128, 48)))
