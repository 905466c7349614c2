"""Shots in which only d or only the mandible was keyed are found and baked again."""

import json

import numpy as np
import pytest
from example_rig import assert_valid_usd, example_meshes, example_motion, example_rig
from keyed_shots import KEYS, key_d, keyed, run, shot
from pxr import Gf, Sdf, Ts, Usd, UsdGeom
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from jawusd.base.errors import FormatError, RigError
from jawusd.cli.main import app
from jawusd.evaluator import JawRig
from jawusd.rig import write_animation
from jawusd.rig.bake import bake_rig
from jawusd.rig.motion_read import read_parameters_of_stage, read_poses_of_stage
from jawusd.rig.rebake import deviation, motion_of_stage


def key_splines(prim):
    for i in range(3):
        spline = Ts.Spline("double")
        for time, d in KEYS.items():
            knot = Ts.Knot("double")
            knot.SetTime(time)
            knot.SetValue(d[i])
            knot.SetNextInterpolation(Ts.InterpLinear)
            spline.SetKnot(knot)
        prim.GetAttribute(f"jaw:d{i + 1}").SetSpline(spline)


def hold_d(prim):
    for i in range(3):
        prim.GetAttribute(f"jaw:d{i + 1}").Set(KEYS[13][i])


@pytest.mark.parametrize("change", [key_d, key_splines])
def test_keys_of_d_alone_are_found_and_baked(folder, kind, change):
    path = shot(folder, change)
    out = run("validate", path, code=1)
    assert "Only d is keyed" in out
    judged = json.loads(run("validate", folder / "actor.usda", path, "--json", code=1))
    assert judged["unbaked"]["frames"] >= 24 and judged["unbaked"]["largest_mm"] > 10
    run("rebake", folder / "actor.usda", path, "-o", folder / "baked.usdc", "--root")
    run("validate", folder / "actor.usda", folder / "baked.usdc")
    frames, T = read_poses_of_stage(folder / "baked.usdc")
    np.testing.assert_array_equal(frames, np.arange(1, 26))
    np.testing.assert_allclose(T, example_rig(kind).pose(keyed(frames)), atol=1e-6)
    assert_valid_usd(folder / "baked.usdc")


def test_a_mandible_moved_by_hand_gives_d_inside_the_bound(folder, kind):
    rig = example_rig(kind)
    wanted = keyed(np.arange(1, 26.0))
    wanted[20] = [15.0, 9.0, 1.0]
    assert rig.margin(wanted[20]) < -1 and rig.is_inside(np.delete(wanted, 20, 0)).all()

    def move(prim):
        mandible = UsdGeom.Xformable(prim.GetStage().GetPrimAtPath(f"{prim.GetPath()}/geo/Mandible"))
        op = mandible.MakeMatrixXform()
        for time, T in enumerate(rig.pose(wanted), start=1):
            op.Set(Gf.Matrix4d(T.T.tolist()), time)

    path = shot(folder, move)
    found = json.loads(run("rebake", folder / "actor.usda", path, "-o", folder / "baked.usdc", "--root", "--json"))
    assert found["from"] == "mandible" and found["outside"] == 1 and found["worst_frame"] == 21
    assert found["worst_margin_mm"] == pytest.approx(float(rig.margin(wanted[20])), abs=1e-3)
    times, d, _ = read_parameters_of_stage(folder / "baked.usdc")
    assert rig.is_inside(d).all()
    # moving inside is continuous in time, so neighbours of the pose outside may move as well
    far = [k for k in range(25) if abs(k - 20) > 3]
    np.testing.assert_allclose(d[np.searchsorted(times, np.array(far) + 1)], wanted[far], atol=1e-3)
    run("validate", folder / "actor.usda", folder / "baked.usdc")
    assert_valid_usd(folder / "baked.usdc")


def test_what_was_edited_last_counts(folder, kind):
    """A layer over an animation has its own keys; in the animation itself the edit cannot be detected."""
    rig, (frames, d) = example_rig(kind), example_motion()
    animation = write_animation(folder / "anim.usdc", folder / "actor.usda", frames, d, 24)
    for name, expected in (("xformOp:translate", "mandible"), ("jaw:d1", "d")):
        layer = Sdf.Layer.CreateNew(str(folder / f"over_{expected}.usda"))
        layer.subLayerPaths.append("./anim.usdc")
        layer.startTimeCode, layer.endTimeCode = float(frames[0]), float(frames[-1])
        stage = Usd.Stage.Open(layer)
        path = "/Actor" if expected == "d" else "/Actor/geo/Mandible"
        attribute = stage.GetPrimAtPath(path).GetAttribute(name)
        for frame in frames.tolist():
            value = attribute.Get(frame)
            attribute.Set(value + (0.5 if expected == "d" else Gf.Vec3d(0, -0.5, 0)), frame)
        layer.Save()
        assert motion_of_stage(layer.realPath, rig).origin == expected
    assert deviation(animation, rig).frames == 0 and motion_of_stage(animation, rig).origin == "d"
    with pytest.raises(RigError, match="is a layer over the stage"):
        run_rebake_onto_itself(folder, animation)
    layer = Sdf.Layer.FindOrOpen(str(animation))
    for frame in frames.tolist():
        layer.SetTimeSample("/Actor.jaw:d1", frame, 0.0)
    layer.Save()
    with pytest.raises(RigError, match="both have keys in one layer"):
        motion_of_stage(animation, rig)
    assert motion_of_stage(animation, rig, origin="d").d[:, 0].max() == 0


def run_rebake_onto_itself(folder, path):
    done = CliRunner().invoke(app, ["rebake", str(folder / "actor.usda"), str(path), "-o", str(path), "--force"])
    raise done.exception


def test_one_of_several_rigs_is_named(folder, kind):
    path = shot(folder, key_d, actors=("Anna", "Ben"))
    with pytest.raises(FormatError, match="Choose one with --prim"):
        motion_of_stage(path, example_rig(kind))
    run("rebake", folder / "actor.usda", path, "-o", folder / "baked.usdc", "--root", "--prim", "/Shot/Ben")
    for name, moves in (("Anna", False), ("Ben", True)):
        _, T = read_poses_of_stage(folder / "baked.usdc", f"/Shot/{name}")
        assert (np.ptp(T[:, :3, 3], axis=0).max() > 1) == moves
    run("validate", folder / "actor.usda", folder / "baked.usdc", "--prim", "/Shot/Ben")


def test_an_instance_is_made_editable(folder, kind):
    def instanced(prim):
        prim.SetInstanceable(True)
        key_d(prim)

    path = shot(folder, instanced)
    run("rebake", folder / "actor.usda", path, "-o", folder / "baked.usdc", "--root")
    frames, T = read_poses_of_stage(folder / "baked.usdc")
    np.testing.assert_allclose(T, example_rig(kind).pose(keyed(frames)), atol=1e-6)


@pytest.mark.parametrize("source", ["actor.usda", "anim_capture.usdc"])
def test_a_d_that_is_held_is_found_and_baked(anchored_folder, source):
    """A single value in the shot overrides a still jaw and a captured motion, as the animator intends."""
    folder = anchored_folder
    path = shot(folder, hold_d, source=source)
    run("validate", path, code=1)
    judged = json.loads(run("validate", folder / "actor.usda", path, "--json", code=1))
    assert judged["unbaked"]["largest_mm"] > 10
    found = json.loads(run("rebake", folder / "actor.usda", path, "-o", folder / "baked.usdc", "--root", "--json"))
    assert found["from"] == "d"
    run("validate", folder / "baked.usdc")
    run("validate", folder / "actor.usda", folder / "baked.usdc")
    _, T = read_poses_of_stage(folder / "baked.usdc")
    np.testing.assert_allclose(T, np.tile(example_rig().pose(KEYS[13]), (25, 1, 1)), atol=1e-6)


def test_a_mandible_that_departs_from_d_between_keys_is_found(anchored_folder):
    """Equal at both keys, but linear between them, unlike a jaw."""
    folder = anchored_folder
    rig = example_rig()

    def key_both(prim):
        mandible = prim.GetStage().GetPrimAtPath(f"{prim.GetPath()}/geo/Mandible")
        for time in (1, 13):
            for i in range(3):
                prim.GetAttribute(f"jaw:d{i + 1}").Set(KEYS[time][i], time)
            T = rig.pose(KEYS[time])
            x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
            mandible.GetAttribute("xformOp:translate").Set(Gf.Vec3d(*T[:3, 3]), time)
            mandible.GetAttribute("xformOp:orient").Set(Gf.Quatd(w, x, y, z), time)

    path = shot(folder, key_both)
    assert "the maximum is 0.03 mm" in run("validate", path, code=1)
    assert deviation(path, rig).largest_mm > 0.3
    run("validate", folder / "actor.usda", path, code=1)


@pytest.mark.parametrize(("fps", "offset"), [(24, Sdf.LayerOffset(-11.3, 1.37)), (60, Sdf.LayerOffset())])
def test_a_take_at_another_pace_is_as_valid_as_before(anchored_folder, fps, offset):
    folder = anchored_folder

    def retime(prim):
        prim.GetStage().SetTimeCodesPerSecond(fps)
        prim.GetStage().SetEndTimeCode(110)
        prim.GetReferences().SetReferences([Sdf.Reference("./anim_capture.usdc", layerOffset=offset)])

    path = shot(folder, retime)
    run("validate", path)
    run("validate", folder / "actor.usda", path)
    run("rebake", folder / "actor.usda", path, "-o", folder / "baked.usdc", "--root")
    run("validate", folder / "baked.usdc")


def test_a_moved_skull_is_found_and_taken_out_of_poses(anchored_folder):
    folder = anchored_folder

    def lower(prim):
        skull = prim.GetStage().GetPrimAtPath(f"{prim.GetPath()}/geo/Skull")
        UsdGeom.Xformable(skull).AddTranslateOp().Set(Gf.Vec3d(0, -2, 0))

    path = shot(folder, lower, source="anim_capture.usdc")
    assert "the skull is moved in the actor by 2.000 mm" in run("validate", path, code=1)
    frames, T = read_poses_of_stage(path)
    taken, d = example_motion()
    expected = example_rig().pose(d[np.clip(frames - taken[0], 0, None)])
    expected[:, 1, 3] += 2
    np.testing.assert_allclose(T, expected, atol=1e-6)
    done = CliRunner().invoke(app, ["rebake", str(folder / "actor.usda"), str(path), "--from", "d"])
    assert "is moved by 2.00 mm" in str(done.exception)


def test_the_rig_of_another_person_is_refused(anchored_folder):
    folder = anchored_folder
    rig = example_rig()
    path = shot(folder, key_d)
    other = JawRig(rig.arrays, {**rig.meta, "actor": "Ben"})
    with pytest.raises(FormatError, match='is the rig of "example", but the given rig is of "Ben"'):
        motion_of_stage(path, other)
    with pytest.raises(FormatError, match="their d and bounds differ"):
        deviation(path, other)
    bake_rig(folder / "ben", other, example_meshes(), name="Ben", fps=24, table_size=17)
    for command in (["validate"], ["encode"], ["animate"], ["rebake"]):
        done = CliRunner().invoke(app, [*command, str(folder / "ben" / "actor.usda"), str(path)])
        assert done.exit_code > 0 and "retarget" in done.exception.hint


def test_a_motion_made_for_another_model_is_found(anchored_folder):
    """As if a packager had replaced one actor's files by another's, even if the jaw does not move."""
    folder = anchored_folder
    rig = example_rig()
    other = JawRig({**rig.arrays, "landmarks": rig.landmarks + 0.01}, rig.meta)
    write_animation(folder / "anim.usdc", folder / "actor.usda", [1, 2], np.zeros((2, 3)), 24, rig=other)
    assert "made with another model (see jaw:d1)" in run("validate", folder / "anim.usdc", code=1)
    run("rebake", folder / "actor.usda", folder / "anim.usdc", "-o", folder / "baked.usdc", "--root")
    run("validate", folder / "baked.usdc")


def test_an_actor_inside_an_instance_is_found(anchored_folder):
    """A set that contains the actor, itself an instance, three times: reported once."""
    folder = anchored_folder
    unit = shot(folder, key_d, name="unit.usda")

    def instanced(prim):
        prim.SetInstanceable(True)

    path = shot(folder, instanced, actors=("Unit1", "Unit2", "Unit3"), source="unit.usda")
    assert "Only d is keyed" in run("validate", unit, code=1)
    assert run("validate", path, code=1).count("Only d is keyed") == 1
    run("info", path, "--prim", "/Shot/Unit2/Person")
    run(
        "rebake",
        folder / "actor.usda",
        path,
        "-o",
        folder / "baked.usdc",
        "--root",
        "--prim",
        "/Shot/Unit2/Person",
    )
    for name, moves in (("Unit1", False), ("Unit2", True)):
        _, T = read_poses_of_stage(folder / "baked.usdc", f"/Shot/{name}/Person")
        assert (np.ptp(T[:, :3, 3], axis=0).max() > 1) == moves
