"""Captures without a calibration, with masks only, and captures that the viewer cannot show."""

import shutil

import numpy as np
import pytest
from quiet_capture_page import QuietCapturePage
from short_example import write_short
from typer.testing import CliRunner
from viewed_example import copy_example, quiet, write_true_tracks

from jawusd.base.errors import CaptureError, FormatError
from jawusd.cli.main import app
from jawusd.pipeline.view_capture import viewed_capture
from jawusd.viewer.capture_page import CaptureViewer


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    return copy_example(tmp_path_factory.mktemp("viewed") / "capture")


def test_a_capture_without_calibration_still_shows_its_footage(copy, tmp_path):
    folder = shutil.copytree(copy, tmp_path / "capture")
    path = folder / "capture.toml"
    path.write_text(path.read_text().replace('calibration = "calibration.toml"\n', ""))
    seen = viewed_capture(folder, None, quiet)
    assert seen.cameras == {} and seen.tracks is None and seen.frames == (20, 319)
    viewer = CaptureViewer(seen, "127.0.0.1", 0)
    opened = QuietCapturePage(viewer)
    opened.settle()
    assert "3-D" not in opened.page.footage.views.options and opened.notices == []
    viewer.stop()


def test_bad_captures_and_foreign_tracks_are_clear_errors(copy, tmp_path):
    with pytest.raises(FormatError, match="no such file"):
        viewed_capture(tmp_path / "capture.toml", None, quiet)
    tracks = write_true_tracks(tmp_path / "tracks.npz", ("cam0", "cam1", "left"))
    with pytest.raises(FormatError, match="use the cameras cam0, cam1, left; the capture has cam0, cam1, cam2"):
        viewed_capture(copy, tracks, quiet)
    folder = shutil.copytree(copy, tmp_path / "capture")
    path = folder / "capture.toml"
    text = path.read_text()
    path.write_text(text.replace('video = "video/cam0.mp4"', 'video = "calibration.toml"'))
    with pytest.raises(CaptureError):
        viewed_capture(path, None, quiet)
    result = CliRunner().invoke(app, ["view", str(tmp_path), "--tracks", str(tracks)])
    assert result.exit_code == 2 and "--tracks needs a capture" in result.output


def test_a_capture_of_masks_alone_is_shown(tmp_path):
    shown = viewed_capture(write_short(tmp_path, 12), None, quiet)
    assert shown.frames == (20, 31) and list(shown.sizes_px) == ["cam0", "cam1", "cam2"]
    picture = shown.picture("cam0", 22, None, "outlines")
    y, x = np.nonzero(picture[..., 0] > 100)
    x0, y0, x1, y1 = shown.teeth_region("cam0", 22)
    assert x.min() < x0 + 2 and x.max() > x1 - 2 and y.min() < y0 + 2 and y.max() > y1 - 2
    assert (picture == picture[..., :1]).all()
    assert shown.wall(22, None, "outlines").shape == (*shown.all_cameras.size_px[::-1], 3)
