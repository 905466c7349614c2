"""Mistakes of a beginner in the shell; those in capture.toml are in tests/formats/test_capture_errors.py.

Each gives one message without a traceback, with the wrong argument and a remedy.
"""

import shutil

import pytest
from capture_texts import HEAD, TABLES, write_media
from run_jawusd import program

from jawusd.rig.layout import EXAMPLE_RIG

CAPTURE = f'{HEAD}calibration = "cal.toml"\n{TABLES}'


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Return a folder with a capture, clips, an empty folder of a rig, and files of other kinds."""
    folder = tmp_path_factory.mktemp("newcomer")
    write_media(folder)
    (folder / "capture.toml").write_text(CAPTURE)
    (folder / "cal.toml").write_text("[cam_0]\n")
    (folder / "empty").mkdir()
    (folder / "full").mkdir()
    (folder / "full" / "diary.txt").touch()
    (folder / "two").mkdir()
    for name in ("anna_upper.stl", "bob_upper.stl", "anna_lower.stl", "bob_lower.stl"):
        (folder / "two" / name).touch()
    for name in ("plates", "sequence"):
        (folder / name).mkdir()
    for number in (1, 2):
        (folder / "plates" / f"left.{number:04d}.exr").write_bytes(b"no picture")
    text = CAPTURE.replace('"left.mp4"', '"plates/lefft.####.exr"')
    (folder / "sequence" / "capture.toml").write_text(text.replace('"plates', '"../plates'))
    (folder / "spaces in.toml").write_text("this is no TOML")
    shutil.copytree(EXAMPLE_RIG.parent, folder / "rig")
    text = (folder / "rig" / "actor.usda").read_text()
    (folder / "rig" / "half.usda").write_text(text[:300])
    for name, content in MOTIONS.items():
        (folder / name).write_text(content)
    return folder


MOTIONS = {
    "motion.csv": "frame,d1,d2,d3\n0,0,0,0\n10,20,0,0\n",
    "times.csv": "time,d1,d2,d3\n0.0,0,0,0\n0.5,20,0,0\n",
    "angles.csv": "frame,tx,ty,tz,rx,ry,rz\n0,0,0,0,0,0,0\n",
    "lists.json": "[[0, 0, 0, 0], [10, 20, 0, 0]]",
    "nothing.json": "",
}
MISTAKES = [
    ("a capture that is not there", ["check", "nowhere"], ["there is no such file", "nowhere"]),
    ("a folder without capture.toml", ["check", "empty"], ["there is no such file", "jawusd init"]),
    ("a video in place of a capture", ["build", "left.mp4", "-o", "out"], ["a capture is a folder", "jawusd init"]),
    ("a scan in place of a capture", ["build", "u.ply", "-o", "out"], ["u.ply"]),
    ("text that is no TOML", ["check", "spaces in.toml"], ["is not valid TOML"]),
    ("no output folder", ["build", "."], ["--out"]),
    ("an output that is a file", ["build", ".", "-o", "u.ply"], ["is a file; the rig needs a folder"]),
    ("an output with other files", ["build", ".", "-o", "full"], ["exists and is not empty", "Choose a new folder"]),
    ("a calibration that lacks all", ["build", ".", "-o", "out"], ['[cam_0] has no "size"']),
    ("a capture in place of a rig", ["info", "."], ["without actor.usda", "jawusd build"]),
    (
        "a folder in place of a rig",
        ["pose", "empty", "--d", "1,2,3"],
        ["without actor.usda", "Give the folder of a build"],
    ),
    ("the file of a capture in place of a rig", ["info", "capture.toml"], ["This is a capture", "jawusd build"]),
    ("the meshes in place of a rig", ["info", "rig/geo.usdc"], ["has no jaw rig", "Give rig/actor.usda"]),
    ("keys in place of a rig", ["info", "lists.json"], ["is not a USD file", ".usda, .usdc"]),
    ("half of a rig", ["info", "rig/half.usda"], ["half.usda", "line ", "ends too early"]),
    ("keys that are not there", ["animate", "rig", "keys.json"], ["keys.json: there is no such file"]),
    ("keys of nothing", ["animate", "rig", "nothing.json"], ["nothing.json: is empty"]),
    ("keys as lists", ["animate", "rig", "lists.json"], ["an object for each frame", '"d1": 20']),
    ("times in place of frames", ["animate", "rig", "times.csv"], ['no column "frame"', "instead of giving times"]),
    ("angles in place of a quaternion", ["animate", "rig", "angles.csv"], ["as quaternions qw, qx, qy, qz"]),
    ("an animation as a video", ["animate", "rig", "motion.csv", "-o", "a.mp4"], ["must end in .usdc, .usda or .usd"]),
    ("a rig that is not there", ["info", "out/actor.usda"], ["out/actor.usda"]),
    ("a video in place of a rig", ["info", "left.mp4"], ["left.mp4"]),
    ("two numbers of three", ["pose", "u.ply", "--d", "20,2"], ["needs three numbers", "--d"]),
    ("words in place of numbers", ["pose", "u.ply", "--d", "open", "2", "1"], ["three numbers", '"open 2 1"', "--d"]),
    ("a command that is none", ["bild", "."], ["bild"]),
    ("an option that is none", ["build", ".", "--output", "out"], ["--output"]),
    ("a model that is none", ["build", ".", "-o", "out", "--model", "linear"], ["linear", "anchored"]),
    ("both of two opposites", ["build", ".", "-o", "empty", "--resume", "--fresh"], ["cal.toml"]),
    ("a folder for init that is none", ["init", "nowhere"], ["there is no such folder"]),
    ("a video for init", ["init", "left.mp4"], ["is a file", "Give the folder"]),
    ("a second init", ["init", "."], ["exists already", "--force"]),
    ("two people in one folder", ["init", "two"], ["anna_upper.stl, bob_upper.stl", "a folder is for one subject"]),
    ("one clip to align", ["sync", "left.mp4"], ["left.mp4"]),
    ("clips without a flash", ["sync", "left.mp4", "right.mp4"], ["shows no light flash"]),
    ("a clip twice", ["sync", "left.mp4", "left.mp4"], ["given twice"]),
    ("a sequence that is not there", ["check", "sequence", "--allow-outside"], ["lefft.####.exr", "left.%04d.exr"]),
    ("a calibration of nothing", ["cameras", "u.ply", "-o", "a.toml"], ["u.ply"]),
    ("cameras to a format that is not written", ["cameras", "cal.toml", "-o", "a.fbx"], ["cal.toml"]),
    ("a size that is none", ["cameras", "cal.toml", "-o", "a.toml", "--size", "big"], ["1920x1080"]),
]


@pytest.mark.parametrize(("name", "words", "told"), MISTAKES, ids=[name for name, _, _ in MISTAKES])
def test_a_mistake_is_one_message(place, monkeypatch, name, words, told):
    monkeypatch.chdir(place)
    done = program(*words)
    said = done.stderr + done.stdout
    assert done.returncode not in (0, 70) and "Traceback" not in said, said
    assert all(word in " ".join(said.split()) for word in told), said
