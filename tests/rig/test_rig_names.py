"""Prims are named after the actor in every layer, and older rigs are read under their old name."""

import json
from pathlib import Path

import numpy as np
import pytest
from example_rig import FPS, assert_valid_usd, example_meshes, example_motion, example_proxies, example_rig
from pxr import Sdf, Usd, UsdGeom, UsdSkel
from typer.testing import CliRunner

from jawusd.base.errors import RigError
from jawusd.cli.main import app
from jawusd.geometry import Camera
from jawusd.rig import describe, write_animation, write_splines
from jawusd.rig.bake import bake_rig
from jawusd.rig.cameras import write_cameras
from jawusd.rig.geo import read_geometry, read_gum
from jawusd.rig.layout import check_prim_name, prim_name_of
from jawusd.rig.motion_read import read_poses_of_stage
from jawusd.rig.publish import publish_rig

FRAMES, D = example_motion()
GOLDEN = Path(__file__).parents[1] / "golden"


def run(*arguments, code=0):
    done = CliRunner().invoke(app, [str(x) for x in arguments])
    assert done.exit_code == code, (done.output, done.exception)
    return done.stdout


@pytest.fixture
def hero(tmp_path):
    """Return a rig with all layers, whose prim is called hero."""
    options = {"proxies": example_proxies(), "table_size": 17, "prim_name": "hero"}
    bake_rig(tmp_path / "hero", example_rig(), example_meshes(), name="Anna", fps=FPS, frames=FRAMES, d=D, **options)
    write_animation(tmp_path / "hero" / "anim.usdc", tmp_path / "hero" / "actor.usda", FRAMES, D, FPS)
    write_splines(tmp_path / "hero" / "splines.usda", tmp_path / "hero" / "anim.usdc", FRAMES, D, FPS)
    return tmp_path / "hero"


@pytest.mark.parametrize(
    ("actor", "prim"),
    [
        ("Anna", "Anna"),
        ("synthetic_0", "synthetic_0"),
        ("Anna K. Meier", "Anna_K_Meier"),
        ("J\u00fcrgen", "Jurgen"),
        ("01 hero", "Actor_01_hero"),
        ("\u5c71\u7530", "Actor"),
        ("", "Actor"),
        ("a/b{c}", "a_b_c"),
    ],
)
def test_names_of_actors_become_names_of_prims(actor, prim):
    assert prim_name_of(actor) == prim == check_prim_name(prim)


@pytest.mark.parametrize("name", ["", "1a", "a b", "a/b", "J\u00fcrgen", "a-b"])
def test_names_that_not_every_program_reads_are_refused(name):
    with pytest.raises(RigError, match="is not a valid prim name"):
        check_prim_name(name)


def layers_of(folder):
    return [path for path in sorted(folder.iterdir()) if path.suffix in (".usda", ".usdc")]


def test_every_layer_names_the_actor_alike(hero):
    for path in layers_of(hero):
        text = Sdf.Layer.FindOrOpen(str(path)).ExportToString()
        assert "Actor" not in text, path.name
        assert Sdf.Layer.FindOrOpen(str(path)).defaultPrim == "hero"
        assert_valid_usd(path)
    assert_valid_usd(hero / "actor.usdz")
    assert describe(hero / "actor.usdz")["prim"] == "/hero"


def test_joints_have_the_name_in_front_and_move(hero):
    stage = Usd.Stage.Open(str(hero / "anim_capture.usdc"))
    actor = stage.GetDefaultPrim()
    actor.GetVariantSet("motion").SetVariantSelection("skeleton")
    skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath("/hero/geo/Skel"))
    assert list(skeleton.GetJointsAttr().Get()) == ["hero_skull", "hero_skull/hero_jaw"]
    stage.GetRootLayer().Export(str(hero / "bones.usdc"))
    frames, T = read_poses_of_stage(hero / "bones.usdc")
    np.testing.assert_allclose(T, example_rig().pose(D), atol=1e-3)


def test_what_is_made_of_a_named_rig_moves(hero):
    for name in ("anim_capture.usdc", "anim.usdc", "splines.usda"):
        _, T = read_poses_of_stage(hero / name)
        np.testing.assert_allclose(T, example_rig().pose(D), atol=1e-6)
    for name in ("actor.usda", "geo.usdc"):
        meshes = read_geometry(hero / name)
        assert set(meshes) == set(example_meshes()) and read_gum(hero / name)
    stage = Usd.Stage.Open(str(hero / "actor.usda"))
    stage.GetDefaultPrim().GetVariantSet("detail").SetVariantSelection("both")
    assert stage.GetPrimAtPath("/hero/geo/Skull/SkullProxy")
    run("encode", hero, hero / "actor_skel.usdc", "-o", hero / "d.csv")
    np.testing.assert_allclose(np.loadtxt(hero / "d.csv", delimiter=",", skiprows=1)[:, 1:4], D, atol=1e-3)
    run("animate", hero, hero / "d.csv", "-o", hero / "take.glb")
    run("info", hero)


def test_cameras_show_the_actor_under_its_name(hero):
    K = np.array([[2000, 0, 960], [0, 2000, 540], [0, 0, 1.0]])
    camera, head = Camera("cam", (1920, 1080), K, np.zeros(5), np.eye(4)), np.tile(np.eye(4), (len(FRAMES), 1, 1))
    write_cameras(hero / "cameras.usda", [camera], hero / "anim_capture.usdc", FRAMES, head, FPS)
    assert Usd.Stage.Open(str(hero / "cameras.usda")).GetPrimAtPath("/Take/hero/geo/Mandible")


def test_two_actors_are_sublayered_in_one_shot(tmp_path):
    root = Sdf.Layer.CreateNew(str(tmp_path / "shot.usda"))
    for name, share in (("Anna", 1.0), ("Ben", 0.5)):
        options = {"table_size": 17, "prim_name": prim_name_of(name)}
        bake_rig(
            tmp_path / name, example_rig(), example_meshes(), name=name, fps=FPS, frames=FRAMES, d=share * D, **options
        )
        root.subLayerPaths.append(f"./{name}/anim_capture.usdc")
    root.startTimeCode, root.endTimeCode = float(FRAMES[0]), float(FRAMES[-1])
    root.timeCodesPerSecond, root.defaultPrim = FPS, "Anna"
    root.pseudoRoot.SetInfo("metersPerUnit", 0.001)
    root.pseudoRoot.SetInfo("upAxis", UsdGeom.Tokens.y)
    root.Save()
    for name, share in (("Anna", 1.0), ("Ben", 0.5)):
        _, T = read_poses_of_stage(tmp_path / "shot.usda", f"/{name}")
        np.testing.assert_allclose(T, example_rig().pose(share * D), atol=1e-6)
    found = json.loads(run("rebake", tmp_path / "shot.usda", "-o", tmp_path / "jaws.usdc", "--json"))
    assert {one["prim"] for one in found["actors"]} == {"/Anna", "/Ben"}


@pytest.mark.parametrize("given", [None, "hero"])
def test_publishing_names_an_older_rig(given, anchored_folder, tmp_path):
    assert describe(anchored_folder / "actor.usda")["prim"] == "/Actor"
    publish_rig(anchored_folder, tmp_path / "lib", "lead", given)
    name = given or "example"
    for path in layers_of(tmp_path / "lib"):
        assert "Actor" not in Sdf.Layer.FindOrOpen(str(path)).ExportToString()
        assert_valid_usd(path)
    assert describe(tmp_path / "lib" / "lead.usda")["prim"] == f"/{name}"
    _, T = read_poses_of_stage(tmp_path / "lib" / "lead_anim_capture.usdc")
    np.testing.assert_allclose(T, example_rig().pose(D), atol=1e-6)


def test_publishing_leaves_what_other_rigs_call_their_prim(hero, anchored_folder, tmp_path):
    """A layer of the folder may refer to another rig, whose prim keeps its name."""
    layer = Sdf.Layer.CreateNew(str(hero / "scene.usda"))
    beside = Sdf.PrimSpec(layer, "Beside", Sdf.SpecifierDef)
    beside.referenceList.prependedItems = [Sdf.Reference("../actor/actor.usda", "/hero")]
    layer.Save()
    publish_rig(hero, tmp_path / "lib", "lead", "lead")
    published = Sdf.Layer.FindOrOpen(str(tmp_path / "lib" / "lead_scene.usda"))
    (arc,) = published.GetPrimAtPath("/Beside").referenceList.prependedItems
    assert (arc.assetPath, str(arc.primPath)) == ("../actor/actor.usda", "/hero")


def test_older_rigs_are_animated_under_their_name(anchored_folder):
    out = write_animation(anchored_folder / "anim.usdc", anchored_folder / "actor.usda", FRAMES, D, FPS)
    assert Sdf.Layer.FindOrOpen(str(out)).defaultPrim == "Actor"
    for golden in GOLDEN.glob("rig_v*"):
        assert describe(golden / "actor.usda")["prim"] == "/Actor"


def test_a_layer_over_a_shot_asks_for_the_rig(hero):
    stage = Usd.Stage.CreateNew(str(hero / "shot.usda"))
    stage.DefinePrim("/Shot/Anna", "Xform").GetReferences().AddReference("./actor.usda")
    stage.Save()
    with pytest.raises(RigError, match="must have exactly one rig as a root prim"):
        write_animation(hero / "over.usdc", hero / "shot.usda", FRAMES, D, FPS)
