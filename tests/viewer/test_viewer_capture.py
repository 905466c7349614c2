"""The viewer's input of a capture, and its page without a browser."""

import asyncio
import shutil
import threading
import time
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import viser
from browser_tab import until
from quiet_capture_page import QuietCapturePage
from viewed_example import FIRST, STOP, copy_example, quiet, truth, write_true_tracks
from viser._messages import FileTransferStartUpload

from jawusd.formats.capture import load_capture
from jawusd.formats.performance import STATE_COLOURS, SolvedJaw, SolveState
from jawusd.formats.tracks import load_tracks, save_tracks
from jawusd.geometry import matrix_from_wxyz, transform_point, transform_points
from jawusd.pipeline.view_capture import viewed_capture
from jawusd.viewer.capture_page import CaptureViewer
from jawusd.viewer.capture_scene import UP


def with_method(viewed, **functions):
    """Return a copy of a capture to view, with other methods."""
    changed = replace(viewed)
    vars(changed).update(functions)
    return changed


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    return copy_example(tmp_path_factory.mktemp("viewed") / "capture")


@pytest.fixture(scope="module")
def viewed(copy, tmp_path_factory):
    return viewed_capture(copy, write_true_tracks(tmp_path_factory.mktemp("tracks") / "tracks.npz"), quiet)


@pytest.fixture
def page(viewed):
    viewer = CaptureViewer(viewed, "127.0.0.1", 0)
    opened = QuietCapturePage(viewer)
    opened.settle()
    yield opened
    viewer.stop()


def test_the_scene_is_lit_without_an_environment_map(viewed, monkeypatch):
    maps, skies = [], []
    scene = viser.SceneApi
    monkeypatch.setattr(scene, "configure_environment_map", lambda self, chosen: maps.append(chosen))
    add = scene.add_light_hemisphere
    monkeypatch.setattr(
        scene, "add_light_hemisphere", lambda *given, **how: skies.append(how["wxyz"]) or add(*given, **how)
    )
    viewer = CaptureViewer(viewed, "127.0.0.1", 0)
    QuietCapturePage(viewer).settle()
    viewer.stop()
    assert maps == [None]
    assert np.allclose(matrix_from_wxyz(np.array(skies)) @ [0.0, 1.0, 0.0], UP)  # light comes from above


def test_pages_of_captures_take_no_files(page):
    widget = next(iter(page.client.gui._gui_input_handle_from_uuid))
    message = FileTransferStartUpload(widget, "transfer", "capture.toml", "text/plain", 2, 100)
    api = page.client.gui

    async def send():
        await api._websock_interface._handle_incoming_message(0, message)

    asyncio.run_coroutine_threadsafe(send(), page.loop).result(60)
    assert api._current_file_upload_states == {} and "does not accept that file" in page.notices[-1][1]


def test_the_capture_is_read_with_its_poses(viewed):
    assert viewed.frames == (FIRST, STOP - 1) and list(viewed.sizes_px) == ["cam0", "cam1", "cam2"]
    plain = viewed.picture("cam0", FIRST, None, "outlines")
    drawn = viewed.picture("cam0", FIRST, viewed.tracked_poses(FIRST), "outlines")
    changed = np.argwhere((plain != drawn).any(axis=2))
    low, high = changed.min(axis=0), changed.max(axis=0)
    x0, y0, x1, y1 = viewed.teeth_region("cam0", FIRST)
    assert low[1] < x0 + 8 and high[1] > x1 - 8 and low[0] < y0 and high[0] > y1  # lips hide part of the drawing
    assert viewed.picture("cam0", 10_000, None, "outlines").std() == 0  # not recording: gray
    assert viewed.tracked_poses(FIRST - 1) is None


def test_poses_of_picks_are_near_the_truth(viewed):
    poses, wrong = viewed.poses_of_picks(viewed.source.bootstrap)
    known = truth()
    assert wrong == []
    for found, name, arch in zip(poses, ("T_world_upper", "T_world_lower"), ("upper", "lower"), strict=True):
        vertices = viewed.scans[arch].vertices
        error = transform_points(found, vertices) - transform_points(known[name][0], vertices)
        assert np.linalg.norm(error, axis=1).mean() < 1.0


def test_stepping_jumping_and_looking(page):
    footage = page.page.footage
    page.press(footage.steps, "+1")
    assert footage.frame == FIRST + 1 and footage.slider.value == FIRST + 1
    page.press(footage.steps, "-10")
    assert footage.frame == FIRST
    page.press(footage.slider, FIRST + 9)
    assert f"frame {FIRST + 9}" in footage._words.content
    page.press(footage.jumps, "next worse")
    assert footage.frame == FIRST + 7  # lost frames come first
    assert "lower: lost, matched contour 31% of the usual" in footage._words.content
    page.press(footage.jumps, "next worse")
    assert footage.frame in footage.worst[1:2]
    page.press(footage.jumps, "previous")
    assert footage.frame == FIRST + 7
    page.press(footage.views, "3-D")
    scene = page.page.scene
    assert scene._space.visible and not scene._layout.visible
    assert scene._arches["upper"].visible and not scene._arches["lower"].visible
    page.press(footage.views, "cam1")
    assert scene._layout.visible and "cam1" in footage._words.content
    page.press(footage._look, "footage alone")
    own = FIRST + 7 - page.page._capture.offsets["cam1"]
    assert f"(frame {own} of this camera)" in footage._words.content
    assert page.notices == []


def test_all_cameras_stand_side_by_side(page):
    footage, capture = page.page.footage, page.page._capture
    page.press(footage.views, "all cameras")
    assert "all cameras" in footage._words.content and "of this camera" not in footage._words.content
    width, height = capture.all_cameras.size_px
    assert page.page.scene._picture.image.shape == (height, width, 3) and page.page.layout.size_px == (width, height)
    drawn, bare = (capture.wall(FIRST, capture.tracked_poses(FIRST), look) for look in ("outlines", "footage"))
    changed = (drawn != bare).any(axis=2)
    for part in np.array_split(changed, 3, axis=1):  # teeth are drawn well inside each camera's part
        y, x = np.argwhere(part).min(axis=0), np.argwhere(part).max(axis=0)
        assert (y > 20).all() and (x < np.array(part.shape) - 20).all() and part.sum() > 500
    page.press(page.page.picks.picking, True)  # picking is disabled in this view
    before = len(page.page.picks.book.picks)
    page.click(page.page.layout.place((width / 2, height / 2)))
    assert len(page.page.picks.book.picks) == before and page.page.poses == {} and page.notices == []
    page.press(footage.views, "cam1")
    assert page.page.layout.size_px == capture.sizes_px["cam1"]


def test_cameras_are_shown_as_they_are_decoded(viewed):
    wall, shown = viewed.wall, []
    held = threading.Event()
    backdrops = viewed.backdrops
    late = backdrops["cam1"]

    class Late:
        """A camera whose picture arrives last."""

        is_footage = True

        def picture(self, frame):
            held.wait(60)
            return late.picture(frame)

    def seen(image):
        shown.append(image)
        held.set()

    backdrops["cam1"] = Late()
    try:
        whole = wall(FIRST, None, "footage", seen)
    finally:
        backdrops["cam1"] = late
    first, same = np.array_split(shown[0], 3, axis=1), np.array_split(whole, 3, axis=1)
    assert [np.array_equal(a[40:], b[40:]) for a, b in zip(first, same, strict=True)] == [True, False, True]
    np.testing.assert_array_equal(whole, viewed.wall(FIRST, None, "footage"))


def test_a_picture_that_takes_long_is_said_to_be_loading(viewed):
    held = threading.Event()

    def late(*given):
        held.wait(60)
        return viewed.picture(*given)

    viewer = CaptureViewer(with_method(viewed, picture=late), "127.0.0.1", 0)
    opened = QuietCapturePage(viewer)
    words = opened.page.footage._words
    until(lambda: "loading" in words.content)
    held.set()
    opened.settle()
    assert "loading" not in words.content
    viewer.stop()


def test_widgets_that_do_not_apply_are_off(page):
    picks, labels, footage = page.page.picks, page.page.labels, page.page.footage

    def off():
        widgets = {"picking": picks.picking, "sides": picks.sides, "pick": picks.chosen, "edit": picks.edit}
        widgets |= {"go": picks.go, "write": picks.write, "paint": labels.kinds, "radius": labels.radius}
        return {name for name, widget in widgets.items() if widget.disabled or not widget.visible}

    brush = {"paint", "radius"}
    page.press(picks.picking, False)
    assert off() == {"sides", *brush}
    page.press(picks.picking, True)
    assert off() == brush
    page.press(footage.views, "all cameras")
    assert off() == {"picking", "sides", *brush}
    page.press(footage.views, "cam0")
    page.press(picks.edit, "pick")
    page.press(picks.edit, "all")
    assert off() == {"pick", "edit", "go", "write", *brush}
    page.press(labels.painting, True)
    assert off() == {"pick", "edit", "go", "write"} and labels.undo.disabled


def test_playing_leaves_out_pictures_instead_of_falling_behind(viewed):
    drawn = []

    def slowly(frame, poses, look, partly):
        time.sleep(0.25)  # six frames
        drawn.append(frame)
        assert partly is None or not opened.page.footage.player.playing
        return viewed.wall(frame, poses, look)

    viewer = CaptureViewer(with_method(viewed, wall=slowly), "127.0.0.1", 0)
    opened = QuietCapturePage(viewer)
    opened.settle()
    footage = opened.page.footage
    opened.press(footage.views, "all cameras")
    opened.enter(footage.loop, False)
    opened.enter(footage.play, True)
    assert footage.player.playing and footage.play.label == "pause"
    until(lambda: not footage.player.playing)  # playback stops at the end
    until(lambda: not opened.page.busy)
    assert footage.frame == footage.slider.value == drawn[-1] == viewed.frames[1] and footage.play.label == "play"
    assert sorted(drawn) == drawn and len(drawn) < 0.5 * (STOP - FIRST)
    opened.enter(footage.play, True)  # playback restarts; choosing a frame stops it
    until(lambda: drawn[-1] < FIRST + 20)
    opened.enter(footage.slider, FIRST + 3)
    until(lambda: not opened.page.busy)
    assert not footage.player.playing and footage.frame == drawn[-1] == FIRST + 3 and opened.notices == []
    viewer.stop()


def test_a_solve_is_shown_with_its_states(viewed, copy, tmp_path):
    tracks = load_tracks(write_true_tracks(tmp_path / "take.npz"))
    count = STOP - FIRST
    tracks.T_world_lower[7] = tracks.T_world_upper[7]
    tracks.T_upper_lower[7] = np.eye(4)
    state, valid = np.ones(count, np.int8), np.ones(count, bool)
    state[7], valid[20] = SolveState.CARRIED, False
    sigma = np.full((count, 3), 0.05)
    sigma[7] = 1.25
    tracks.solved = SolvedJaw(np.full((count, 3), [10.0, -2.0, 0.5]), sigma, np.where(valid, 1.0, -0.75), state, valid)
    save_tracks(tmp_path / "take.npz", tracks)
    shown = viewed_capture(copy, tmp_path / "take.npz", quiet)
    viewer = CaptureViewer(shown, "127.0.0.1", 0)
    opened = QuietCapturePage(viewer)
    opened.settle()
    footage = opened.page.footage
    assert footage.worst[:2] == [FIRST + 20, FIRST + 7]  # invalid poses first, then unobserved ones
    words = footage._words.content
    assert "upper: solved from the images" in words and "d1 opening 10.00 &plusmn; 0.05 mm" in words
    opened.press(footage.slider, FIRST + 20)
    assert "bound: outside, margin -0.75 mm: <b>invalid for the rig" in footage._words.content
    opened.press(footage.slider, FIRST + 7)
    assert "lower: hidden" in footage._words.content and "1.25 mm" in footage._words.content
    poses = shown.tracked_poses(FIRST + 7)
    picture = shown.picture("cam0", FIRST + 7, poses, "outlines").reshape(-1, 3).astype(int)
    counts = {s: np.count_nonzero((picture == colour).all(axis=1)) for s, colour in STATE_COLOURS.items()}
    assert counts[SolveState.SOLVED] > 500 and counts[SolveState.CARRIED] > 500 and counts[SolveState.LOST] == 0
    viewer.stop()


def test_scans_in_space_stand_where_the_cameras_see_them(page):
    page.press(page.page.footage.views, "3-D")
    scene, capture = page.page.scene, page.page._capture
    poses = capture.tracked_poses(FIRST)
    np.testing.assert_allclose(page.page.poses["upper"], scene.T_page_world @ poses[0], atol=1e-12)
    np.testing.assert_allclose(scene._arches["upper"].position, (scene.T_page_world @ poses[0])[:3, 3], atol=1e-9)


def test_picks_are_clicked_and_written(page, copy, viewed):
    picks, footage = page.page.picks, page.page.footage
    before = load_capture(copy).bootstrap
    page.press(picks.edit, "all")
    page.press(picks.picking, True)
    page.click(page.page.layout.place((5.0, 5.0)))
    assert "no pick is selected" in page.notices.pop()[1]
    for arch, pick in [("upper", p) for p in before.upper] + [("lower", p) for p in before.lower]:
        vertex = viewed.scans[arch].vertices[pick.vertex]
        page.click(transform_point(page.page.poses[arch], vertex))
    assert len(picks.book.picks) == 8
    known = truth()
    poses = {arch: known[f"T_world_{arch}"][0] for arch in ("upper", "lower")}
    for camera in ("cam0", "cam2"):
        page.press(footage.views, camera)
        for pick in picks.book.picks:
            place = transform_point(poses[pick.arch], viewed.scans[pick.arch].vertices[pick.vertex])
            page.click(page.page.layout.place(viewed.cameras[camera].project(place)))
    assert "the picks are consistent" in picks._list.content and "complete" in picks._list.content
    page.press(footage.steps, "+1")
    page.click(page.page.layout.place((5.0, 5.0)))
    assert f"belong to frame {FIRST}, not {FIRST + 1}" in page.notices.pop()[1]
    page.enter(picks.go, True)
    assert footage.frame == FIRST
    page.enter(picks.write, True)
    assert page.notices.pop()[0] == "Written"
    written = load_capture(copy).bootstrap
    assert written == picks.book.bootstrap() and written != before
    page.press(picks.edit, "pick")
    page.enter(picks.write, True)  # three per arch are enough
    assert page.notices.pop()[0] == "Written"
    page.press(picks.edit, "all")
    page.enter(picks.write, True)
    assert "picks are incomplete" in page.notices.pop()[1]


def test_a_page_with_old_picks_does_not_overwrite_new_ones(viewed, copy, tmp_path):
    folder = shutil.copytree(copy, tmp_path / "capture")
    viewer = CaptureViewer(viewed_capture(folder, None, quiet), "127.0.0.1", 0)
    one, other = QuietCapturePage(viewer, 0), QuietCapturePage(viewer, 1)
    for opened in (one, other):
        opened.settle()
    assert one.page.picks.picking.value and "the picks are consistent" in one.page.picks._list.content
    one.press(one.page.picks.chosen, "U1")
    one.press(one.page.footage.steps, "+1")
    assert other.page.picks.book.selected is None and other.page.footage.frame == one.page.footage.frame - 1
    one.press(one.page.picks.edit, "pick")
    assert len(one.page.picks.book.picks) == len(other.page.picks.book.picks) - 1
    one.enter(one.page.picks.write, True)
    assert one.notices.pop()[0] == "Written"
    other.press(other.page.picks.chosen, "U2")
    other.press(other.page.picks.edit, "pick")
    other.enter(other.page.picks.write, True)
    assert "changed by another program" in other.notices.pop()[1]
    assert len(tomllib.loads((folder / "capture.toml").read_text())["bootstrap"]["upper"]) == 3
    viewer.stop()
