"""The page of a capture in headless Chromium: footage, frames, 3-D view, and mouse picks that build a rig."""

import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from browser_tab import Tab, until
from package_copy import ROOT
from run_jawusd import without_report
from short_example import shortened

from jawusd.formats.capture import load_capture
from jawusd.formats.tracks import load_tracks
from jawusd.geometry import transform_point, transform_points
from jawusd.pipeline.view_capture import viewed_capture
from jawusd.viewer.capture_page import CaptureViewer
from jawusd.viewer.plots import ACROSS

EXAMPLE = ROOT / "examples" / "capture"
FIRST, STOP = 20, 90
TWO_PICTURES = "new Promise(drawn => requestAnimationFrame(() => requestAnimationFrame(drawn)))"


def quiet(stage, done, total):
    """Ignore progress."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a copy of the example with few frames and without picks."""
    copy = shutil.copytree(EXAMPLE, tmp_path_factory.mktemp("capture") / "capture")
    path = copy / "capture.toml"
    text = path.read_text()
    start, end = text.index("[bootstrap]"), text.index("[motion]")
    text = text[:start] + "# picks go here\n" + text[end:]
    with np.load(EXAMPLE / "truth" / "truth.npz") as archive:  # searching takes time and is tested elsewhere
        known = zip(archive["camera_names"], archive["offsets"], strict=True)
        offsets = ", ".join(f"{name} = {offset}" for name, offset in known)
    text = text.replace('method = "flash"', f'method = "offsets"\noffsets = {{ {offsets} }}')
    path.write_text(text.replace("frames = [20, 320]", f"frames = [{FIRST}, {STOP}]"))
    assert load_capture(copy).bootstrap is None and load_capture(copy).frames == (FIRST, STOP)
    return copy


@pytest.fixture(scope="module")
def viewer(folder):
    running = CaptureViewer(viewed_capture(folder, None, quiet), "127.0.0.1", 0)
    yield running
    running.stop()


class CaptureTab(Tab):
    """Drive one open page of a capture."""

    READY = "frame 20"
    SIZE_PX = (1000, 600)

    def settle(self):
        """Wait until the picture is shown and the camera is at rest."""
        until(lambda: not self.page.busy)
        before = None
        while before != (before := tuple(self.page.client.camera.position)):
            self.web.evaluate(TWO_PICTURES)  # a busy machine may not have drawn yet
            time.sleep(0.7)

    def click(self, place):
        """Click at the screen position of a point and wait for the effect; clicks leave the camera where it is."""
        wanted = self.page._wanted
        self.web.mouse.click(*self.pixel(place))
        until(lambda: self.page._wanted > wanted and not self.page.busy)

    def view(self, name):
        """Show one camera, or all of them."""
        self.tab("Footage")
        self.settle()
        wanted = self.page._wanted
        self.press(name)  # pressing the current view resets the camera
        until(lambda: self.page._wanted > wanted and self.page.footage.view == name)
        self.settle()
        self.tab("Picks")


@pytest.fixture(scope="module")
def tab(chromium, viewer):
    opened = CaptureTab(chromium, viewer)
    opened.settle()
    yield opened
    opened.web.close()
    assert opened.complaints == []
    assert opened.elsewhere == []


def clickable(mesh, vertex, pose, eye):
    """Return a surface point next to a vertex, on the adjacent face that faces the camera most."""
    world = transform_points(pose, mesh.vertices)
    corners = world[mesh.faces[(mesh.faces == vertex).any(axis=1)]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    middles = corners.mean(axis=1)
    rays = (eye - middles) / np.linalg.norm(eye - middles, axis=1, keepdims=True)
    face = np.einsum("ij,ij->i", normals, rays).argmax()
    return 0.6 * world[vertex] + 0.4 * middles[face]


class Phone(CaptureTab):
    """A page on a phone."""

    SIZE_PX = (390, 844)
    PIXEL_RATIO = 2


class Desktop(CaptureTab):
    """A page on a screen."""

    SIZE_PX = (1440, 900)


@pytest.mark.parametrize("kind", [Desktop, Phone])
def test_no_tab_scrolls_sideways_and_the_page_is_named_after_the_capture(chromium, viewer, kind):
    tab = kind(chromium, viewer)
    tab.settle()
    assert tab.web.title() == f"{tab.page._capture.name} - jawusd"
    if kind is Phone:
        panel = tab.resting_place(tab.web.locator(".mantine-Paper-root", has=tab.web.locator(".jawusd-page")).last)
        for mesh, pose in zip(tab.page._capture.scans.values(), tab.page.poses.values(), strict=True):
            assert all(0 < tab.pixel(place)[1] < panel["y"] for place in transform_points(pose, mesh.vertices[::500]))
    widths = tab.keep_every_tab("capture", ("Footage", "Picks", "Scans"))
    assert set(widths) == {(kind.SIZE_PX[0], kind.SIZE_PX[0])}
    tab.web.close()
    assert tab.complaints == []


def test_frames_are_stepped_and_the_cameras_stand_in_space(tab):
    tab.press("+1")
    until(lambda: tab.page.footage.frame == FIRST + 1 and not tab.page.busy)
    tab.said(f"frame {FIRST + 1}")
    tab.type_slider(0, FIRST + 30)
    until(lambda: tab.page.footage.frame == FIRST + 30 and not tab.page.busy)
    tab.press("3-D")
    tab.said("3-D, frame 50")
    tab.settle()
    tab.picture("capture_space")
    box = tab.web.locator("canvas").first.bounding_box()
    for camera in tab.page._capture.cameras.values():
        x, y = tab.pixel(transform_point(tab.page.scene.T_page_world, camera.centre_world()))
        assert box["x"] < x < box["x"] + box["width"] and box["y"] < y < box["y"] + box["height"]


def test_all_cameras_play_side_by_side(tab):
    page = tab.page
    tab.press("all cameras")
    tab.settle()
    tab.press("play")
    until(lambda: page.footage.player.playing and page.footage.frame != FIRST + 30)
    seen = page.footage.frame
    until(lambda: page.footage.frame not in (seen, FIRST + 30))
    tab.press("pause")
    until(lambda: not page.footage.player.playing and not page.busy)
    tab.said(f"all cameras, frame {page.footage.frame}")
    tab.settle()
    tab.picture("capture_all")
    box = tab.web.locator("canvas").first.bounding_box()
    for corner in page.layout.corners():
        x, y = tab.pixel(corner)
        assert box["x"] < x < box["x"] + box["width"] and box["y"] < y < box["y"] + box["height"]


def test_two_pages_do_not_mix(chromium, viewer, tab):
    other = CaptureTab(chromium, viewer)
    tab.press("cam0")
    tab.type_slider(0, FIRST)
    until(lambda: tab.page.footage.frame == FIRST and tab.page.footage.view == "cam0")
    tab.press("+10")
    until(lambda: tab.page.footage.frame == FIRST + 10)
    other.press("cam2")
    until(lambda: other.page.footage.view == "cam2")
    assert tab.page.footage.view == "cam0" and other.page.footage.frame == FIRST
    other.web.close()
    until(lambda: len(viewer.pages) == 1)
    assert other.complaints == []


@pytest.mark.slow
def test_picks_made_in_the_page_build_a_rig(tab, folder, tmp_path):
    capture, page = tab.page._capture, tab.page
    original = load_capture(EXAMPLE).bootstrap
    tab.type_slider(0, FIRST)
    until(lambda: page.footage.frame == FIRST)
    tab.view("cam0")
    for arch in ("upper", "lower"):
        for pick in getattr(original, arch):
            eye = np.array(page.client.camera.position)
            tab.click(clickable(capture.scans[arch], pick.vertex, page.poses[arch], eye))
    book = page.picks.book
    assert [pick.arch for pick in book.picks] == ["upper"] * 4 + ["lower"] * 4
    moved = [
        np.linalg.norm(np.diff(capture.scans[pick.arch].vertices[[pick.vertex, given.vertex]], axis=0))
        for pick, given in zip(book.picks, (*original.upper, *original.lower), strict=True)
    ]
    assert max(moved) < 0.5  # mm: the intended vertex or a neighbour
    with np.load(EXAMPLE / "truth" / "truth.npz") as archive:  # stands in for the person who clicks
        poses = {arch: archive[f"T_world_{arch}"][0] for arch in ("upper", "lower")}
        assert archive["frames"][0] == FIRST
    for camera in ("cam0", "cam2"):
        tab.view(camera)
        for pick in list(book.picks):
            place = transform_point(poses[pick.arch], capture.scans[pick.arch].vertices[pick.vertex])
            pixel = capture.cameras[camera].project(place)
            tab.click(page.layout.place(pixel))
            assert np.abs(np.subtract(pick.views[camera], pixel)).max() < 1.5
    tab.said("the picks are consistent")
    tab.picture("capture_picks")
    before = (folder / "capture.toml").read_text()
    tab.press("write to the capture file")
    tab.said("Written")
    after = (folder / "capture.toml").read_text()
    assert after.startswith(before) and load_capture(folder).bootstrap == book.bootstrap()
    (folder / "capture.toml").write_text(shortened(after, 20))  # a rig of few frames, from the masks alone
    build = [sys.executable, "-m", "jawusd", "build", str(folder), "-o", str(tmp_path / "actor")]
    done = subprocess.run(build, capture_output=True, text=True, env=without_report(tmp_path / "hidden"))
    assert done.returncode == 0, done.stderr
    assert Path(tmp_path / "actor" / "actor.usda").is_file()
    tracks = load_tracks(tmp_path / "actor" / "tracks.npz")
    assert tracks.tracked().all() and tracks.meta["start"]["picks_left_out"] == {"lower": [], "upper": []}


@pytest.mark.slow
def test_tracked_poses_are_drawn_and_the_plot_is_a_timeline(chromium, example_build):
    viewer = CaptureViewer(viewed_capture(EXAMPLE, example_build[0], quiet), "127.0.0.1", 0)
    tab = CaptureTab(chromium, viewer)
    tab.settle()
    footage = tab.page.footage
    plot = tab.resting_place(tab.web.locator("svg:has(use[href='#jaw-coverage'])"))
    left, right = ACROSS
    x = plot["x"] + plot["width"] * (left + 0.5 * (right - left))
    tab.web.mouse.click(x, plot["y"] + 0.5 * plot["height"])
    until(lambda: abs(footage.frame - 170) <= 2)  # halfway from 20 to 319
    tab.settle()
    tab.picture("capture_tracked")
    tab.press("first")
    until(lambda: footage.frame == footage.worst[0])
    tab.said("number 1 of")
    tab.web.get_by_label("dark page").click()
    tab.press("3-D")
    tab.settle()
    tab.picture("capture_light")
    tab.web.close()
    viewer.stop()
    assert tab.complaints == [] and tab.elsewhere == []
