"""A studio's folders: two actors in a library, shots elsewhere that reference their motion, several rigs per stage."""

import json
import shutil

import numpy as np
import pytest
from example_rig import FPS, example_meshes, example_motion, example_rig
from pxr import Gf, Sdf, Usd, UsdGeom
from typer.testing import CliRunner

import jawusd
from jawusd.base.errors import FormatError
from jawusd.cli.main import app
from jawusd.pipeline.view import viewed_actor
from jawusd.rig import allow_folders
from jawusd.rig.bake import bake_rig
from jawusd.rig.motion_read import read_poses_of_stage
from jawusd.viewer.motion import Clip

KINDS = {"hero": "anchored", "villain": "additive"}
OFFSET, COUNT = 100, 12


def run(*arguments, code=0):
    done = CliRunner().invoke(app, [str(x) for x in arguments])
    assert done.exit_code == code, (done.output, done.exception)
    return done.stdout


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """Return a folder with two published actors under different file names."""
    folder = tmp_path_factory.mktemp("studio") / "lib"
    frames, d = example_motion(COUNT)
    for name, kind in KINDS.items():
        options = {"name": name, "fps": FPS, "frames": frames, "d": d, "table_size": 17}
        bake_rig(folder.parent / "built" / name, example_rig(kind), example_meshes(), **options)
        run("publish", folder.parent / "built" / name, "-o", folder / name)
    shutil.rmtree(folder.parent / "built")
    return folder


@pytest.fixture
def shot(library, tmp_path):
    """Return a shot in cm with both actors at other places, one with a time offset, and a crowd of instances."""
    shutil.copytree(library, tmp_path / "lib")
    (tmp_path / "shots").mkdir()
    stage = Usd.Stage.CreateNew(str(tmp_path / "shots" / "sh010.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Y")
    frames, _ = example_motion(COUNT)
    stage.SetTimeCodesPerSecond(FPS)
    stage.SetStartTimeCode(float(frames[0]))
    stage.SetEndTimeCode(float(frames[-1] + OFFSET))
    stage.SetDefaultPrim(stage.DefinePrim("/Shot", "Xform"))
    for name, offset in (("hero", 0), ("villain", OFFSET)):
        prim = stage.DefinePrim(f"/Shot/{name}", "Xform")
        prim.GetReferences().AddReference(f"../lib/{name}/{name}_anim_capture.usdc", Sdf.LayerOffset(offset))
        place = UsdGeom.XformCommonAPI(prim)
        place.SetTranslate(Gf.Vec3d(offset, 3, 4))
        place.SetScale(Gf.Vec3f(0.1))
    for i in range(2):
        prim = stage.DefinePrim(f"/Shot/crowd{i}", "Xform")
        prim.GetReferences().AddReference("../lib/hero/hero_anim_capture.usdc")
        prim.SetInstanceable(True)
    stage.Save()
    return tmp_path / "shots" / "sh010.usda"


def test_a_library_is_refused_until_it_is_allowed(shot, monkeypatch):
    allow = ("--allow", shot.parents[1] / "lib")
    refused = CliRunner().invoke(app, ["info", str(shot), "--prim", "/Shot/hero"])
    assert "--allow" in refused.exception.hint and "not a rig" in str(refused.exception)
    for name, kind in KINDS.items():
        found = json.loads(run("info", shot, "--prim", f"/Shot/{name}", *allow, "--json"))
        assert found["actor"] == name and found["model"]["kind"] == kind
        posed = json.loads(run("pose", shot, "--prim", f"/Shot/{name}", *allow, "--d", 12, 1, 1, "--json"))
        np.testing.assert_allclose(posed["T_skull_mandible"], example_rig(kind).pose([12, 1, 1]), atol=1e-12)
    assert CliRunner().invoke(app, ["info", str(shot), "--prim", "/Shot/hero"]).exit_code != 0, "allowed for one run"
    monkeypatch.setenv("JAWUSD_ALLOW", str(shot.parents[1] / "lib"))
    assert jawusd.load(shot, prim="/Shot/villain").kind == "additive"


def overridden(shot):
    """Write a layer over a shot that moves one actor, hides the other's skull and recolours a mesh."""
    path = shot.with_name("sh010_light.usda")
    stage = Usd.Stage.CreateNew(str(path))
    stage.GetRootLayer().subLayerPaths.append("./sh010.usda")
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Y")
    stage.SetTimeCodesPerSecond(FPS)
    below = Usd.Stage.Open(str(shot))
    stage.SetStartTimeCode(below.GetStartTimeCode())
    stage.SetEndTimeCode(below.GetEndTimeCode())
    stage.SetDefaultPrim(stage.GetPrimAtPath("/Shot"))
    UsdGeom.XformCommonAPI(stage.GetPrimAtPath("/Shot/hero")).SetRotate((10, 20, 30))
    UsdGeom.Imageable(stage.GetPrimAtPath("/Shot/villain/geo/Skull/SkullMesh")).MakeInvisible()
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Shot/hero/geo/Mandible/MandibleMesh"))
    mesh.GetDisplayColorAttr().Set([Gf.Vec3f(1, 0, 0)])
    stage.Save()
    return path


def packed(shot):
    """Pack a shot, and delete its sources."""
    refused = CliRunner().invoke(app, ["publish", str(shot), "-o", str(shot.with_name("sh010.usdz"))])
    assert "--allow" in refused.exception.hint
    run("publish", shot, "-o", shot.with_name("sh010.usdz"), "--allow", shot.parents[1] / "lib")
    (shot.parents[1] / "lib").rename(shot.parents[1] / "library")
    shot.unlink()
    return shot.with_name("sh010.usdz")


@pytest.mark.slow
@pytest.mark.parametrize("made", [lambda shot: shot, overridden, packed], ids=["shot", "overridden", "packed"])
def test_every_command_takes_the_right_actor(shot, tmp_path, made):
    stage = made(shot)
    lib = next(tmp_path.glob("lib*"))
    allow = () if stage.suffix == ".usdz" else ("--allow", lib)
    if allow:
        refused = CliRunner().invoke(app, ["validate", str(stage)])
        assert "--allow" in refused.exception.hint
    run("validate", stage, *allow)
    frames, d = example_motion(COUNT)
    for name, kind in {**KINDS, "crowd1": "anchored"}.items():
        prim, actor = f"/Shot/{name}", lib / {"crowd1": "hero"}.get(name, name)
        actor = actor / f"{actor.name}.usda"
        first = frames[0] + (OFFSET if name == "villain" else 0)
        found = json.loads(run("info", stage, "--prim", prim, *allow, "--json"))
        assert found["model"]["kind"] == kind and found["prim"] == prim and min(found["meshes"].values()) > 0
        run("validate", actor, stage, "--prim", prim, *allow)
        run("encode", actor, stage, "-o", tmp_path / f"{name}.csv", "--prim", prim, *allow)
        read = np.loadtxt(tmp_path / f"{name}.csv", delimiter=",", skiprows=1)
        inside = (read[:, 0] >= first) & (read[:, 0] < first + COUNT)
        np.testing.assert_allclose(read[inside, 1:4], d, atol=1e-5)
        keys = tmp_path / "keys.json"
        keys.write_text(json.dumps({"fps": 12, "keys": [{"frame": 20 + k, "d": [2 * k, 0, 0]} for k in range(5)]}))
        out = stage.with_name(f"{name}_keyed.usdc")
        run("animate", stage, keys, "-o", out, "--prim", prim, *allow)
        run("validate", out, *allow)
        allow_folders([lib])
        np.testing.assert_array_equal(jawusd.load(out, prim=prim).pose(d), example_rig(kind).pose(d))
        times, T = read_poses_of_stage(out, prim)
        keyed = np.interp(times, [40, 48], [0, 8])[:, None] * [1, 0, 0]  # at half the rate of the shot
        np.testing.assert_allclose(T, example_rig(kind).pose(keyed), atol=1e-6)
        times, T = read_poses_of_stage(stage, prim)
        shown = np.isin(times, np.arange(COUNT) + first)
        np.testing.assert_allclose(T[shown], example_rig(kind).pose(d), atol=1e-6)
        allow_folders([])


def test_the_viewer_shows_the_named_actor_and_keys_it(shot, tmp_path):
    allow_folders([tmp_path / "lib"])
    with pytest.raises(FormatError, match="several jaw rigs"):
        viewed_actor(shot)
    actor, alone = viewed_actor(shot, "/Shot/villain"), viewed_actor(tmp_path / "lib" / "villain" / "villain.usda")
    assert actor.name == "villain" and actor.rig.model_hash == alone.rig.model_hash
    assert {name: len(mesh.faces) for name, mesh in actor.meshes.items()} == {
        name: len(mesh.faces) for name, mesh in alone.meshes.items()
    }
    frames, d = example_motion(COUNT)
    clip = Clip("keys", np.array([0.0, 3, 6]) + frames[0] / 2, np.array([[0.0, 0, 0], [9, 1, 0], [3, 0, 0]]), FPS / 2)
    actor.save_layer("anim_villain.usdc", clip, False)
    shown = actor.load_clip("anim_villain.usdc")
    keyed = (shown.frames >= 2 * clip.frames[0]) & (shown.frames <= 2 * clip.frames[-1])  # at half the shot's rate
    wanted = np.stack([np.interp(shown.frames[keyed], 2 * clip.frames, column) for column in clip.d.T], axis=1)
    assert keyed.sum() == 13
    np.testing.assert_allclose(shown.d[keyed], wanted, atol=1e-4)
    times, T = read_poses_of_stage(tmp_path / "shots" / "anim_villain.usdc", "/Shot/hero")
    np.testing.assert_allclose(T[np.isin(times, frames)], example_rig().pose(d), atol=1e-6)
    allow_folders([])
