"""The page that poses a rig without a server, opened from disk in a browser: its jaw is the evaluator's."""

import json

import numpy as np
import pytest
from browser import headless_chromium, keep_picture, open_page
from run_jawusd import run

from jawusd.evaluator.motions import motions_of_poses
from jawusd.geometry.se3 import transform_points
from jawusd.pipeline.pose_page import write_page
from jawusd.rig.layout import EXAMPLE_RIG
from jawusd.rig.read import load_rig

chromium = pytest.fixture(headless_chromium, scope="module")


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "jaw.html"
    write_page(EXAMPLE_RIG, path)
    return path


@pytest.fixture(scope="module")
def rig():
    return load_rig(EXAMPLE_RIG)


class Jaw:
    """The open page."""

    def __init__(self, chromium, file, width=1200, height=900, **context):
        self.web, self.trouble, self.requests = open_page(chromium, width, height, **context), [], []
        self.web.on("console", lambda message: self.trouble.append(message.text) if message.type == "error" else None)
        self.web.on("pageerror", lambda error: self.trouble.append(str(error)))
        self.web.on("request", lambda request: self.requests.append(request.url))
        self.web.goto(file.as_uri())
        self.part = lambda name: self.web.locator(f'[data-jaw="{name}"]')

    def close(self, name):
        keep_picture(self.web, name, full_page=True)
        self.web.context.close()
        assert self.trouble == [] and len(self.requests) == 1

    def pose(self):
        """Return d (3,) [mm] and the motion (4, 4) that the page shows."""
        shown = self.web.locator("#jaw").evaluate("e => [e.dataset.d, e.dataset.motion]")
        return np.array(json.loads(shown[0])), np.reshape(json.loads(shown[1]), (4, 4)).T

    def grabbable(self):
        """Return the place of a pixel of the moving parts on the vertical middle of the canvas."""
        box = self.part("canvas").bounding_box()
        for y in np.linspace(box["y"] + 0.3 * box["height"], box["y"] + box["height"], 60):
            self.web.mouse.move(box["x"] + box["width"] / 2, y)
            if self.part("canvas").evaluate("e => e.style.cursor") == "move":
                return box["x"] + box["width"] / 2, y + 6
        raise AssertionError("nothing moves in the middle of the page")

    def drag(self, dx, dy):
        x, y = self.grabbable()
        self.web.mouse.move(x, y)
        self.web.mouse.down()
        self.web.mouse.move(x + dx, y + dy, steps=8)
        self.web.mouse.up()
        return self.pose()


def off_mm(rig, d, motion):
    """Return the largest distance of a landmark of the page from the evaluator's."""
    rest = transform_points(rig.T_anatomical_skull @ rig.T_rest, rig.landmarks)
    exact = motions_of_poses(rig.pose(d), rig.T_anatomical_skull, rig.T_rest)
    return np.linalg.norm(transform_points(motion, rest) - transform_points(exact, rest), axis=-1).max()


@pytest.mark.parametrize(
    ("view", "dx", "dy"), [("front", 0, 90), ("front", 40, 60), ("left", 0, 70), ("right", -30, 60)]
)
def test_a_dragged_jaw_is_posed_as_the_evaluator_poses_it_and_stays_inside(chromium, file, rig, view, dx, dy):
    jaw = Jaw(chromium, file)
    jaw.part("close").click()
    jaw.web.click(f'[data-view="{view}"]')
    d, motion = jaw.drag(dx, dy)
    assert d[0] > 5 and float(rig.margin(d)) >= -0.05 and off_mm(rig, d, motion) < 0.05
    if view == "front":
        assert abs(d[2]) < 1 and (abs(d[1]) < 0.5 if dx == 0 else abs(d[1]) > 1)  # the habitual path gives the depth
    jaw.close(f"pose_page_{view}_{dx}")


def test_a_drag_beyond_the_bound_stops_there(chromium, file, rig):
    jaw = Jaw(chromium, file)
    jaw.part("close").click()
    d, motion = jaw.drag(300, 20)
    assert -0.05 <= float(rig.margin(d)) < 0.5 and off_mm(rig, d, motion) < 0.05
    jaw.close("pose_page_bound")


@pytest.mark.parametrize(("width", "scheme"), [(1440, "light"), (390, "dark")])
def test_the_take_plays_and_sliders_pose_the_jaw(chromium, file, rig, width, scheme):
    jaw = Jaw(chromium, file, width, 844, color_scheme=scheme)
    first, _ = jaw.pose()
    moved = "before => document.getElementById('jaw').dataset.d !== before"
    jaw.web.wait_for_function(moved, arg=json.dumps(first.tolist()))
    assert jaw.part("play").inner_text() == "Pause"
    jaw.part("d1").evaluate("(e, v) => { e.value = v; e.dispatchEvent(new Event('input')); }", 12)
    assert jaw.part("play").inner_text() == "Play the take"
    jaw.part("close").click()
    jaw.part("d1").evaluate("(e, v) => { e.value = v; e.dispatchEvent(new Event('input')); }", 12)
    d, motion = jaw.pose()
    assert d[0] == pytest.approx(12, abs=0.1) and off_mm(rig, d, motion) < 0.05
    assert "inside the bound" in jaw.part("margin").inner_text()
    assert jaw.web.evaluate("document.documentElement.scrollWidth") <= width
    jaw.close(f"pose_page_{width}_{scheme}")


def test_the_command_writes_the_page_and_keeps_other_files(tmp_path):
    run("view", "--page", tmp_path / "jaw.html")
    assert (tmp_path / "jaw.html").stat().st_size < 3e6
    assert "--force" in run("view", "--page", tmp_path / "jaw.html", code=10)
