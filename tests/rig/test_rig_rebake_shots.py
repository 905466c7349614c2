"""One layer bakes the actors of a shot that consists of sublayers."""

import json

import numpy as np
import pytest
from example_rig import example_meshes, example_rig
from keyed_shots import key_d, keyed, run, shot
from pxr import Gf, Sdf, Usd, UsdGeom
from typer.testing import CliRunner

from jawusd.cli.main import app


def department_shot(folder, change, actors=("Anna", "Ben"), metres=0.001):
    """Write a shot as in studios: a root with sublayers only, the animation in one of them."""
    shot(folder, change, name="anim.usda", actors=actors)
    layer = Sdf.Layer.FindOrOpen(str(folder / "anim.usda"))
    root = Sdf.Layer.CreateNew(str(folder / "shot.usda"))
    root.subLayerPaths.append("./anim.usda")
    for name in ("startTimeCode", "endTimeCode", "timeCodesPerSecond", "defaultPrim"):
        setattr(root, name, getattr(layer, name))
    root.pseudoRoot.SetInfo("metersPerUnit", metres)
    root.pseudoRoot.SetInfo("upAxis", "Y")
    root.Save()
    return folder / "shot.usda"


def inserted(path, layer):
    """Return a stage of a shot with a layer as the strongest of its sublayers."""
    root = Sdf.Layer.FindOrOpen(str(path))
    root.subLayerPaths.insert(0, f"./{layer.name}")
    root.Save()
    return Usd.Stage.Open(str(path))


def farthest_mm(stage, actor, rig, d):
    """Return the largest distance of a vertex from its position by the model, at whole frames, in the world."""
    worst, points = 0.0, example_meshes()["lower_teeth"].vertices
    for frame, T in zip(range(1, 26), rig.pose(d), strict=True):
        cache = UsdGeom.XformCache(frame)
        M, S = (
            np.array(cache.GetLocalToWorldTransform(stage.GetPrimAtPath(f"{actor}/geo/{name}"))).T
            for name in ("Mandible/LowerTeethMesh", "Skull/UpperTeethMesh")
        )
        shown, wanted = points @ M[:3, :3].T + M[:3, 3], points @ (S @ T)[:3, :3].T + (S @ T)[:3, 3]
        worst = max(worst, float(np.linalg.norm(shown - wanted, axis=1).max()))
    return worst


def placed(prim):
    """Place both actors, one of them walking."""
    move = UsdGeom.Xformable(prim).AddTranslateOp()
    for frame in (1, 25):
        move.Set(Gf.Vec3d(frame, 20, 7), frame)
    UsdGeom.Xformable(prim).AddRotateXYZOp().Set(Gf.Vec3f(10, 70, 3))


def key_or_move(prim):
    """Key d of one actor, and move the mandible of the other by hand."""
    placed(prim)
    if prim.GetName() == "Anna":
        return key_d(prim)
    mandible = UsdGeom.Xformable(prim.GetStage().GetPrimAtPath(f"{prim.GetPath()}/geo/Mandible"))
    op = mandible.MakeMatrixXform()
    for time, T in enumerate(example_rig().pose(0.5 * keyed(np.arange(1, 26.0))), start=1):
        op.Set(Gf.Matrix4d(T.T.tolist()), time)
    return None


def test_one_layer_bakes_all_actors_of_a_shot(anchored_folder):
    path, out = department_shot(anchored_folder, key_or_move), anchored_folder / "jaws.usdc"
    found = json.loads(run("rebake", path, "-o", out, "--json"))
    assert [(one["prim"], one["from"]) for one in found["actors"]] == [("/Shot/Anna", "d"), ("/Shot/Ben", "mandible")]
    assert found["stronger"] == []
    assert not Sdf.Layer.FindOrOpen(str(out)).subLayerPaths
    stage, d = inserted(path, out), keyed(np.arange(1, 26.0))
    assert farthest_mm(stage, "/Shot/Anna", example_rig(), d) <= 0.02
    assert farthest_mm(stage, "/Shot/Ben", example_rig(), 0.5 * d) <= 0.02
    run("validate", path)


def test_some_actors_of_a_shot_are_named(anchored_folder):
    path, out = department_shot(anchored_folder, key_d, ("Anna", "Ben", "Cleo")), anchored_folder / "jaws.usdc"
    run("rebake", path, "-o", out, "--prim", "/Shot/Anna", "--prim", "/Shot/Cleo")
    layer = Sdf.Layer.FindOrOpen(str(out))
    assert [bool(layer.GetPrimAtPath(f"/Shot/{name}")) for name in ("Anna", "Ben", "Cleo")] == [True, False, True]
    stage, d = inserted(path, out), keyed(np.arange(1, 26.0))
    for name in ("Anna", "Cleo"):
        assert farthest_mm(stage, f"/Shot/{name}", example_rig(), d) <= 0.02
    assert "Only d is keyed" in run("validate", path, code=1)


def test_what_a_sublayer_cannot_change_is_said(anchored_folder):
    """The shot's own layer is stronger than its sublayers: its opinions about the mandible persist."""

    def move(prim):
        prim.GetStage().GetPrimAtPath(f"{prim.GetPath()}/geo/Mandible").GetAttribute("xformOp:translate").Set(
            Gf.Vec3d(0, -4, 0)
        )
        key_d(prim)

    path, out = shot(anchored_folder, move), anchored_folder / "jaws.usdc"
    said = run("rebake", path, "-o", out, "--from", "d")
    assert "/Shot/Person/geo/Mandible.xformOp:translate: its sublayers are weaker" in said
    assert "jaw:d1" not in said, "keys of d that stay as they are"
    assert farthest_mm(inserted(path, out), "/Shot/Person", example_rig(), keyed(np.arange(1, 26.0))) > 1
    above = Usd.Stage.CreateInMemory()
    above.SetTimeCodesPerSecond(24)
    above.GetRootLayer().subLayerPaths = [str(out), str(path)]
    assert farthest_mm(above, "/Shot/Person", example_rig(), keyed(np.arange(1, 26.0))) <= 0.02


def test_a_reset_mandible_shows_in_the_residual_and_is_baked_back(anchored_folder):
    """It does not move with the actor: encoding reads its pose in the world."""

    def reset(prim):
        placed(prim)
        key_d(prim)
        UsdGeom.Xformable(prim.GetStage().GetPrimAtPath(f"{prim.GetPath()}/geo/Mandible")).SetResetXformStack(True)

    path, out = department_shot(anchored_folder, reset, ("Anna",)), anchored_folder / "jaws.usdc"
    found = json.loads(run("encode", anchored_folder / "actor.usda", path, "-o", anchored_folder / "d.csv", "--json"))
    assert found["largest_residual_mm"] > 20
    run("rebake", path, "-o", out, "--from", "d")
    assert farthest_mm(inserted(path, out), "/Shot/Anna", example_rig(), keyed(np.arange(1, 26.0))) <= 0.02


@pytest.mark.parametrize("part", ["geo/Mandible", "geo"])
def test_an_inactive_mandible_is_neither_encoded_nor_baked(part, anchored_folder):
    def deactivate(prim):
        key_d(prim)
        prim.GetStage().GetPrimAtPath(f"{prim.GetPath()}/{part}").SetActive(False)

    path = department_shot(anchored_folder, deactivate, ("Anna",))
    for command in (["encode", str(anchored_folder)], ["rebake"]):
        done = CliRunner().invoke(app, [*command, str(path), "-o", str(anchored_folder / "out.usdc")])
        assert done.exit_code > 0 and f"{part} is inactive" in str(done.exception)


def test_a_mandible_whose_meshes_were_moved_apart_is_not_baked(anchored_folder):
    def move(prim):
        key_d(prim)
        teeth = prim.GetStage().GetPrimAtPath(f"{prim.GetPath()}/geo/Mandible/LowerTeethMesh")
        UsdGeom.XformCommonAPI(teeth).SetTranslate((0, -3, 0))

    path = department_shot(anchored_folder, move, ("Anna",))
    done = CliRunner().invoke(app, ["rebake", str(path), "-o", str(anchored_folder / "out.usdc")])
    assert "move differently" in str(done.exception) and not (anchored_folder / "out.usdc").exists()
