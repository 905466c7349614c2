"""Shots that break an actor are reported with the reason; ordinary shots are not reported."""

import json

import pytest
from example_rig import FPS
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
from typer.testing import CliRunner

from jawusd.cli.main import app
from jawusd.rig import validate_stage
from jawusd.rig.rules import RULES

FIRST, LAST = 30, 69


def assembled(folder, change=lambda stage, actor: None, source="anim_capture.usdc", metres=0.001, up="Y"):
    """Write a shot that references the actor at /Shot/Set/Person."""
    stage = Usd.Stage.CreateNew(str(folder / "shot.usda"))
    stage.SetStartTimeCode(FIRST)
    stage.SetEndTimeCode(LAST)
    stage.SetTimeCodesPerSecond(FPS)
    stage.SetFramesPerSecond(FPS)
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.SetStageMetersPerUnit(stage, metres)
    for path in ("/Shot", "/Shot/Set", "/Shot/Set/Person"):
        prim = stage.DefinePrim(path, "Xform")
    stage.SetDefaultPrim(stage.GetPrimAtPath("/Shot"))
    prim.GetReferences().AddReference(f"./{source}")
    change(stage, prim)
    stage.Save()
    return folder / "shot.usda"


def sublayered(folder, change):
    """Write a layer over the actor's motion."""
    stage = Usd.Stage.CreateNew(str(folder / "shot.usda"))
    stage.GetRootLayer().subLayerPaths.append("./anim_capture.usdc")
    stage.SetDefaultPrim(stage.GetPseudoRoot().GetChildren()[0])
    stage.SetStartTimeCode(FIRST)
    stage.SetEndTimeCode(LAST)
    stage.SetTimeCodesPerSecond(FPS)
    UsdGeom.SetStageUpAxis(stage, "Y")
    UsdGeom.SetStageMetersPerUnit(stage, 0.001)
    change(stage)
    stage.Save()
    return folder / "shot.usda"


def part(actor, name):
    return actor.GetStage().GetPrimAtPath(f"{actor.GetPath()}/geo/{name}")


def reset_the_mandible(stage, actor):
    UsdGeom.XformCommonAPI(actor).SetTranslate((0, 1700, 0))
    UsdGeom.Xformable(part(actor, "Mandible")).SetResetXformStack(True)


def reset_a_mesh(stage, actor):
    UsdGeom.Xformable(part(actor, "Mandible/LowerTeethMesh")).SetResetXformStack(True)


def reset_the_skull(stage, actor):
    UsdGeom.Xformable(part(actor, "Skull")).SetResetXformStack(True)


def move_the_lower_teeth(stage, actor):
    UsdGeom.XformCommonAPI(part(actor, "Mandible/LowerTeethMesh")).SetTranslate((0, -2, 0))


def deactivate_the_mandible(stage, actor):
    part(actor, "Mandible").SetActive(False)


def deactivate_the_geometry(stage, actor):
    stage.GetPrimAtPath(f"{actor.GetPath()}/geo").SetActive(False)


def deactivate_the_meshes(stage, actor):
    for name in ("MandibleMesh", "LowerTeethMesh"):
        part(actor, f"Mandible/{name}").SetActive(False)


def hide_the_mandible(stage, actor):
    UsdGeom.Imageable(part(actor, "Mandible")).MakeInvisible()


def hide_the_mandible_for_a_while(stage, actor):
    seen = UsdGeom.Imageable(part(actor, "Mandible")).CreateVisibilityAttr()
    for time, value in ((30, "inherited"), (40, "invisible"), (45, "inherited")):
        seen.Set(value, time)


def give_the_mandible_the_purpose_of_guides(stage, actor):
    UsdGeom.Imageable(part(actor, "Mandible")).CreatePurposeAttr("guide")


def squash_the_set(stage, actor):
    UsdGeom.XformCommonAPI(actor.GetParent()).SetScale((1, 0.5, 1))


def shear_the_actor_for_a_while(stage, actor):
    op = UsdGeom.Xformable(actor).MakeMatrixXform()
    op.Set(Gf.Matrix4d(1), 30)
    op.Set(Gf.Matrix4d(1, 0, 0, 0, 0.3, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1), 50)


def mirror_the_actor(stage, actor):
    UsdGeom.XformCommonAPI(actor).SetScale((-1, 1, 1))


def scale_the_geometry(stage, actor):
    geo = stage.GetPrimAtPath(f"{actor.GetPath()}/geo")
    geo.SetTypeName("Xform")
    UsdGeom.XformCommonAPI(geo).SetScale((2, 2, 2))


def scale_the_mandible(stage, actor):
    UsdGeom.Xformable(part(actor, "Mandible")).AddScaleOp().Set((1, 1, 1.2))


def name_no_mandible(stage, actor):
    actor.GetRelationship("jaw:mandible").SetTargets([])


def name_a_mandible_that_is_not_there(stage, actor):
    actor.GetRelationship("jaw:mandible").SetTargets([f"{actor.GetPath()}/geo/Chin"])


def name_two_mandibles(stage, actor):
    actor.GetRelationship("jaw:mandible").AddTarget(f"{actor.GetPath()}/geo/Skull")


def name_the_skull_for_the_mandible(stage, actor):
    actor.GetRelationship("jaw:mandible").SetTargets([f"{actor.GetPath()}/geo/Skull"])


def name_a_mandible_elsewhere(stage, actor):
    other = stage.DefinePrim("/Shot/Other", "Xform")
    UsdGeom.Mesh.Define(stage, "/Shot/Other/Mesh")
    actor.GetRelationship("jaw:mandible").SetTargets([other.GetPath()])


def name_a_skull_that_is_not_there(stage, actor):
    actor.GetRelationship("jaw:skull").SetTargets([f"{actor.GetPath()}/geo/Head"])


def widen_a_range(stage, actor):
    actor.GetAttribute("jaw:d1:range").Set(Gf.Vec2d(0, 90))


def block_the_motion(stage, actor):
    part(actor, "Mandible").GetAttribute("xformOp:translate").Block()


def refer_to_a_missing_file(stage, actor):
    stage.DefinePrim("/Shot/Prop", "Xform").GetReferences().AddReference("./nothing.usda")


def refer_to_a_missing_actor(stage, actor):
    actor.GetReferences().SetReferences([Sdf.Reference("./nothing.usda")])


def rename_the_joints(stage, actor, chosen=True):
    actor.GetVariantSet("motion").SetVariantSelection("skeleton")
    with actor.GetVariantSet("motion").GetVariantEditContext():
        skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath(f"{actor.GetPath()}/geo/Skel"))
        skeleton.GetJointsAttr().Set(Vt.TokenArray(["head", "head/jaw"]))
    if not chosen:
        actor.GetVariantSet("motion").SetVariantSelection("transforms")


def rename_the_joints_of_the_variant_that_is_not_chosen(stage, actor):
    rename_the_joints(stage, actor, chosen=False)


BROKEN = [
    (reset_the_mandible, "Mandible", "!resetXformStack!"),
    (reset_a_mesh, "Assembly", "!resetXformStack!"),
    (reset_the_skull, "Assembly", "!resetXformStack!"),
    (move_the_lower_teeth, "Mandible", "move differently"),
    (deactivate_the_mandible, "Mandible", "/geo/Mandible is inactive"),
    (deactivate_the_geometry, "Mandible", "/geo is inactive"),
    (deactivate_the_meshes, "Assembly", "no active mesh"),
    (hide_the_mandible, "Assembly", "is hidden"),
    (hide_the_mandible_for_a_while, "Assembly", "is hidden at 40"),
    (give_the_mandible_the_purpose_of_guides, "Assembly", "is hidden"),
    (squash_the_set, "Assembly", "scales 1, 1, 0.5"),
    (shear_the_actor_for_a_while, "Assembly", "non-uniform scale, its own or that of its parents, at 31"),
    (mirror_the_actor, "Assembly", "mirrored"),
    (scale_the_geometry, "Mandible", "the skull is moved"),
    (scale_the_mandible, "Mandible", "expected translate"),
    (name_no_mandible, "Mandible", "has 0 targets"),
    (name_a_mandible_that_is_not_there, "Mandible", "geo/Chin: there is no such prim"),
    (name_two_mandibles, "Mandible", "has 2 targets"),
    (name_the_skull_for_the_mandible, "Assembly", "move together"),
    (name_a_mandible_elsewhere, "Mandible", "is not below the actor"),
    (name_a_skull_that_is_not_there, "Assembly", "geo/Head: there is no such prim"),
    (widen_a_range, "Model", "ranges were edited"),
    (block_the_motion, "Mandible", "from the pose of d"),
    (refer_to_a_missing_file, "CompositionError", "nothing.usda"),
    (refer_to_a_missing_actor, "CompositionError", "nothing.usda"),
    (rename_the_joints, "Assembly", "the joints Actor_skull/Actor_jaw are animated"),
    (rename_the_joints_of_the_variant_that_is_not_chosen, "Assembly", "the joints Actor_skull/Actor_jaw are animated"),
]


def errors_of(path, code=1):
    done = CliRunner().invoke(app, ["validate", str(path), "--json"])
    assert done.exit_code == code, done.output
    found = [finding for finding in json.loads(done.stdout)["findings"] if finding["severity"] == "error"]
    return [(finding["rule"], finding["message"]) for finding in found]


@pytest.mark.parametrize(("change", "rule", "message"), BROKEN)
def test_a_broken_assembly_is_named(change, rule, message, anchored_folder):
    found = errors_of(assembled(anchored_folder, change))
    assert any(one == rule and message in said for one, said in found), found


@pytest.mark.parametrize("name", ["geo.usdc", "rig.usdc", "actor.usda"])
def test_a_missing_layer_of_a_rig_is_named(name, anchored_folder):
    path = assembled(anchored_folder)
    (anchored_folder / name).unlink()
    found = errors_of(path)
    assert any(name in said for _, said in found)
    assert any("payload) missing" in said for rule, said in found if rule == "Mandible") == (name == "geo.usdc")


@pytest.mark.parametrize(("name", "value"), [("metersPerUnit", 1.0), ("metersPerUnit", 0.01), ("upAxis", "Z")])
def test_units_over_those_of_a_sublayer_are_named(name, value, anchored_folder):
    found = errors_of(sublayered(anchored_folder, lambda stage: stage.SetMetadata(name, value)))
    assert any(f"the stage has {name} = {value}" in said for rule, said in found if rule == "Assembly")


def test_a_payload_that_was_taken_away_is_named(anchored_folder):
    path = sublayered(anchored_folder, lambda stage: stage.GetDefaultPrim().GetPayloads().SetPayloads([]))
    assert any("payload) missing" in said for rule, said in errors_of(path) if rule == "Mandible")


@pytest.mark.parametrize(
    ("metres", "up", "message"), [(0.01, "Y", "10 times life size"), (0.001, "Z", "no transform rotates the actor")]
)
def test_units_that_nothing_corrects_are_warned_of(metres, up, message, anchored_folder):
    found = validate_stage(assembled(anchored_folder, metres=metres, up=up))
    assert [finding.severity for finding in found] == ["warning"] and message in found[0].message


def test_what_is_not_loaded_or_muted_is_named_in_stages_of_other_programs(anchored_folder):
    path = assembled(anchored_folder)
    stage = Usd.Stage.Open(str(path), Usd.Stage.LoadNone)
    actor = stage.GetPrimAtPath("/Shot/Set/Person")
    assert ["not loaded" in finding.message for finding in RULES["Mandible"](actor)] == [True]
    stage = Usd.Stage.Open(str(path))
    stage.MuteLayer(str(anchored_folder / "rig.usdc"))
    found = [finding.message for finding in RULES["Assembly"](stage.GetPrimAtPath("/Shot/Set/Person"))]
    assert any("rig.usdc is muted" in message for message in found)


def test_a_file_without_a_rig_says_that_it_was_not_checked(anchored_folder):
    path = assembled(anchored_folder, lambda stage, actor: actor.SetActive(False))
    assert validate_stage(path) == []
    said = CliRunner().invoke(app, ["validate", str(path)])
    assert said.exit_code == 0 and "has no active rig" in said.stdout


def place(stage, actor):
    where = UsdGeom.XformCommonAPI(actor)
    where.SetTranslate((100, 20, -5))
    where.SetRotate((10, 20, 30))


def scale_to_cm(stage, actor):
    place(stage, actor)
    UsdGeom.XformCommonAPI(actor.GetParent()).SetScale((0.1, 0.1, 0.1))


def turn_to_z(stage, actor):
    UsdGeom.XformCommonAPI(actor).SetRotate((90, 0, 0))


def retime(stage, actor):
    actor.GetReferences().SetReferences([Sdf.Reference("./anim_capture.usdc", layerOffset=Sdf.LayerOffset(12.5, 1.5))])


def walk(stage, actor):
    """Key the actor and the set above it at every frame, as layout artists do."""
    for prim, way in ((actor, (3, 0, 1)), (actor.GetParent(), (0, 1, 0))):
        move = UsdGeom.Xformable(prim).AddTranslateOp()
        turn = UsdGeom.Xformable(prim).AddRotateXYZOp()
        for frame in range(FIRST, LAST + 1):
            move.Set(Gf.Vec3d(*way) * frame, frame)
            turn.Set(Gf.Vec3f(0, frame, 0), frame)


def reset_the_actor(stage, actor):
    """Allowed: the jaw follows the actor."""
    walk(stage, actor)
    UsdGeom.Xformable(actor).SetResetXformStack(True)


def choose_the_skeleton(stage, actor):
    actor.GetVariantSet("motion").SetVariantSelection("skeleton")


def instance(stage, actor):
    actor.SetInstanceable(True)


def second_rig(stage, actor):
    other = stage.DefinePrim("/Shot/Second", "Xform")
    other.GetReferences().AddReference("./actor.usda")


def enter_later(stage, actor):
    """Hide the whole actor in the first frames, by visibility and by scale."""
    seen, size = UsdGeom.Imageable(actor).CreateVisibilityAttr(), UsdGeom.Xformable(actor).AddScaleOp()
    for time, visible, scale in ((30, "invisible", 0), (40, "inherited", 1)):
        seen.Set(visible, time)
        size.Set(Gf.Vec3f(scale), time)


def show_the_mandible_alone(stage, actor):
    UsdGeom.Imageable(part(actor, "Skull")).MakeInvisible()


def hide_the_bone_but_not_the_teeth(stage, actor):
    for name in ("Skull/SkullMesh", "Mandible/MandibleMesh"):
        UsdGeom.Imageable(part(actor, name)).MakeInvisible()


def clip(stage, actor):
    """Read the motion from value clips."""
    flat = Usd.Stage.Open(str(stage.GetRootLayer().realPath).replace("shot.usda", "anim_capture.usdc")).Flatten()
    flat.Export(str(stage.GetRootLayer().realPath).replace("shot.usda", "clip.usdc"))
    actor.GetReferences().SetReferences([Sdf.Reference("./actor.usda")])
    clips = Usd.ClipsAPI(actor)
    clips.SetClipAssetPaths([Sdf.AssetPath("./clip.usdc")])
    clips.SetClipPrimPath(f"/{flat.defaultPrim}")
    clips.SetClipActive([(0, 0)])
    clips.SetClipTimes([(0, 0), (200, 200)])
    stage.Save()
    clips.GenerateClipManifest(writeBlocksForClipsWithMissingValues=False).Export(
        str(stage.GetRootLayer().realPath).replace("shot.usda", "manifest.usda")
    )
    clips.SetClipManifestAssetPath(Sdf.AssetPath("./manifest.usda"))


ORDINARY = [place, turn_to_z, scale_to_cm, retime, walk, reset_the_actor, choose_the_skeleton, instance, second_rig,
            enter_later, show_the_mandible_alone, hide_the_bone_but_not_the_teeth, clip]  # fmt: skip


@pytest.mark.parametrize("change", ORDINARY)
def test_ordinary_assemblies_raise_no_alarm(change, anchored_folder):
    units = {scale_to_cm: {"metres": 0.01}, turn_to_z: {"up": "Z"}}.get(change, {})
    assert validate_stage(assembled(anchored_folder, change, **units)) == []


def test_a_flattened_shot_raises_no_alarm(anchored_folder):
    stage = Usd.Stage.Open(str(assembled(anchored_folder, scale_to_cm, metres=0.01)))
    stage.Export(str(anchored_folder / "flat.usda"))
    assert errors_of(anchored_folder / "flat.usda", code=0) == []
