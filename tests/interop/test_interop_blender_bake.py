"""Jaws of the Blender add-on: baked to keys, opened without the add-on, exported as FBX and glTF, keyed by splines."""

import json
import re

import numpy as np
import pytest
from example_rig import FPS, example_motion, example_rig, mandible_vertices, moved, scanned_meshes
from foreign import environment, run_in
from pxr import Usd
from typer.testing import CliRunner

from jawusd.cli.main import app
from jawusd.plugins.extension import build_extension
from jawusd.rig.bake import bake_rig

BLENDERS = ["blender45", "blender50"]
FRAMES, D = example_motion()
RIG = example_rig()
EXPORTED = "/root"  # Blender's default prim above all that it exports
JAW = ("--mandible", f"{EXPORTED}/Actor/geo/Mandible", "--skull", f"{EXPORTED}/Actor/geo/Skull")
SPLINES = ["splines", "alone", "edited", "over"]
SHOWN_MM = 0.02
EXPORTED_MM = 0.01
KEYS = {
    "fps": FPS,
    "interpolation": "smooth",
    "keys": [{"frame": f, "d": d} for f, d in ((1, (0, 0, 0)), (13, (20, 0, 0)), (25, (8, 3, 0)))],
}
pytestmark = pytest.mark.slow


def run(*arguments):
    done = CliRunner().invoke(app, [str(x) for x in arguments])
    assert done.exit_code == 0, (done.output, done.exception)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a baked rig, spline layers over it, instances of it, and the add-on."""
    made = tmp_path_factory.mktemp("actor")
    bake_rig(made, RIG, scanned_meshes(), name="x", fps=FPS, frames=FRAMES, d=D, table_size=17)
    (made / "keys.json").write_text(json.dumps(KEYS))
    run(
        "animate",
        made / "actor.usda",
        made / "keys.json",
        "-o",
        made / "keyed.usdc",
        "--splines",
        made / "splines.usda",
    )
    alone = (made / "splines.usda").read_text()
    # splines without samples below, and over samples with other values
    (made / "alone.usda").write_text(alone.replace("keyed.usdc", "actor.usda"))
    (made / "edited.usda").write_text(alone.replace("13: 20;", "13: 15;"))
    # samples, and a value, in a layer above the splines
    over = Usd.Stage.CreateNew(str(made / "over.usda"))
    over.GetRootLayer().subLayerPaths.append("./splines.usda")
    over.SetDefaultPrim(over.GetPrimAtPath("/Actor"))
    for name, times in (("StartTimeCode", 1), ("EndTimeCode", 25), ("TimeCodesPerSecond", FPS)):
        getattr(over, f"Set{name}")(times)
    actor = over.GetPrimAtPath("/Actor")
    for time, opening in ((1, 3), (25, 4)):
        actor.GetAttribute("jaw:d1").Set(float(opening), float(time))
    actor.GetAttribute("jaw:d2").Set(1.0)
    over.Save()
    shot = Usd.Stage.CreateNew(str(made / "instances.usda"))
    shot.SetDefaultPrim(shot.DefinePrim("/Shot", "Xform"))
    inner = Usd.Stage.CreateNew(str(made / "inner.usda"))
    inner.SetDefaultPrim(inner.DefinePrim("/Inner", "Xform"))
    inner.DefinePrim("/Inner/hero", "Xform").GetReferences().AddReference("./anim_capture.usdc")
    inner.Save()
    for name, file in (("a", "anim_capture.usdc"), ("b", "anim_capture.usdc"), ("group", "inner.usda")):
        prim = shot.DefinePrim(f"/Shot/{name}", "Xform")
        prim.GetReferences().AddReference(f"./{file}")
        prim.SetInstanceable(True)
    shot.Save()
    build_extension(made / "jawusd_blender.zip")
    return made


@pytest.fixture(scope="module", params=BLENDERS)
def session(request, folder, tmp_path_factory):
    """Return a Blender, the folder of its files, and its output."""
    left = tmp_path_factory.mktemp(request.param)
    splines = ",".join(str(folder / f"{name}.usda") for name in SPLINES)
    arguments = (left, folder / "anim_capture.usdc", splines, folder / "instances.usda", FRAMES[15])
    return request.param, left, run_in(request.param, "blender_bake.py", folder / "jawusd_blender.zip", *arguments)


def distance_mm(matrices, d):
    """Return the largest distance of the mandible's vertices from their positions by the evaluator."""
    points = mandible_vertices()
    return np.linalg.norm(moved(np.array(matrices), points) - moved(RIG.pose(d), points), axis=-1).max()


def motion(found):
    """Return frames, d and matrices of a motion that was played."""
    return np.array(list(found), int), *(np.array([row[k] for row in found.values()]) for k in (0, 1))


def test_splines_move_the_jaw(session, folder):
    _, _, found = session
    for name, played in zip(SPLINES, found["splines"], strict=True):
        frames, d, matrices = motion(played)
        np.testing.assert_array_equal(frames, np.arange(1, 26))
        assert distance_mm(matrices, d) < SHOWN_MM
        stage = Usd.Stage.Open(str(folder / f"{name}.usda"))
        prim = stage.GetPrimAtPath("/Actor")
        wanted = [[prim.GetAttribute(f"jaw:d{k}").Get(float(frame)) for k in (1, 2, 3)] for frame in frames]
        np.testing.assert_allclose(d, wanted, atol=1e-5)
    assert np.ptp(motion(found["splines"][0])[1][:, 0]) > 19


def test_baked_keys_are_the_motion_of_the_sliders(session):
    _, _, found = session
    frames, d, matrices = motion(found["played"])
    wanted = D[np.clip(frames - FRAMES[0], 0, None)]
    np.testing.assert_allclose(d, wanted, atol=1e-5)
    _, _, keyed = motion(found["keyed"])
    assert max(distance_mm(matrices, d), distance_mm(keyed, d)) < SHOWN_MM
    (*_, live), (*_, baked) = found["live"], found["baked"]
    assert live["drivers"] == 6 and live["frames"] == [] and found["frame"] == FRAMES[15]
    assert baked["frames"] == [frames.tolist()] * 7 and baked["interpolation"] == ["LINEAR"]
    assert baked["drivers"] == 0 and baked["offset"] == [0, 0, 0, 1, 0, 0, 0]
    turns = np.array([baked["values"][f"rotation_quaternion{k}"] for k in range(4)])
    assert (turns[:, 1:] * turns[:, :-1]).sum(axis=0).min() > 0.9
    assert found["undone"]["drivers"] == 6 and found["undone"]["frames"] == []
    assert found["take"]["frames"] == [FRAMES.tolist()] * 7
    again, played = found["sliders"]
    assert again["drivers"] == 6 and again["frames"] == [] and again["actions"] == ["ActorAction"]
    assert distance_mm(motion(played)[2], d) < SHOWN_MM


def test_what_cannot_be_baked_is_named(session):
    _, _, found = session
    assert "no jaw rig Nobody" in found["nothing"]
    assert "Actor have no keys" in found["no_keys"]
    assert "was deleted" in found["no_mandible"]


@pytest.mark.parametrize("scripts", [0, 1])
def test_files_open_without_the_add_on(session, scripts):
    """A driven jaw is in its rest pose, a baked one moves."""
    blender, left, _ = session
    opened = run_in(blender, "blender_reopen.py", left / "live.blend", scripts)
    assert distance_mm(list(opened.values()), np.zeros((len(opened), 3))) < 1e-4
    (saved, first), *rows = run_in(blender, "blender_reopen.py", left / "baked.blend", scripts).items()
    frames = np.array([int(frame) for frame, _ in rows])
    assert saved == f"saved on {FRAMES[15]}" and distance_mm([first], D[[15]]) < SHOWN_MM
    assert distance_mm([matrix for _, matrix in rows], D[np.clip(frames - FRAMES[0], 0, None)]) < SHOWN_MM


def test_exports_of_live_sliders_are_warned_of(session):
    _, _, found = session
    (heard, panels, warning, _), (heard_baked, panels_baked, warning_baked, _) = found["live"], found["baked"]
    assert re.match("Mandible will not move.*Bake it to keys", warning) and warning in heard
    assert warning_baked is None and not [line for line in heard_baked if "will not move" in line]
    assert panels == panels_baked == [True, True, False]


@pytest.mark.parametrize("file", ["baked.fbx", "baked.glb", "jaws.fbx", "scene.fbx", "scene_live.fbx"])
def test_exports_come_back_to_d(session, folder, tmp_path, monkeypatch, file):
    """With default export settings. If a camera moves as well, FBX is exported as one take; that needs no baking."""
    blender, left, _ = session
    monkeypatch.setenv("JAWUSD_BLENDER", str(environment(blender) / "bin" / "python"))
    options = () if file.startswith("baked") else JAW
    assert_holds_take(folder / "actor.usda", left / file, tmp_path / "d.csv", *options)


def assert_holds_take(rig, file, out, *options):
    """Encode a file and check that its last poses are the take, and those before, if any, its first pose."""
    run("encode", rig, file, "-o", out, *options)
    d = np.loadtxt(out, delimiter=",", skiprows=1)[:, 1:4]
    before = len(d) - len(D)
    assert before in (0, 10)
    np.testing.assert_allclose(d, D[np.clip(np.arange(-before, len(D)), 0, None)], atol=EXPORTED_MM)


def test_takes_of_other_objects_are_not_taken_for_the_jaws(session, folder, tmp_path, monkeypatch):
    """By default FBX applies the camera's action to the jaw: in Blender 4.5 it is at rest, in 5.0 it moves."""
    blender, left, _ = session
    monkeypatch.setenv("JAWUSD_BLENDER", str(environment(blender) / "bin" / "python"))
    arguments = (folder / "actor.usda", left / "scene_default.fbx", tmp_path / "d.csv", *JAW)
    if blender == "blender45":
        assert_holds_take(*arguments)
    else:
        with pytest.raises(AssertionError, match="Mandible moves in several takes .*CameraAction.*All Actions off"):
            assert_holds_take(*arguments)


def test_instances_are_named_and_edited_on_request(session):
    _, _, found = session
    (none, named), (actors, rest) = found["instanced"]
    assert none == [] and [line.split(":")[0] for line in named] == ["/Shot/a", "/Shot/b", "/Shot/group/hero"]
    assert all('"Scene Instancing" off' in line for line in named)
    assert len(actors) == 3 and rest == [] and found["panel"]
