"""The page in headless Chromium: sliders, drag, keys, files. Page errors and external requests fail a test."""

import time

import numpy as np
import pytest
from browser_tab import Tab, until
from example_rig import FPS, assert_valid_usd, example_meshes, example_motion, example_rig

from jawusd.formats.keys import load_keys
from jawusd.formats.poses import read_parameters
from jawusd.pipeline.view import open_viewer
from jawusd.rig.bake import bake_rig
from jawusd.rig.motion_read import read_poses_of_stage
from jawusd.viewer.readouts import CONDYLES, INCISOR, landmark_places, rest_places
from jawusd.viewer.scene import _OUTSIDE, PRESETS, preset_view
from jawusd.viewer.widgets import MOST_BYTES


@pytest.fixture
def tab(chromium, viewer):
    opened = Tab(chromium, viewer)
    yield opened
    opened.web.close()
    assert opened.complaints == []
    assert opened.elsewhere == []


def close_to(session, d):
    return np.allclose(session.d, d, atol=1e-3)


class Desktop(Tab):
    """A page on a screen."""

    SIZE_PX = (1440, 900)


class Phone(Tab):
    """A page on a phone."""

    SIZE_PX = (390, 844)


@pytest.mark.parametrize("kind", [Desktop, Phone])
def test_no_tab_scrolls_sideways_and_the_page_is_named_after_the_actor(chromium, viewer, kind):
    tab = kind(chromium, viewer)
    until(lambda: tab.web.title() == "someone - jawusd")
    widths = tab.keep_every_tab("rig", ("Pose", "Animate", "Files"))
    assert set(widths) == {(kind.SIZE_PX[0], kind.SIZE_PX[0])}
    tab.said("inside the bound")
    if kind is Phone:
        panel = tab.web.locator(".mantine-Paper-root", has=tab.web.locator(".jawusd-page")).last
        box, height = tab.resting_place(panel), kind.SIZE_PX[1]
        assert box["width"] == kind.SIZE_PX[0] and box["y"] >= 0.49 * height
        incisor = tab.pixel(rest_places(tab.session.rig)[INCISOR])
        assert 0 < incisor[0] < kind.SIZE_PX[0] and 0 < incisor[1] < box["y"]
        tab.web.get_by_text("someone", exact=True).click()  # the panel's header collapses it
        until(lambda: tab.resting_place(panel)["height"] < 80)
    tab.web.close()
    assert tab.complaints == [] and tab.elsewhere == []


def test_sliders_pose_the_jaw_and_their_ends_follow(tab):
    tab.type_slider(0, 20)
    until(lambda: close_to(tab.session, [20, 0, 0]))
    wanted = np.array(tab.session.rig.ranges(20.0))

    def ends_shown():
        return np.ravel([(slider.min, slider.max) for slider in tab.page.pose.sliders[1:]])

    until(lambda: np.allclose(ends_shown(), wanted, rtol=1e-7, atol=0.01))  # they follow the pose
    ends = ends_shown()
    for end in ends:
        shown = f"{end:.2f}".rstrip("0").rstrip(".")
        until(lambda shown=shown: tab.web.get_by_text(shown, exact=True).count() > 0)
    tab.type_slider(1, 100)
    until(lambda: np.isclose(tab.session.d[1], ends[1], atol=0.011))
    tab.picture("slider")
    tab.web.get_by_label("keep valid").click()
    until(lambda: not tab.session.keep_valid)
    tab.type_slider(1, 9)
    tab.said("OUTSIDE the bound")
    until(lambda: tuple(tab.page.scene.grips[0].color) == _OUTSIDE)
    tab.picture("outside")
    tab.press("undo")
    until(lambda: np.isclose(tab.session.d[1], ends[1], atol=0.011))
    until(lambda: tuple(tab.page.scene.grips[0].color) != _OUTSIDE)


@pytest.mark.parametrize("key", [None, "Shift"])
def test_dragging_the_incisor_is_inverse_kinematics(tab, key):
    """The depth follows the opening path, or stays as it is while a key is held."""
    tab.type_slider(0, 15)
    until(lambda: close_to(tab.session, [15, 0, 0]))
    time.sleep(0.5)  # the page draws the pose
    rig, start = tab.session.rig, tab.session.d
    incisor = landmark_places(rig, start)[0]
    here, there = tab.pixel(incisor), tab.pixel(incisor + [5.0, 0.0, 0.0])
    held = []
    drag_to = tab.session.drag_to
    tab.session.drag_to = lambda p, sight: held.append((tab.session._handle, p, sight)) or drag_to(p, sight)
    if key is not None:
        tab.web.keyboard.down(key)
    tab.web.mouse.move(*here)
    tab.web.mouse.down()
    for share in np.linspace(0.1, 1.0, 10):
        tab.web.mouse.move(here[0] + share * (there[0] - here[0]), here[1] + share * (there[1] - here[1]))
        time.sleep(0.06)
    until(lambda: len(held) > 3)
    time.sleep(0.3)
    tab.picture("drag")
    tab.web.mouse.up()
    until(lambda: not tab.session.dragging)
    if key is not None:
        tab.web.keyboard.up(key)
    handle, pointer, sight = held[-1]
    T, R = rig.pose(start), rig.T_anatomical_skull[:3, :3]
    asked = R @ (pointer - T[:3, :3] @ handle - T[:3, 3])
    np.testing.assert_allclose(asked, [5.0, 0.0, 0.0], atol=0.6)  # the surface is closer to the camera than the incisor
    assert (sight is None) == (key is not None)
    if sight is not None:
        place = R @ pointer + rig.T_anatomical_skull[:3, 3]
        np.testing.assert_allclose(R @ sight, place - tab.page.client.camera.position, atol=1e-9)
    found, _ = rig.ik(handle, pointer, start=start, sight=sight)
    moved = [T[:3, :3] @ handle + T[:3, 3] for T in rig.pose(np.stack([found, tab.session.d]))]
    assert np.linalg.norm(moved[0] - moved[1]) < 0.1
    assert tab.session.d[1] > 2.0 and (abs(tab.session.d[2]) > 0.5) == (key is not None)


def pull(tab, landmark, offset):
    """Drag a landmark of the jaw with the mouse by an offset in anatomical axes [mm]."""
    place = landmark_places(tab.session.rig, tab.session.d)[landmark]
    here, there = tab.pixel(place), tab.pixel(place + offset)
    tab.web.mouse.move(*here)
    tab.web.mouse.down()
    for share in np.linspace(0.2, 1.0, 5):
        tab.web.mouse.move(here[0] + share * (there[0] - here[0]), here[1] + share * (there[1] - here[1]))
        time.sleep(0.06)
    until(lambda: tab.session.dragging)
    time.sleep(0.3)
    tab.web.mouse.up()
    until(lambda: not tab.session.dragging)


def test_a_pinned_condyle_stays_and_undo_takes_the_drag_back(tab):
    tab.type_slider(0, 15)
    until(lambda: close_to(tab.session, [15, 0, 0]))
    time.sleep(0.5)  # the page draws the pose
    before = landmark_places(tab.session.rig, tab.session.d)
    pull(tab, INCISOR, [0.0, -5.0, 0.0])
    free = landmark_places(tab.session.rig, tab.session.d)
    tab.web.keyboard.press("Control+z")
    until(lambda: close_to(tab.session, [15, 0, 0]))
    tab.web.keyboard.press("Control+Shift+z")
    until(lambda: not close_to(tab.session, [15, 0, 0]))
    tab.web.keyboard.press("Control+z")
    until(lambda: close_to(tab.session, [15, 0, 0]))
    tab.web.get_by_label("condyle right").click()
    until(lambda: tab.session.work.pins)
    time.sleep(0.5)
    pull(tab, INCISOR, [0.0, -5.0, 0.0])
    tab.picture("pin")
    held = landmark_places(tab.session.rig, tab.session.d)
    travel = [np.linalg.norm((places - before)[CONDYLES[1]]) for places in (free, held)]
    assert travel[1] < 0.5 < travel[0]
    assert before[INCISOR, 1] - held[INCISOR, 1] > 0.2  # about the pinned condyle
    tab.press("undo")
    tab.press("undo")
    until(lambda: not tab.session.work.pins and close_to(tab.session, [15, 0, 0]))


def test_every_view_is_drawn_in_light_and_dark(tab):
    camera, rest = tab.page.client.camera, rest_places(tab.session.rig)
    # The aspect ratio may change in between, since viser reduces the resolution when drawing is slow.
    ratios = set()

    def shows(name):
        ratios.add(camera.image_width / camera.image_height)
        views = [preset_view(rest, name, ratio) for ratio in ratios]
        return any(np.allclose([camera.look_at, camera.position], view, atol=0.1) for view in views)

    for name in PRESETS:
        shows(name)  # records the ratio before the press
        tab.press(name)
        until(lambda name=name: shows(name))
        assert (tab.page.scene.grips[0].opacity is None) == (not name.startswith("condyle"))
        time.sleep(0.5)  # the page draws the view
        tab.picture(f"view_{name.replace(' ', '_')}")
    corner = {"x": 400, "y": 30, "width": 8, "height": 8}
    dark = tab.web.screenshot(clip=corner)
    tab.web.get_by_label("dark page").click()
    until(lambda: tab.web.screenshot(clip=corner) != dark)
    tab.picture("light")


def test_a_placeholder_of_the_mandible_is_shown_as_one(chromium, tmp_path):
    meshes = {name: mesh for name, mesh in example_meshes().items() if name != "mandible"}
    frames, d = example_motion()
    bake_rig(tmp_path, example_rig(), meshes, name="toothless", fps=FPS, frames=frames, d=d, table_size=17)
    viewer = open_viewer(tmp_path, "127.0.0.1", 0, play=False)
    tab = Tab(chromium, viewer)
    tab.said("The bone is estimated")
    mandible = tab.page.scene.grips[0]
    assert mandible.name == "/jaw/mandible" and mandible.opacity < 0.6
    tab.picture("placeholder")
    tab.web.close()
    viewer.stop()
    assert tab.complaints == [] and tab.elsewhere == []


def test_three_keys_are_exported_saved_and_loaded_again(tab, folder, tmp_path):
    poses = {0: (2.0, 0.0, 0.0), 12: (16.0, 1.5, 0.0), 30: (6.0, -1.0, 0.5)}
    for frame, d in poses.items():
        tab.tab("Pose")
        for index in (2, 1, 0, 1, 2):
            tab.type_slider(index, d[index])
            time.sleep(0.3)
        until(lambda d=d: close_to(tab.session, d))
        tab.tab("Animate")
        tab.page.motion.frame = float(frame)
        tab.press("set")
        until(lambda frame=frame: any(key.frame == frame for key in tab.session.work.keys))
    tab.picture("keys")
    tab.tab("Files")
    tab.press("write animation")
    tab.said("Written")
    assert_valid_usd(folder / "anim_view.usdc")
    frames, T = read_poses_of_stage(folder / "anim_view.usdc")
    rig, at = tab.session.rig, np.linspace(0, 30, 11).astype(int)
    expected = rig.pose(rig.interpolate(list(poses), list(poses.values()), at, "smooth"))
    np.testing.assert_allclose(T[np.searchsorted(frames, at)], expected, atol=2e-3)
    tab.download("save keys.json", tmp_path / "keys.json")
    saved = load_keys(tmp_path / "keys.json")
    assert [key.frame for key in saved.keys] == list(poses)
    np.testing.assert_allclose([key.d for key in saved.keys], list(poses.values()), atol=1e-3)
    tab.tab("Animate")
    tab.type_slider(0, 12)
    until(lambda: close_to(tab.session, poses[12]))
    tab.press("copy")
    tab.type_slider(0, 40)
    until(lambda: tab.page.motion.frame == 40)
    tab.press("paste")
    until(lambda: [key.frame for key in tab.session.work.keys] == [0, 12, 30, 40])
    np.testing.assert_allclose(tab.session.work.keys[-1].d, tab.session.work.keys[1].d)
    thumbs = tab.web.locator(".multi-slider-thumb")
    until(lambda: thumbs.count() == 4)
    thumb = tab.resting_place(thumbs.last)
    x, y = thumb["x"] + 0.5 * thumb["width"], thumb["y"] + 0.5 * thumb["height"]
    tab.web.mouse.move(x, y)
    tab.web.mouse.down()
    for step in (5, 10, 15):
        tab.web.mouse.move(x + step, y)
    tab.web.mouse.up()
    until(lambda: tab.session.work.keys[-1].frame > 42)
    assert [key.frame for key in tab.session.work.keys[:3]] == [0, 12, 30]
    tab.web.locator("input[role=combobox]:visible").last.click()
    tab.web.get_by_role("option", name="linear").click()
    until(lambda: tab.session.work.interpolation == "linear")
    tab.picture("linear")
    for frame in [key.frame for key in tab.session.work.keys]:
        tab.type_slider(0, f"{frame:g}")
        until(lambda frame=frame: tab.page.motion.frame == frame)
        tab.press("delete")
        until(lambda frame=frame: all(key.frame != frame for key in tab.session.work.keys))
    tab.tab("Files")
    tab.web.locator("input[type=file]").set_input_files(tmp_path / "keys.json")
    until(lambda: tab.session.work.keys == saved.keys and tab.session.work.interpolation == "smooth")


def test_the_baked_motion_plays_goes_round_and_stops(tab):
    tab.tab("Animate")
    tab.said("anim_capture.usdc, ready to play")
    tab.web.locator("input[role=combobox]:visible").first.click()
    tab.web.get_by_role("option", name=tab.page.motion.source.options[1]).click()
    motion = tab.page.motion
    until(lambda: motion.clip() is not None and motion.frame == motion.clip().span[0])
    clip = motion.clip()
    np.testing.assert_allclose(tab.session.d, clip.d[0], atol=1e-9)
    shown = []
    show = motion.player._show
    motion.player._show = lambda frame: shown.append(frame) or show(frame)
    tab.press("play")
    until(lambda: any(after < before for before, after in zip(shown, shown[1:], strict=False)))
    tab.press("pause")
    until(lambda: not motion.player.playing)
    first, last = clip.span
    tab.web.get_by_label("loop").click()
    until(lambda: not motion.loop.value)
    tab.press("play")
    until(lambda: not motion.player.playing and motion.frame == last)
    plot = tab.resting_place(tab.web.locator("svg:visible", has=tab.web.locator("use[href='#jaw-curves']")))
    left, right = plot["x"] + plot["width"] * 36 / 300, plot["x"] + plot["width"] * 288 / 300
    tab.web.mouse.click(left + 0.25 * (right - left), plot["y"] + 0.5 * plot["height"])
    until(lambda: abs(motion.frame - (first + 0.25 * (last - first))) <= 1)
    tab.web.mouse.down()
    for share in (0.5, 0.7, 0.9):
        tab.web.mouse.move(left + share * (right - left), plot["y"] + 0.5 * plot["height"])
        until(lambda share=share: abs(motion.frame - (first + share * (last - first))) <= 1)
    tab.web.mouse.up()
    until(lambda: tab.web.locator("input.mantine-NumberInput-input:visible").first.input_value() == f"{motion.frame:g}")
    tab.picture("play")
    assert first <= min(shown) and max(shown) <= last
    np.testing.assert_allclose(tab.session.d, clip.at(motion.frame), atol=1e-9)


def test_the_page_opens_with_the_take_playing_and_names_the_frame(chromium, playing):
    tab = Tab(chromium, playing)
    motion = tab.page.motion
    until(lambda: motion.player.playing)
    first, last = motion.clip().span
    line = tab.web.locator(f"text=/^anim_capture.usdc, frame [0-9]+ of {first:.0f} to {last:.0f}$/")
    before = line.inner_text()
    until(lambda: line.inner_text() != before)
    tab.press("pause")
    until(lambda: not motion.player.playing)
    tab.said(f"frame {motion.frame:.0f} of")
    tab.press("play")
    until(lambda: motion.player.playing)
    tab.press("close jaw")
    until(lambda: not motion.player.playing and np.abs(tab.session.d).max() < 0.1)
    tab.press("play")
    until(lambda: motion.player.playing)
    tab.web.close()
    until(lambda: not motion.player.playing)
    assert tab.complaints == [] and tab.elsewhere == []


def test_a_bad_file_is_a_message_and_the_page_lives_on(tab, tmp_path):
    tab.tab("Files")
    chooser = tab.web.locator("input[type=file]")
    bad = tmp_path / "bad.json"
    bad.write_text('{"fps": 24, "keys": [{"frame": 0}]}')
    chooser.set_input_files(bad)
    tab.said("bad.json: keys, entry 1: d")
    worse = tmp_path / "worse.json"
    worse.write_bytes(b"\xff\xfe\x00rubbish")
    chooser.set_input_files(worse)
    until(lambda: "but not after the last." in tab.web.inner_text("body"))
    huge = tmp_path / "huge.csv"
    huge.write_bytes(b"0" * (MOST_BYTES + 1))
    chooser.set_input_files(huge)
    tab.said(f"the limit is {MOST_BYTES}.")
    assert tab.page.client.gui._current_file_upload_states == {}
    good = tmp_path / "walk.csv"
    good.write_text("frame,d1,d2,d3\n0,1,0,0\n10,9,0,0\n")
    chooser.set_input_files(good)
    until(lambda: tab.page.motion.source.value == "walk.csv")
    tab.download("save CSV of d", tmp_path / "d.csv")
    frames, d = read_parameters(tmp_path / "d.csv")
    np.testing.assert_allclose(d[:, 0], 1 + 0.8 * frames)


@pytest.mark.slow
def test_two_pages_do_not_mix(chromium, viewer, tab):
    other = Tab(chromium, viewer)
    tab.type_slider(0, 18)
    until(lambda: close_to(tab.session, [18, 0, 0]))
    other.type_slider(0, 6)
    until(lambda: close_to(other.session, [6, 0, 0]))
    time.sleep(0.5)
    assert close_to(tab.session, [18, 0, 0]) and tab.page.pose.sliders[0].value == 18
    boxes = [page.web.locator("input.mantine-NumberInput-input").first.input_value() for page in (tab, other)]
    assert boxes == ["18", "6"]
    other.web.close()
    until(lambda: len(viewer.pages) == 1)
    assert other.complaints == []
