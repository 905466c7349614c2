"""The command photos: from pictures of closed teeth to bite and overlays."""

import json

import cv2
import numpy as np
import pytest
import trimesh
from closed_mouth import VIEWS, Mouth, search_little
from typer.testing import CliRunner

from jawusd.base.errors import CaptureError, OutputError, TrackingError
from jawusd.cli.main import app
from jawusd.photographs.align import read_drawing


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def mouth():
    return Mouth(9)


@pytest.fixture
def files(mouth, tmp_path):
    """Write drawings and scans; return the arguments that name them."""
    for view in ("front", "left"):
        cv2.imwrite(str(tmp_path / f"{view}.png"), mouth.draw(VIEWS[view]))
    scans = []
    for row, mesh in zip(("upper", "lower"), mouth.with_gum()):
        path = tmp_path / f"{row}.ply"
        trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.colors, process=False).export(path)
        scans += [f"--{row}-teeth", path]
    return [tmp_path / "front.png", tmp_path / "left.png", *scans, "-o", tmp_path / "out"]


@pytest.mark.slow
def test_photos_writes_the_bite_and_pictures(mouth, files, tmp_path, monkeypatch):
    search_little(monkeypatch)
    told = json.loads(run("photos", *files, "--json").stdout)
    written = json.loads((tmp_path / "out" / "photos.json").read_text())
    assert written["format"] == "jawusd-photos/1" and {**written, "file": told["file"]} == told
    assert mouth.off_mm(np.array(written["T_upper_lower"])) < 0.3
    assert [photo["name"] for photo in written["photos"]] == ["front", "left"]
    for view in ("front", "left"):
        overlay, drawn = (cv2.imread(str(path)) for path in (tmp_path / "out" / f"overlay_{view}.png", files[0]))
        assert overlay.shape == drawn.shape
        assert np.count_nonzero(overlay[..., 0] != overlay[..., 1]) > 1000  # coloured outlines
    again = run("photos", *files)
    assert isinstance(again.exception, OutputError) and "--force" in str(again.exception)


def test_pictures_that_cannot_be_used_are_named(files, tmp_path):
    front, left, *rest = files
    twice = run("photos", front, tmp_path / ".." / tmp_path.name / "front.png", *rest)
    assert isinstance(twice.exception, CaptureError) and 'have the name "front"' in str(twice.exception)
    absent = run("photos", tmp_path / "none.png", *rest)
    assert isinstance(absent.exception, CaptureError) and "none.png" in str(absent.exception)
    cv2.imwrite(str(left), np.zeros((300, 400), np.uint8))
    black = run("photos", left, *rest)
    assert isinstance(black.exception, TrackingError) and "left: the drawn lines cover 0 px" in str(black.exception)
    assert not (tmp_path / "out").exists()
    assert run("photos", front).exit_code == 2


def test_areas_are_taken_by_their_borders():
    areas = np.zeros((300, 400), np.uint8)
    areas[50:250, 60:200], areas[50:250, 200:340] = 1, 2
    lines = read_drawing(areas, "areas")
    x, y = lines.pixels.T
    on = np.minimum.reduce(
        [np.abs(x - 59.5), np.abs(x - 199.5), np.abs(x - 339.5), np.abs(y - 49.5), np.abs(y - 249.5)]
    )
    assert np.percentile(on, 95) < 0.8 and len(x) > 800
