"""The page that poses and keys a rig without a server, opened from disk in a browser: its jaw is the evaluator's."""

import base64
import io
import json
import shutil

import numpy as np
import pytest
from browser import headless_chromium
from page_jaw import SET, Jaw
from PIL import Image
from run_jawusd import run
from viewed_example import EXAMPLE, record_build

from jawusd.base.errors import CaptureError
from jawusd.evaluator.authoring import interpolate_smooth
from jawusd.evaluator.motions import motions_of_poses
from jawusd.formats.keys import load_keys
from jawusd.formats.poses import read_parameters
from jawusd.geometry.se3 import transform_points
from jawusd.pipeline.view import write_page
from jawusd.rig.layout import EXAMPLE_RIG
from jawusd.rig.read import load_rig
from jawusd.viewer.readouts import GHOSTS, nearest_captured

chromium = pytest.fixture(headless_chromium, scope="module")
WANTED = {40: (0, 0, 0), 80: (22, 0, 0), 90: (25, 1, 2), 140: (6, -3, 1)}  # frames of keys, and their poses [mm]


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "jaw.html"
    write_page(EXAMPLE_RIG, path)
    return path


@pytest.fixture(scope="module")
def rig():
    return load_rig(EXAMPLE_RIG)


@pytest.fixture(scope="module")
def opened(chromium, file):
    jaw = Jaw(chromium, file, reduced_motion="reduce", color_scheme="light")
    yield jaw
    jaw.close("pose_page_1100_light")


@pytest.fixture
def jaw(opened):
    """Return the open page, paused, with the jaw closed, in a front view."""
    if opened.part("play").inner_text() == "Pause":
        opened.part("play").click()
    opened.web.click('[data-view="front"]')
    opened.part("close").click()
    return opened


@pytest.fixture(scope="module")
def first_keys(opened):
    """Add a key at each frame of WANTED, and return the keys."""
    for frame, d in WANTED.items():
        opened.seek(frame)
        opened.set_pose(d)
        opened.web.keyboard.press("k")
    assert [key["frame"] for key in opened.read_keys()] == list(WANTED)
    return opened.read_keys()


@pytest.fixture
def keyed(jaw, first_keys):
    """Return the page with the first keys; what another test did to them is undone."""
    while jaw.read_keys() != first_keys:
        jaw.part("undo").click()
    return jaw


def off_mm(rig, d, motion):
    """Return the largest distance of a landmark of the page from the evaluator's."""
    rest = transform_points(rig.T_anatomical_skull @ rig.T_rest, rig.landmarks)
    exact = motions_of_poses(rig.pose(d), rig.T_anatomical_skull, rig.T_rest)
    return np.linalg.norm(transform_points(motion, rest) - transform_points(exact, rest), axis=-1).max()


def interpolated(keys, frames):
    """Return the evaluator's smooth curve through the keys of the page at frames, shape (n, 3) [mm]."""
    times, d = np.array([key["frame"] for key in keys], float), np.array([key["d"] for key in keys])
    given = np.array([key.get("tangents", [None] * 3) for key in keys], float)
    return interpolate_smooth(times, d, np.array(frames, float), None, given)


@pytest.mark.parametrize(
    ("view", "dx", "dy"), [("front", 0, 90), ("front", 40, 60), ("left", 0, 70), ("right", -30, 60)]
)
def test_a_dragged_jaw_is_posed_as_the_evaluator_poses_it_and_stays_inside(jaw, rig, view, dx, dy):
    jaw.web.click(f'[data-view="{view}"]')
    d, motion = jaw.drag(dx, dy)
    assert d[0] > 5 and float(rig.margin(d)) >= -0.05 and off_mm(rig, d, motion) < 0.05
    if view == "front":
        assert abs(d[2]) < 1 and (abs(d[1]) < 0.5 if dx == 0 else abs(d[1]) > 1)  # the habitual path gives the depth


def test_a_drag_beyond_the_bound_stops_there(jaw, rig):
    d, motion = jaw.drag(300, 20)
    assert -0.05 <= float(rig.margin(d)) < 0.5 and off_mm(rig, d, motion) < 0.05


def test_sliders_pose_the_jaw(jaw, rig):
    jaw.part("d1").evaluate(SET, 12)
    d, motion = jaw.pose()
    assert d[0] == pytest.approx(12, abs=0.1) and off_mm(rig, d, motion) < 0.05
    assert "inside the bound" in jaw.part("margin").inner_text()


def test_the_timeline_scrubs_the_take_and_zooms_around_the_pointer(jaw):
    jaw.part("source").select_option("take")
    jaw.seek(57)
    open_mm = jaw.pose()[0][0]
    jaw.pull(jaw.place(57), jaw.place(30)[0] - jaw.place(57)[0], 0)
    assert jaw.part("frame").inner_text() == "frame 30" and jaw.pose()[0][0] < open_mm - 20
    whole = jaw.area()["view"]
    jaw.web.mouse.move(*jaw.place(100))
    jaw.web.mouse.wheel(0, -400)
    jaw.web.wait_for_function(
        "w => JSON.parse(document.querySelector('[data-jaw=timeline]').dataset.area).view[0] > w", arg=whole[0]
    )
    first, last = jaw.area()["view"]
    assert last - first < 0.6 * (whole[1] - whole[0])
    assert (100 - first) / (last - first) == pytest.approx((100 - whole[0]) / (whole[1] - whole[0]), abs=0.01)
    jaw.web.mouse.dblclick(*jaw.place(100))
    assert jaw.area()["view"] == whole


def test_keys_are_interpolated_as_the_evaluator_does_and_play(keyed):
    frames = [30, 60, 85, 100, 120, 139, 200]
    for frame, d in zip(frames, interpolated(keyed.read_keys(), frames), strict=True):
        keyed.seek(frame)
        np.testing.assert_allclose(keyed.pose()[0], d, atol=1e-6)
    keyed.part("play").click()
    assert keyed.part("play").inner_text() == "Pause"
    keyed.web.wait_for_function("() => JSON.parse(document.getElementById('jaw').dataset.d)[0] > 3")
    keyed.web.keyboard.press("k")  # adds a key at the frame that is shown, and pauses
    assert keyed.part("play").inner_text() == "Play"
    assert int(keyed.part("frame").inner_text().split()[1]) in [key["frame"] for key in keyed.read_keys()]


def test_a_key_is_dragged_in_time_and_value_deleted_undone_and_redone(keyed):
    before = keyed.read_keys()
    start = keyed.place(80, before[1]["d"][0])
    keyed.pull(start, keyed.place(70)[0] - start[0], keyed.place(70, 12)[1] - start[1])
    dragged = keyed.read_keys()
    assert dragged[1]["frame"] == 70 and dragged[1]["d"][0] == pytest.approx(12, abs=0.5)
    assert dragged[1]["d"][1:] == before[1]["d"][1:] and dragged[0::2] == before[0::2]
    np.testing.assert_allclose(keyed.pose()[0], dragged[1]["d"], atol=1e-6)  # the jaw follows
    keyed.web.keyboard.press("Control+z")
    assert keyed.read_keys() == before
    keyed.web.keyboard.press("Control+Shift+z")
    assert keyed.read_keys() == dragged
    keyed.seek(70)
    keyed.web.keyboard.press("Delete")
    assert keyed.read_keys() == [dragged[0], *dragged[2:]]
    keyed.part("undo").click()
    assert keyed.read_keys() == dragged


def test_a_key_dragged_past_another_does_not_replace_it(keyed):
    start = keyed.place(80)
    keyed.pull((start[0], start[1] + 29), keyed.place(90)[0] - start[0], 0)  # its diamond, below ruler and strip
    assert len(keyed.read_keys()) == len(WANTED) and keyed.read_keys()[1]["frame"] in (89, 88)


def handle(jaw, key, slope, side=1, length_px=44):
    """Return the place in the page [px] of the handle of d1 at a key, given the slope of the curve there."""
    (x, y), area = jaw.place(key["frame"], key["d"][0]), jaw.area()
    across = (area["right"] - area["left"]) / (area["view"][1] - area["view"][0])
    up = (area["top"] - area["bottom"]) / (area["range"][1] - area["range"][0])
    scale = side * length_px / np.hypot(across, slope * up)
    return x + scale * across, y + scale * slope * up


def test_a_handle_bends_the_curve_as_the_evaluator_does_and_is_stored(keyed, tmp_path):
    before = keyed.read_keys()
    keyed.seek(80)
    slope = (interpolated(before, [80.001]) - interpolated(before, [79.999]))[0, 0] / 0.002
    start = handle(keyed, before[1], slope)
    keyed.pull(start, 0, 30)
    bent = keyed.read_keys()
    assert [key["d"] for key in bent] == [key["d"] for key in before] and bent[0::2] == before[0::2]
    assert bent[1]["tangents"][1:] == [None, None] and bent[1]["tangents"][0] < slope - 0.1
    frames = [70, 79, 85]
    for frame, d in zip(frames, interpolated(bent, frames), strict=True):
        keyed.seek(frame)
        np.testing.assert_allclose(keyed.pose()[0], d, atol=1e-6)
    assert np.abs(interpolated(bent, frames) - interpolated(before, frames)).max() > 0.1
    with keyed.web.expect_download() as loading:
        keyed.part("json").click()
    loading.value.save_as(tmp_path / "keys.json")
    assert load_keys(tmp_path / "keys.json").keys[1].tangents == tuple(bent[1]["tangents"])
    keyed.web.keyboard.press("Control+z")
    assert keyed.read_keys() == before
    keyed.web.keyboard.press("Control+Shift+z")
    keyed.seek(80)
    keyed.web.mouse.dblclick(*handle(keyed, bent[1], bent[1]["tangents"][0]))  # lets the curve be monotone again
    assert keyed.read_keys() == before
    keyed.web.keyboard.press("Control+z")
    assert keyed.read_keys() == bent
    keyed.part("smooth").uncheck()  # lines have no handles
    keyed.pull(handle(keyed, bent[1], bent[1]["tangents"][0]), 0, 30)
    assert keyed.read_keys() == bent
    keyed.part("smooth").check()


def test_the_strip_shows_where_keys_leave_the_bound(keyed, rig):
    assert keyed.strip(80) == "green" and rig.margin(keyed.read_keys()[1]["d"]) > 0
    area = keyed.area()
    start = keyed.place(90, keyed.read_keys()[2]["d"][1])
    keyed.pull(start, 0, keyed.place(90, min(24, area["range"][1]))[1] - start[1])
    pushed, frames = keyed.read_keys(), np.arange(40, 141)
    margin = rig.margin(interpolated(pushed, frames))
    (close,) = np.flatnonzero(margin == margin[(margin < -0.3) & (margin > -0.9)][0])[:1]
    assert rig.margin(pushed[2]["d"]) < -rig.tolerance_mm
    assert keyed.strip(90) == "vermilion" and keyed.strip(int(frames[close])) == "orange" and keyed.strip(50) == "green"
    keyed.seek(90)
    assert "outside the bound" in keyed.part("margin").inner_text()


def test_the_keys_are_downloaded_as_files_that_animate_reads(keyed, tmp_path):
    for name in ("json", "csv"):
        with keyed.web.expect_download() as loading:
            keyed.part(name).click()
        loading.value.save_as(tmp_path / loading.value.suggested_filename)
    keys = load_keys(tmp_path / "keys.json")
    assert keys.interpolation == "smooth" and keys.fps == 24
    assert [{"frame": key.frame, "d": list(key.d)} for key in keys.keys] == keyed.read_keys()
    frames, d = read_parameters(tmp_path / "d.csv")
    assert frames.tolist() == list(range(40, 141))
    np.testing.assert_allclose(d, interpolated(keyed.read_keys(), frames), atol=1e-4)


def marked(jaw):
    """Return how many pixels of the canvas have the colour of marked contacts: much red, little blue."""
    red, green, blue = picture(jaw).reshape(-1, 3).T
    return int(((red > 120) & (blue < 0.6 * red) & (red - blue > 90)).sum())


def picture(jaw):
    """Return the drawn jaw, shape (h, w, 3)."""
    with Image.open(io.BytesIO(jaw.part("canvas").screenshot())) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def test_contacts_are_painted_where_the_evaluator_finds_contact(jaw, rig):
    jaw.web.wait_for_function("() => document.getElementById('jaw').dataset.clearance !== undefined")
    boxes = [jaw.web.locator(f'[data-part="{part}"]') for part in ("skull", "upper_teeth", "gum")]
    for box in [*boxes, jaw.part("paths")]:
        box.uncheck()
    jaw.web.click('[data-view="top"]')
    counts = {}
    for d in ((0, 0, 0), (0.5, 0.3, 0), (10, 0, 0)):
        jaw.set_pose(d)
        clearance = float(jaw.web.locator("#jaw").get_attribute("data-clearance"))
        assert clearance == pytest.approx(float(rig.clearance(jaw.pose()[0]).clearance_mm), abs=1e-3)
        counts[clearance] = marked(jaw)
    (open_mm, bare), (closed_mm, contacts) = max(counts.items()), min(counts.items())
    assert open_mm > 0.6 and bare == 0 and abs(closed_mm) < 0.05 and contacts > 50
    jaw.part("close").click()
    jaw.part("contacts").uncheck()
    assert marked(jaw) == 0
    for box in [*boxes, jaw.part("paths"), jaw.part("contacts")]:
        box.check()


@pytest.mark.parametrize("part", ["skull", "mandible", "upper_teeth", "lower_teeth", "gum", "paths"])
def test_parts_are_shown_and_hidden(jaw, part):
    jaw.part("source").select_option("take")
    jaw.seek(57)
    box = jaw.part(part) if part == "paths" else jaw.web.locator(f'[data-part="{part}"]')
    shown = picture(jaw)
    box.uncheck()
    assert (np.abs(picture(jaw) - shown).sum(axis=2) > 30).sum() > 30
    box.check()
    np.testing.assert_array_equal(picture(jaw), shown)


def test_the_nearest_captured_poses_are_drawn_faintly(jaw, rig):
    jaw.set_pose((14, 0, 0))
    shown = picture(jaw)
    jaw.part("ghosts").check()
    near = json.loads(jaw.web.locator("#jaw").get_attribute("data-ghosts"))
    np.testing.assert_allclose(near, nearest_captured(rig, jaw.pose()[0]), atol=1e-4)
    assert len(near) == GHOSTS
    changed = np.abs(picture(jaw) - shown).sum(axis=2)
    assert (changed > 20).sum() > 300 and np.median(changed[changed > 20]) < 150  # teeth stay visible behind them
    jaw.part("ghosts").uncheck()
    np.testing.assert_array_equal(picture(jaw), shown)
    assert jaw.web.locator("#jaw").get_attribute("data-ghosts") == "[]"


def test_on_a_phone_the_take_plays_and_the_timeline_is_in_reach(chromium, file):
    jaw = Jaw(chromium, file, 390, 844, color_scheme="dark", has_touch=True)
    first, _ = jaw.pose()
    moved = "before => document.getElementById('jaw').dataset.d !== before"
    jaw.web.wait_for_function(moved, arg=json.dumps(first.tolist()))
    assert jaw.part("play").inner_text() == "Pause"
    box, jaws = jaw.part("timeline").bounding_box(), jaw.part("canvas").bounding_box()
    assert box["y"] + box["height"] <= 844 and box["height"] > 100 and box["width"] > 300
    assert jaws["y"] + jaws["height"] < box["y"]  # both are visible without scrolling
    jaw.web.touchscreen.tap(*jaw.place(57))
    assert jaw.part("play").inner_text() == "Play" and jaw.pose()[0][0] > 20
    jaw.part("key").tap()
    assert [key["frame"] for key in jaw.read_keys()] == [int(jaw.part("frame").inner_text().split()[1])]
    assert jaw.web.evaluate("document.documentElement.scrollWidth") <= 390
    jaw.close("pose_page_390_dark")


def test_the_command_writes_the_page_and_keeps_other_files(tmp_path):
    run("view", "--page", tmp_path / "jaw.html")
    assert (tmp_path / "jaw.html").stat().st_size < 3e6
    assert "--force" in run("view", "--page", tmp_path / "jaw.html", code=10)
    assert "needs --page" in run("view", "--footage", code=2)
    said = run("view", "--page", tmp_path / "other.html", "--footage", code=5)
    assert "leave out --footage" in said and not (tmp_path / "other.html").exists()


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """Write the page of a rig whose folder records the example capture, with footage."""
    folder = shutil.copytree(EXAMPLE_RIG.parent, tmp_path_factory.mktemp("filmed") / "rig")
    page = folder / "jaw.html"
    with pytest.raises(CaptureError, match="is not available"):
        write_page(folder, page, footage=True)
    record_build(folder, EXAMPLE)
    write_page(folder, page, footage=True)
    return page


def test_the_footage_of_the_frame_is_shown_beside_the_jaw(chromium, filmed):
    jaw = Jaw(chromium, filmed)
    image = jaw.part("footage")
    seen = []
    for frame in (24, 44):
        jaw.seek(frame)
        seen.append(image.get_attribute("src"))
        shown = Image.open(io.BytesIO(base64.b64decode(seen[-1].partition(",")[2])))
        assert image.is_visible() and shown.width == 320
    jaw.part("camera").select_option("cam1")
    seen.append(image.get_attribute("src"))
    assert len(set(seen)) == 3
    jaw.part("camera").select_option("off")
    assert not image.is_visible()
    jaw.close("pose_page_footage")


def test_pages_without_footage_have_no_menu_and_phones_begin_without(chromium, file, filmed):
    bare, phone = Jaw(chromium, file), Jaw(chromium, filmed, 390, 844)
    assert bare.part("camera").count() == bare.part("footage").count() == 0
    assert phone.part("camera").input_value() == "" and not phone.part("footage").is_visible()
    bare.close("pose_page_without_footage")
    phone.close("pose_page_footage_390")
