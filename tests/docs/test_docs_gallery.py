"""The pictures of the gallery: made by its program from the example, all shown on its page, and small."""

import os
import re

import av
import numpy as np
import pytest
from foreign import environment
from load_script import load_script
from package_copy import ROOT
from PIL import Image

import jawusd
from jawusd.formats.mesh import TOUCHING
from jawusd.rig.layout import EXAMPLE_RIG

FOLDER = ROOT / "docs" / "gallery"
MOST_BYTES = 2_000_000


@pytest.fixture(scope="module")
def gallery():
    return load_script(ROOT / "docs" / "make_gallery.py")


def pixels(path):
    """Return a picture as RGB floats (h, w, 3)."""
    return np.asarray(Image.open(path).convert("RGB"), dtype=float)


def frame_of(picture, frame):
    """Return a frame of an animation as RGB floats (h, w, 3)."""
    picture.seek(frame)
    return np.asarray(picture.convert("RGB"), dtype=float)


def near(picture, color, within=24.0):
    """Return the share of pixels of a colour, those that packing has changed a little included."""
    return float((np.abs(picture - np.array(color)).max(axis=-1) < within).mean())


def test_pages_show_every_picture_and_each_has_its_function(gallery):
    pages = "".join(path.read_text() for path in (ROOT / "docs").rglob("*.md"))
    shown = set(re.findall(r"gallery/(\w+)\.(?:webp|mp4)", pages))
    stored = sorted(path.stem for path in FOLDER.iterdir())
    assert sorted(shown) == stored == sorted(gallery.PICTURES)
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) < MOST_BYTES


def test_the_jaw_on_the_first_page_moves_in_a_loop(gallery):
    with Image.open(FOLDER / "jaw.webp") as picture:
        assert picture.n_frames == len(range(*gallery.JAW_FRAMES, gallery.STEP)) and picture.info["loop"] == 0
        closed, opened = (frame_of(picture, frame) for frame in (0, 9))
    assert np.abs(closed - opened).mean() > 5
    for page in ("README.md", "docs/index.md"):
        assert re.search(r"\]\((docs/)?gallery/jaw\.webp\)", (ROOT / page).read_text())


def test_the_border_is_where_the_bound_ends(example_build, gallery):
    rig = jawusd.load(example_build[0] / "actor.usda")
    edge = gallery.border(rig, openings=9, ways=12)
    assert np.abs(rig.margin(edge[1:-1])).max() < 0.05
    moved = gallery.incisal_point(rig, np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [5.0, 2.0, 0.0]]))
    assert np.abs(moved[0]).max() < 1e-9
    assert moved[1, 1] < -8 and moved[2, 0] > 1


def test_contacts_are_marked_where_teeth_meet_and_nowhere_else(example_build, gallery, tmp_path):
    picture = pixels(gallery.contacts(example_build[0], tmp_path))
    closed, gliding = np.split(picture[:-44], 2)  # without the legend
    yellow = TOUCHING[-1].color
    assert near(closed, yellow) > 3 * near(gliding, yellow) > 0


def test_envelope_is_drawn_as_a_surface_with_the_captured_line(example_build, gallery, tmp_path):
    picture = pixels(gallery.envelope(example_build[0], tmp_path))
    assert picture.shape[1] == 1200
    assert near(picture, (255, 255, 255)) > 0.4
    assert near(picture, (213, 94, 0), 60) > 0.002  # vermilion


CURVES = {"keys": (0, 114, 178), "arkit": (0, 158, 115), "sparse_keys": (213, 94, 0), "poses": (86, 180, 233)}


@pytest.mark.parametrize(("name", "colour"), CURVES.items(), ids=list(CURVES))
def test_charts_of_a_rig_are_drawn(example_build, gallery, tmp_path, name, colour):
    picture = pixels(gallery.PICTURES[name](example_build[0], tmp_path))
    assert near(picture, (255, 255, 255)) > 0.4
    assert near(picture, colour, 60) > 0.001


def test_heads_and_models_are_drawn(example_build, gallery, tmp_path):
    head, model = (pixels(gallery.PICTURES[name](example_build[0], tmp_path)) for name in ("head", "model"))
    bone, gum = (200, 182, 150), (195, 120, 120)
    assert near(head, bone, 40) > 0.02 < near(head, gum, 40)
    assert model[..., 1].std() > 40  # from dark to bright


@pytest.mark.slow
def test_pictures_of_footage_report_and_phone(example_build, gallery, tmp_path):
    first = gallery.FOOTAGE_FRAMES[0]
    outlines = pixels(gallery.footage(example_build[0], tmp_path, frames=(first, first + 4)))
    assert near(outlines, (0, 200, 255), 60) > 0.001
    try:
        report, phone = (pixels(make(example_build[0], tmp_path)) for make in (gallery.report, gallery.phone))
    except gallery.NotInstalledError as needed:
        pytest.skip(str(needed))
    assert report.std() > 20
    assert near(phone, (236, 229, 212), 40) > 0.005  # enamel


@pytest.mark.slow
def test_condyles_overlay_and_viewer(example_build, gallery, tmp_path):
    assert pixels(gallery.condyles(example_build[0], tmp_path)).std() > 20
    with av.open(str(gallery.overlay(example_build[0], tmp_path, frames=4 * gallery.STEP))) as video:
        frames = [frame.to_ndarray(format="rgb24").astype(float) for frame in video.decode(video=0)]
    assert len(frames) == 4
    assert all(near(frame, (0, 200, 255), 60) > 0.001 for frame in frames)  # outlines of the lower teeth
    try:
        picture = pixels(gallery.viewer(example_build[0], tmp_path))
        keyed = pixels(gallery.pose_page(example_build[0], tmp_path))
        moving = Image.open(gallery.jaw(example_build[0], tmp_path, step=40))
    except gallery.NotInstalledError as needed:
        pytest.skip(str(needed))
    assert near(picture, (236, 229, 212), 40) > 0.005  # enamel
    assert near(keyed, (0, 158, 115)) > 0.005  # the strip
    assert moving.n_frames == 3 and moving.size == gallery.JAW_PX
    assert all(near(frame_of(moving, frame), (236, 229, 212), 40) > 0.005 for frame in range(3))


@pytest.mark.slow
def test_blender_moves_the_jaw(example_build, gallery, tmp_path):
    environment("blender45")
    path = gallery.blender(example_build[0], tmp_path, frames=2 * gallery.STEP)
    with av.open(str(path)) as video:
        frames = [frame.to_ndarray(format="rgb24").astype(float) for frame in video.decode(video=0)]
    assert len(frames) == 2
    assert np.abs(frames[0] - frames[1]).max() > 40


def test_the_rig_that_ships_is_that_of_the_build(example_build, tmp_path):
    script = load_script(ROOT / "docs" / "make_example_rig.py")
    script.make(example_build[0], tmp_path)
    shipped = {file.name: file.stat().st_size for file in EXAMPLE_RIG.parent.iterdir()}
    made = {file.name: file.stat().st_size for file in tmp_path.iterdir()}
    assert set(made) == set(shipped) and sum(made.values()) == pytest.approx(sum(shipped.values()), rel=0.1)
    rigs = [jawusd.load(actor) for actor in (tmp_path / EXAMPLE_RIG.name, EXAMPLE_RIG)]
    np.testing.assert_allclose(rigs[0].d_range, rigs[1].d_range, atol=1.0)


def test_what_is_missing_is_named(example_build, gallery, tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("JAWUSD_INTEROP", raising=False)
    command = ["make_gallery.py", str(example_build[0]), "--only", "blender", "-o", str(tmp_path)]
    monkeypatch.setattr("sys.argv", command)
    assert gallery.main() == 1
    assert "blender: not made, needs Blender: python tests/interop/make_environments.py" in capsys.readouterr().out
    assert os.listdir(tmp_path) == []
