"""Widgets and session, driven by events without a browser."""

import dataclasses
import re
import threading
import time

import numpy as np
import pytest
from quiet_page import QuietPage
from viser import UploadedFile

from jawusd.formats.keys import load_keys
from jawusd.formats.poses import read_parameters
from jawusd.pipeline.state import BuildState
from jawusd.pipeline.view import open_viewer
from jawusd.rig.motion_read import read_poses_of_stage
from jawusd.viewer.page import FREE_DEPTH
from jawusd.viewer.readouts import (
    CONDYLES,
    GHOSTS,
    GHOSTS_APART_MM,
    INCISOR,
    landmark_places,
    nearest_captured,
    rest_places,
)
from jawusd.viewer.scene import PRESETS, preset_view


@pytest.fixture
def quiet(viewer):
    return QuietPage(viewer)


def button(quiet, label):
    """Return the widget with a label."""
    handles = quiet.client.gui._gui_input_handle_from_uuid.values()
    return next(handle for handle in handles if handle.label == label)


def until(condition):
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def test_sliders_take_their_ends_from_the_rig(quiet):
    pose, session = quiet.page.pose, quiet.page.session
    quiet.enter(pose.sliders[0], 20.0)
    ends = np.ravel([(slider.min, slider.max) for slider in pose.sliders[1:]])
    np.testing.assert_allclose(ends, session.rig.ranges(20.0), atol=0.01)
    assert pose.sliders[0].value == 20.0 and session.d[0] == 20.0
    quiet.enter(pose.sliders[1], 100.0)
    assert pose.sliders[1].value == pytest.approx(session.d[1], abs=0.006)
    assert "OUTSIDE" not in quiet.page.verdict.content
    quiet.enter(pose.keep_valid, False)
    quiet.enter(pose.sliders[1], 9.0)
    assert "OUTSIDE" in quiet.page.verdict.content and pose.sliders[1].max > 9.0
    quiet.enter(button(quiet, "history"), "undo")
    assert "OUTSIDE" not in quiet.page.verdict.content
    quiet.enter(button(quiet, "history"), "close jaw")
    np.testing.assert_allclose(session.d, 0, atol=0.01)
    assert quiet.notices == []


def test_verdict_and_playback_stand_above_the_tabs_and_sliders_name_their_unit(quiet):
    page = quiet.page
    inside = {one._impl.parent_container_id for one in (page.pose.sliders[0], page.motion.loop, page.files.load)}
    assert len(inside - {"root"}) == 3
    assert {one._impl.parent_container_id for one in (page.verdict, page.motion.play)} == {"root"}
    assert all(slider.label.endswith(" [mm]") for slider in page.pose.sliders)
    assert not any("forward" in slider.label for slider in page.pose.sliders)  # only the readout has it


def test_the_page_starts_with_the_verdict_on_the_build(folder, quiet):
    assert quiet.page.built is None
    verdict = {"grade": "bad", "todo": ["Check <the> masks."], "because": []}
    BuildState(folder).finish("report", "", [], 0.0, {"file": "report.html", "verdict": verdict})
    running = open_viewer(folder, "127.0.0.1", 0)
    try:
        page = QuietPage(running).page
        assert "Not usable. Check &lt;the&gt; masks." in page.built.content
        first, second = page.built._impl, page.verdict._impl
        assert first.parent_container_id == "root" and first.props.order < second.props.order
    finally:
        running.stop()


def test_what_was_undone_is_done_again_by_its_key(quiet):
    session = quiet.page.session
    quiet.enter(quiet.page.pose.sliders[0], 12.0)
    keys = {
        (command._impl.props.hotkey, command._impl.props.modifier): command
        for command in quiet.client.gui._command_handle_from_uuid.values()
    }
    for modifier, opening in (("cmd/ctrl", 0.0), ("cmd/ctrl+shift", 12.0)):
        quiet.trigger(keys["Z", modifier])
        assert session.d[0] == pytest.approx(opening, abs=0.01)


@pytest.mark.parametrize("aspect", [2.0, 0.46])
@pytest.mark.parametrize("name", PRESETS)
def test_every_view_shows_the_joints_and_the_incisor_beside_the_panel_of_a_phone(name, aspect, viewer):
    rest = rest_places(viewer._actor.rig)
    target, eye = preset_view(rest, name, aspect)
    up, back = np.array([0.0, 1.0, 0.0]), (eye - target) / np.linalg.norm(eye - target)
    right = np.cross(up, back) / np.linalg.norm(np.cross(up, back))
    close = {"condyle left": [CONDYLES[0]], "condyle right": [CONDYLES[1]]}
    seen = rest[close.get(name, [INCISOR, *CONDYLES])]
    p = (seen - eye) @ np.stack([right, np.cross(back, right), -back], axis=1)
    across, upwards = (p[:, k] / p[:, 2] / np.tan(0.3) for k in (0, 1))
    assert (np.abs(across) < aspect).all() and (np.abs(upwards) < 1).all()
    if aspect < 1:
        assert (upwards > 0).all()  # the panel covers the lower half
    if name == "top":
        assert upwards[0] < upwards[1]  # front teeth below, joints above


def test_the_mandible_on_the_page_stands_where_the_rig_says(quiet):
    from jawusd.geometry import matrix_from_wxyz

    rig = quiet.page.session.rig
    quiet.enter(quiet.page.pose.sliders[0], 17.0)
    jaw = quiet.page.scene._jaw
    expected = rig.T_anatomical_skull @ rig.pose(quiet.page.session.d)
    np.testing.assert_allclose(matrix_from_wxyz(jaw.wxyz), expected[:3, :3], atol=1e-9)
    np.testing.assert_allclose(jaw.position, expected[:3, 3], atol=1e-9)


@pytest.mark.parametrize("key", [None, FREE_DEPTH])
def test_a_drag_of_the_mesh_is_inverse_kinematics_and_pins_are_shown(quiet, key):
    """With the key, the pointer's place counts; without, the line of sight through it, from the camera in front."""
    page, rig = quiet.page, quiet.page.session.rig
    quiet.enter(page.pose.sliders[0], 15.0)
    start = page.session.d
    incisor = landmark_places(rig, start)[0]
    grip = page.scene.grips[-1]
    for phase, share in (("start", 0.1), ("update", 0.5), ("update", 1.0)):
        quiet.drag(grip, phase, incisor, incisor + share * np.array([5.0, 0, 0]), key)
    assert page.scene._held.visible and page.session.dragging
    quiet.drag(grip, "end", incisor, incisor + [5.0, 0, 0], key)
    assert not page.scene._held.visible and not page.session.dragging
    A = rig.T_anatomical_skull
    sight = None if key else A[:3, :3].T @ (incisor + [5.0, 0, 0] - page.client.camera.position)
    target = np.linalg.solve(A, [*(incisor + [5.0, 0, 0]), 1])[:3]
    found, _ = rig.ik(rig.landmarks[0], target, start=start, sight=sight)
    moved = landmark_places(rig, np.stack([found, page.session.d]))[:, 0]
    assert np.linalg.norm(moved[0] - moved[1]) < 0.1 and page.session.d[1] > 2
    assert (abs(page.session.d[2]) > 0.5) == (key == FREE_DEPTH)
    quiet.enter(page.pose.pins["condyle_left"], True)
    assert page.scene._pins["condyle_left"].visible and not page.scene._pins["condyle_right"].visible
    quiet.drag(grip, "update", incisor, incisor, key)  # no effect without a grabbed point
    assert quiet.notices == []


def test_keys_are_set_moved_exported_saved_and_loaded(quiet, folder, tmp_path):
    page, motion = quiet.page, quiet.page.motion
    poses = {0: (2.0, 0.0, 0.0), 12: (16.0, 1.5, 0.0), 30: (6.0, -1.0, 0.5)}
    for frame, d in poses.items():
        quiet.enter(motion.frame_slider, float(frame))
        quiet.call(lambda d=d: (page.session.set_pose(d), page.refresh()))
        quiet.enter(button(quiet, "keys"), "set")
    assert motion.thumbs.value == (0, 12, 30) and motion.thumbs.visible
    quiet.enter(button(quiet, "write animation"), True)
    frames, T = read_poses_of_stage(folder / "anim_view.usdc")
    rig = page.session.rig
    expected = rig.pose(rig.interpolate(list(poses), list(poses.values()), frames, "smooth"))
    np.testing.assert_allclose(T, expected, atol=1e-5)
    assert quiet.notices[-1][0] == "Written" and "anim_view.usdc" in motion.source.options
    quiet.enter(button(quiet, "write animation"), True)
    assert "exists already" in quiet.notices[-1][1]
    quiet.enter(button(quiet, "save keys.json"), True)
    quiet.enter(button(quiet, "save CSV of d"), True)
    for name, content in quiet.downloads.items():
        (tmp_path / name).write_bytes(content)
    at, d = read_parameters(tmp_path / "d.csv")
    np.testing.assert_allclose(d, rig.interpolate(list(poses), list(poses.values()), at, "smooth"), atol=1e-9)
    quiet.enter(motion.thumbs, (0, 20, 25))
    assert [key.frame for key in page.session.work.keys] == [0, 20, 25]
    quiet.enter(page.files.load, UploadedFile("keys.json", quiet.downloads["keys.json"]))
    assert page.session.work.keys == load_keys(tmp_path / "keys.json").keys and motion.thumbs.value == (0, 12, 30)
    quiet.enter(motion.between, "linear")
    assert page.session.saved_keys().interpolation == "linear"
    quiet.enter(button(quiet, "go to"), "next")
    quiet.enter(button(quiet, "keys"), "copy")
    quiet.enter(motion.frame_slider, 50.0)
    quiet.enter(button(quiet, "keys"), "paste")
    quiet.enter(motion.frame_slider, 12.0)
    quiet.enter(button(quiet, "keys"), "delete")
    assert [key.frame for key in page.session.work.keys] == [0, 30, 50]


def test_a_baked_motion_is_chosen_played_round_and_stopped(quiet):
    motion, session = quiet.page.motion, quiet.page.session
    quiet.enter(motion.source, motion.source.options[1])
    clip = motion.clip()
    np.testing.assert_allclose(session.d, clip.d[0], atol=1e-9)
    shown = []
    motion.player._show = lambda frame: shown.append(frame) or motion.show(frame)
    quiet.enter(motion.play, True)
    assert motion.play.label == "pause"
    until(lambda: any(after < before for before, after in zip(shown, shown[1:], strict=False)))
    quiet.enter(motion.play, True)
    assert motion.play.label == "play" and not motion.player.playing
    np.testing.assert_allclose(session.d, clip.at(motion.frame), atol=1e-9)
    quiet.enter(motion.frame_slider, clip.span[0] + 4)
    np.testing.assert_allclose(session.d, clip.at(clip.span[0] + 4), atol=1e-9)
    assert quiet.notices == []


def frame_said(quiet):
    """Return the motion and the frame that a page names, and what it says instead of a frame."""
    words = r">([^>]+), (?:frame (\d+) of \d+ to \d+|(nothing to play|ready to play|being read))<"
    return re.search(words, quiet.page.playback._line.content)


def test_the_play_button_plays_the_take_until_there_are_keys(quiet):
    motion = quiet.page.motion
    assert frame_said(quiet).groups() == ("anim_capture.usdc", None, "ready to play")
    read = threading.Event()
    load = motion._actor.load_clip
    motion._actor = dataclasses.replace(motion._actor, load_clip=lambda name: read.wait(60) and load(name))
    pressed = threading.Thread(target=quiet.enter, args=(motion.play, True))
    pressed.start()
    until(lambda: frame_said(quiet)[3] == "being read")
    read.set()
    pressed.join()
    assert motion.player.playing and motion.source.value == "anim_capture.usdc" and quiet.notices == []
    quiet.enter(motion.play, True)
    quiet.enter(motion.source, "keys")
    quiet.enter(button(quiet, "keys"), "set")
    assert frame_said(quiet)[1] == "keys" and frame_said(quiet)[2] is not None


def test_without_a_take_and_without_keys_there_is_nothing_to_play(quiet):
    motion = quiet.page.motion
    motion._actor = dataclasses.replace(motion._actor, take=None)
    quiet.call(quiet.page.refresh)
    assert frame_said(quiet).groups() == ("keys", None, "nothing to play")
    quiet.enter(motion.play, True)
    assert "nothing to play" in quiet.notices.pop()[1] and not motion.player.playing


def test_the_captured_take_plays_as_the_page_opens_until_it_is_paused(quiet):
    motion, session = quiet.page.motion, quiet.page.session
    assert frame_said(quiet)[2] is None
    quiet.call(quiet.page.play_take)
    until(lambda: motion.player.playing)
    clip = motion.clip()
    assert motion.source.value == "anim_capture.usdc" and motion.play.label == "pause" and motion.loop.value
    until(lambda: motion.frame > clip.span[0] + 3)
    quiet.enter(motion.play, True)
    paused = motion.frame
    assert frame_said(quiet)[1] == "anim_capture.usdc" and frame_said(quiet)[2] == f"{paused:.0f}"
    np.testing.assert_allclose(session.d, clip.at(paused), atol=1e-9)
    time.sleep(0.2)
    assert motion.frame == paused and motion.play.label == "play"
    quiet.enter(motion.play, True)  # continues from there
    assert motion.player.playing and motion.frame >= paused
    quiet.enter(quiet.page.pose.sliders[0], 11.0)  # posing pauses
    assert not motion.player.playing and session.d[0] == 11.0 and quiet.notices == []


def test_a_page_that_is_closed_while_it_plays_is_sent_nothing_more(quiet):
    motion = quiet.page.motion
    quiet.call(quiet.page.play_take)
    until(lambda: motion.player.playing)
    quiet.call(quiet.page.close)
    frame = motion.frame
    time.sleep(0.2)
    assert not motion.player.playing and motion.frame == frame and motion.play.label == "pause"


@pytest.mark.parametrize("done", ["posed", "closed"])
def test_a_take_that_is_read_late_does_not_disturb(quiet, done):
    page, motion, read = quiet.page, quiet.page.motion, threading.Event()
    load = motion._actor.load_clip
    slow = dataclasses.replace(motion._actor, load_clip=lambda name: read.wait(60) and load(name))
    motion._actor = slow
    quiet.call(page.play_take)
    if done == "posed":
        quiet.enter(page.pose.sliders[0], 11.0)
    else:
        quiet.call(page.close)
    read.set()
    until(page._opening.done)
    assert not motion.player.playing and motion.source.value == "keys"
    assert page.session.d[0] == pytest.approx(11.0 if done == "posed" else 0.0, abs=0.01)


def test_a_take_that_cannot_be_read_is_a_message(quiet, folder):
    (folder / "anim_capture.usdc").write_bytes(b"PXR-USDC")
    quiet.call(quiet.page.play_take)
    until(quiet.page._opening.done)
    assert quiet.notices[-1][0] == "Failed" and quiet.page.motion.source.value == "keys"
    assert not quiet.page.motion.player.playing


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("bad.json", b'{"fps": 24, "keys": [{"frame": 0}]}', "bad.json: keys, entry 1: d"),
        ("bad.json", b"\xff\xfe\x00", "UTF-16"),
        ("bad.csv", b"frame,d1\n0,1\n", 'no column "d2"'),
        ("bad.csv", b"frame,d1,d2,d3\n4,1,0,0\n4,1,0,0\n", "do not increase"),
        ("empty.csv", b"", "is empty"),
        ("../../x.usdc", b"PXR-USDC", "x.usdc"),
    ],
)
def test_bad_files_are_messages_and_the_page_lives_on(quiet, name, content, words):
    quiet.enter(quiet.page.files.load, UploadedFile(name, content))
    title, body = quiet.notices[-1]
    assert title == "Failed" and words in body and "/tmp" not in body
    quiet.enter(quiet.page.files.load, UploadedFile("good.csv", b"frame,d1,d2,d3\n0,1,0,0\n9,9,0,0\n"))
    assert quiet.page.motion.source.value == "good.csv" and quiet.page.session.d[0] == 1.0


def test_errors_nobody_thought_of_are_messages_too(quiet):
    def broken(index, value):
        raise ZeroDivisionError("by nothing")

    quiet.page.session.set_parameter = broken
    quiet.enter(quiet.page.pose.sliders[0], 3.0)
    assert quiet.notices[-1] == ("Unexpected error", "ZeroDivisionError: by nothing")


def test_the_nearest_captured_poses_follow_the_jaw(quiet):
    pose, scene, rig = quiet.page.pose, quiet.page.scene, quiet.page.session.rig
    assert scene._ghosts == []  # nothing is sent before they are switched on
    quiet.enter(pose.sliders[0], 12.0)
    quiet.enter(pose.ghosts, True)
    for opening in (12.0, 25.0):
        quiet.enter(pose.sliders[0], opening)
        d = quiet.page.session.d
        near = nearest_captured(rig, d)
        far = np.linalg.norm(rig.captured_d - d, axis=1)
        assert np.linalg.norm(near[0] - d) == far.min() and len(near) == len(scene._ghosts) == GHOSTS
        apart = np.linalg.norm(near[:, None] - near, axis=2)[np.triu_indices(GHOSTS, 1)]
        assert (apart >= GHOSTS_APART_MM).all()
        places = (rig.T_anatomical_skull @ rig.pose(near))[:, :3, 3]
        np.testing.assert_allclose([ghost.position for ghost in scene._ghosts], places, atol=1e-6)
        assert all(ghost.visible for ghost in scene._ghosts)
    quiet.enter(pose.ghosts, False)
    assert not any(ghost.visible for ghost in scene._ghosts)


def test_two_pages_do_not_mix(viewer):
    one, other = QuietPage(viewer, 0), QuietPage(viewer, 1)
    one.enter(one.page.pose.sliders[0], 18.0)
    one.enter(button(one, "keys"), "set")
    assert other.page.pose.sliders[0].value == 0.0 and other.page.session.work.keys == ()
    other.enter(other.page.pose.sliders[0], 6.0)
    assert one.page.pose.sliders[0].value == 18.0
