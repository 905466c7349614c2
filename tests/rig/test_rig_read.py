"""Reading rigs: exact round trip, errors that name the field, shots with several actors."""

import numpy as np
import pytest
from example_model import example_arrays, example_meta, held_out_arrays, joint_arrays, moving_arrays, touching_arrays
from example_rig import FPS, assert_valid_usd, example_meshes, example_motion, example_rig, forget_checksums, moved
from pxr import Gf, Sdf, Usd, UsdGeom, Vt
from scipy.spatial.transform import Rotation

import jawusd
from jawusd.base.errors import FormatError, RigError, UnitsError, VersionError
from jawusd.evaluator import JawRig
from jawusd.geometry import make_transform
from jawusd.rig import describe, load_rig, write_animation
from jawusd.rig.bake import bake_rig


def edit(path, change):
    """Change a layer on disk and close it."""
    layer = Sdf.Layer.OpenAsAnonymous(str(path))
    change(layer)
    layer.Export(str(path))
    if path.suffix == ".usdc":
        forget_checksums(path.parent)


def set_value(name, value):
    """Return an edit that gives an attribute of /Actor another default."""

    def change(layer):
        layer.GetAttributeAtPath(f"/Actor.{name}").default = value

    return change


def test_what_is_baked_is_read_back_exactly(folder, kind, tmp_path_factory):
    expected = example_rig(kind)
    for name in ("actor.usda", "anim_capture.usdc"):
        rig = load_rig(folder / name)
        assert rig.meta == expected.meta
        assert set(rig.arrays) == set(expected.arrays)
        for key, value in expected.arrays.items():
            np.testing.assert_array_equal(rig.arrays[key], value, err_msg=key)
        assert rig.model_hash == expected.model_hash
    d = example_motion()[1]
    np.testing.assert_array_equal(jawusd.load(folder / "actor.usda").pose(d), expected.pose(d))
    np.testing.assert_array_equal(jawusd.load(folder).pose(d), expected.pose(d))
    with pytest.raises(RigError, match="is a folder without actor.usda"):
        jawusd.load(tmp_path_factory.mktemp("empty"))


def test_what_not_every_rig_has_is_read_back_exactly(kind, tmp_path):
    arrays = {**example_arrays(kind), **touching_arrays(kind), **joint_arrays(), **moving_arrays(), **held_out_arrays()}
    rig = JawRig(arrays, example_meta(kind))
    bake_rig(tmp_path, rig, example_meshes(), name="example", fps=FPS, table_size=17)
    found = load_rig(tmp_path / "actor.usda")
    assert set(found.arrays) == set(rig.arrays)
    for name, value in rig.arrays.items():
        np.testing.assert_array_equal(found.arrays[name], value, err_msg=name)
    assert found.model_hash == rig.model_hash
    speeds = describe(tmp_path / "actor.usda")["speeds"]
    assert speeds == {"rms_mm_s": rig.speeds.rms_mm_s.tolist(), "rms_mm_s2": rig.speeds.rms_mm_s2.tolist()}
    assert describe(tmp_path / "actor.usda")["held_out"] == {"share": 0.76, "p95_mm": 4.2, "tolerance_mm": 0.0}
    assert_valid_usd(tmp_path / "actor.usda")


def test_the_hash_follows_the_arrays(kind):
    rig = example_rig(kind)
    arrays = dict(rig.arrays)
    arrays["incisor"] = arrays["incisor"] + [0, 0, 1e-9]
    assert type(rig)(arrays, rig.meta).model_hash != rig.model_hash


def test_description_is_that_of_the_rig(folder, kind):
    found = describe(folder / "anim_capture.usdc")
    assert (found["actor"], found["model"]["kind"], found["format_version"]) == ("example", kind, 2)
    assert found["ranges_mm"]["d1"] == [0.0, 42.0]
    assert found["animation"] == {"samples": 40, "first": 30.0, "last": 69.0}
    assert found["table"]["format"] == ("grid" if kind == "anchored" else "curves")
    assert found["meshes"]["LowerTeethMesh"] == 3 * 86
    assert describe(folder / "actor.usda")["animation"] is None


def test_a_newer_rig_is_refused(anchored_folder):
    actor = anchored_folder / "actor.usda"
    edit(actor, set_value("jaw:formatVersion", 3))
    with pytest.raises(VersionError, match="version 3; this version of jawusd reads versions up to 2"):
        load_rig(actor)


@pytest.mark.parametrize("version", [0, -1])
def test_an_impossible_version_is_refused(anchored_folder, version):
    actor = anchored_folder / "actor.usda"
    edit(actor, set_value("jaw:formatVersion", version))
    with pytest.raises(FormatError, match="jaw:formatVersion"):
        load_rig(actor)


@pytest.mark.parametrize(
    ("name", "value"),
    [("jaw:lengthUnit", "cm"), ("jaw:angleUnit", "deg"), ("jaw:twistOrder", Vt.TokenArray(["v", "omega"]))],
)
def test_other_units_are_refused(anchored_folder, name, value):
    actor = anchored_folder / "actor.usda"
    edit(actor, set_value(name, value))
    with pytest.raises(UnitsError, match=name):
        load_rig(actor)


def double_array(count, last=0.0):
    return Vt.DoubleArray([0.0] * (count - 1) + [last])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("jaw:model:splineCentres", double_array(10), "jaw:model:splineCentres has 10 numbers"),
        ("jaw:model:splineWeights", double_array(9), "spline_weights"),
        ("jaw:model:incisor", double_array(3, np.nan), "incisor.*not finite"),
        ("jaw:model:tRest", double_array(16), "T_rest.*not rigid"),
        ("jaw:model:pathScale", -1.0, "path_scale_mm"),
        ("jaw:model:kind", "magic", "magic"),
        ("jaw:meta", "not JSON", "jaw:meta is not JSON"),
        ("jaw:meta", "[1]", "JSON object"),
        ("jaw:meta", '{"kind": "additive"}', "jaw:model:kind"),
        ("jaw:bounds:sliceSupport", double_array(5), "jaw:bounds:sliceSupport has 5 numbers"),
    ],
)
def test_malformed_values_are_refused_by_name(anchored_folder, name, value, message):
    edit(anchored_folder / "rig.usdc", set_value(name, value))
    with pytest.raises(FormatError, match=message) as caught:
        load_rig(anchored_folder / "actor.usda")
    assert "actor.usda" in str(caught.value)


def test_a_missing_value_is_named(anchored_folder):
    def change(layer):
        layer.GetPrimAtPath("/Actor").RemoveProperty(layer.GetAttributeAtPath("/Actor.jaw:bounds:sliceD1"))

    edit(anchored_folder / "rig.usdc", change)
    with pytest.raises(FormatError, match="jaw:bounds:sliceD1"):
        load_rig(anchored_folder / "actor.usda")


def test_an_attribute_of_another_type_is_refused(anchored_folder):
    def change(layer):
        actor = layer.GetPrimAtPath("/Actor")
        actor.RemoveProperty(layer.GetAttributeAtPath("/Actor.jaw:model:incisor"))
        Sdf.AttributeSpec(actor, "jaw:model:incisor", Sdf.ValueTypeNames.StringArray).default = Vt.StringArray(["a"])

    edit(anchored_folder / "rig.usdc", change)
    with pytest.raises(FormatError, match="jaw:model:incisor"):
        load_rig(anchored_folder / "actor.usda")


@pytest.mark.parametrize(
    "asset",
    [
        "../elsewhere/actor.onnx",
        "/etc/passwd",
        "a/../../b.onnx",
        "C:/x.onnx",
        "..",
        "a/../..",
        "\\\\host\\x",
        "http://a.b/c.onnx",
    ],
)
def test_asset_paths_may_not_leave_the_folder(anchored_folder, asset):
    actor = anchored_folder / "actor.usda"
    edit(actor, set_value("jaw:onnx", Sdf.AssetPath(asset)))
    with pytest.raises(RigError, match="outside the folder of this file"):
        load_rig(actor)


def test_sublayers_may_not_leave_the_folder(anchored_folder):
    outside = anchored_folder.parent / "rig.usdc"
    (anchored_folder / "rig.usdc").rename(outside)
    edit(anchored_folder / "actor.usda", lambda layer: layer.subLayerPaths.__setitem__(0, "../rig.usdc"))
    with pytest.raises(RigError, match="outside the folder of this file"):
        load_rig(anchored_folder / "actor.usda")


def test_what_uses_a_rig_may_reach_out_for_it_only(anchored_folder):
    away = anchored_folder.parent / "shot"
    away.mkdir()
    shot = Sdf.Layer.CreateNew(str(away / "shot.usda"))
    shot.subLayerPaths.append(f"../{anchored_folder.name}/actor.usda")
    shot.Save()
    assert load_rig(away / "shot.usda").meta == load_rig(anchored_folder / "actor.usda").meta
    other = Sdf.Layer.CreateNew(str(anchored_folder.parent / "other.usda"))
    Sdf.PrimSpec(other, "Other", Sdf.SpecifierDef)
    other.Save()
    shot.subLayerPaths.append("../other.usda")
    shot.Save()
    del other, shot
    with pytest.raises(RigError, match="other.usda, which is outside the folder of this file and not a rig"):
        load_rig(away / "shot.usda")


def test_files_that_are_no_rig(tmp_path, anchored_folder):
    with pytest.raises(RigError, match="no such file"):
        load_rig(tmp_path / "missing.usda")
    broken = tmp_path / "broken.usda"
    broken.write_text("this is no USD")
    with pytest.raises(RigError, match="not a USD file"):
        load_rig(broken)
    with pytest.raises(FormatError, match="no jaw rig"):
        load_rig(anchored_folder / "geo.usdc")


@pytest.mark.parametrize("by_keyword", [False, True])
def test_errors_of_a_rig_name_its_file(anchored_folder, by_keyword):
    path = anchored_folder / "actor.usda"
    edit(anchored_folder / "rig.usdc", set_value("jaw:meta", "[1]"))
    with pytest.raises(FormatError) as refusal:
        load_rig(path=path) if by_keyword else load_rig(path)
    assert refusal.value.path == str(path)


def test_two_actors_in_a_shot_move_independently(folder, kind, tmp_path):
    shot = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(shot, "Y")
    UsdGeom.SetStageMetersPerUnit(shot, 0.01)
    world = UsdGeom.Xform.Define(shot, "/World")
    shot.SetDefaultPrim(world.GetPrim())
    Usd.ModelAPI(world).SetKind("assembly")
    shot.SetTimeCodesPerSecond(24)
    for name, offset in (("One", 0.0), ("Two", -10.0)):
        prim = UsdGeom.Xform.Define(shot, f"/World/{name}")
        reference = Sdf.Reference(str(folder / "anim_capture.usdc"), layerOffset=Sdf.LayerOffset(offset))
        prim.GetPrim().GetReferences().AddReference(reference)
        prim.AddScaleOp().Set(Gf.Vec3f(0.1))
    path = tmp_path / "shot.usda"
    shot.GetRootLayer().Export(str(path))
    assert_valid_usd(path)
    with pytest.raises(FormatError, match="several jaw rigs: /World/One, /World/Two"):
        load_rig(path)
    with pytest.raises(FormatError, match="/World/Three is not a jaw rig"):
        load_rig(path, "/World/Three")
    rig = load_rig(path, "/World/Two")
    frames, d = example_motion()
    stage = Usd.Stage.Open(str(path))
    for name, offset in (("One", 0), ("Two", -10)):
        mandible = UsdGeom.Xformable(stage.GetPrimAtPath(f"/World/{name}/geo/Mandible"))
        shown = np.array(mandible.GetLocalTransformation(float(frames[20] + offset))).T
        assert np.abs(shown - rig.pose(d[20])).max() < 1e-9


def test_instanced_actors_move_as_one_and_load(anchored_folder, tmp_path):
    """Instances share their children: parameters on the root differ, the baked motion is that of the reference."""
    shot = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(shot, "Y")
    UsdGeom.SetStageMetersPerUnit(shot, 0.001)
    world = UsdGeom.Xform.Define(shot, "/World")
    shot.SetDefaultPrim(world.GetPrim())
    Usd.ModelAPI(world).SetKind("assembly")
    shot.SetTimeCodesPerSecond(24)
    for i, name in enumerate(("One", "Two")):
        prim = UsdGeom.Xform.Define(shot, f"/World/{name}")
        prim.GetPrim().GetReferences().AddReference(str(anchored_folder / "anim_capture.usdc"))
        prim.GetPrim().SetInstanceable(True)
        prim.AddTranslateOp().Set(Gf.Vec3d(300 * i, 0, 0))
    path = tmp_path / "shot.usda"
    shot.GetRootLayer().Export(str(path))
    assert_valid_usd(path)
    frames, d = example_motion()
    stage = Usd.Stage.Open(str(path))
    rig = load_rig(path, "/World/Two")
    for i, name in enumerate(("One", "Two")):
        cache = UsdGeom.XformCache(float(frames[20]))
        world_pose = np.array(cache.GetLocalToWorldTransform(stage.GetPrimAtPath(f"/World/{name}/geo/Mandible"))).T
        expected = rig.pose(d[20]) + np.array([[0, 0, 0, 300 * i], *np.zeros((3, 4))])
        assert np.abs(world_pose - expected).max() < 1e-9


@pytest.mark.parametrize("instanced", [False, True])
def test_two_animations_in_one_shot_moved_scaled_and_instanced(anchored_folder, tmp_path, instanced):
    """Each actor has its own motion file, position and rotation; the shot is in centimetres."""
    rig, (frames, d) = example_rig(), example_motion()
    motions = {"One": d, "Two": d[::-1] * [0.8, -1, 0.5]}
    shot = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(shot, "Y")
    UsdGeom.SetStageMetersPerUnit(shot, 0.01)
    world = UsdGeom.Xform.Define(shot, "/World")
    shot.SetDefaultPrim(world.GetPrim())
    Usd.ModelAPI(world).SetKind("assembly")
    shot.SetTimeCodesPerSecond(24)
    placed = {}
    for i, (name, values) in enumerate(motions.items()):
        actor = anchored_folder / "actor.usda"
        layer = write_animation(anchored_folder / f"anim_{name}.usdc", actor, frames, values, 24)
        prim = UsdGeom.Xform.Define(shot, f"/World/{name}")
        prim.GetPrim().GetReferences().AddReference(str(layer))
        prim.GetPrim().SetInstanceable(instanced)
        prim.AddTranslateOp().Set(Gf.Vec3d(30 * i, 160, -5))
        prim.AddRotateYOp().Set(40.0 * i)
        prim.AddScaleOp().Set(Gf.Vec3f(0.1))
        placed[name] = make_transform(Rotation.from_euler("y", 40 * i, degrees=True).as_matrix(), [30 * i, 160, -5])
    path = tmp_path / "shot.usda"
    shot.GetRootLayer().Export(str(path))
    assert_valid_usd(path)
    stage = Usd.Stage.Open(str(path))
    for name, values in motions.items():
        prim = stage.GetPrimAtPath(f"/World/{name}")
        assert prim.IsInstance() == instanced
        mesh = stage.GetPrimAtPath(f"/World/{name}/geo/Mandible/MandibleMesh")
        points = np.array(UsdGeom.Mesh(mesh).GetPointsAttr().Get(), dtype=float)
        for k in (0, 13, 30):
            to_world = np.array(UsdGeom.XformCache(float(frames[k])).GetLocalToWorldTransform(mesh))
            in_actor = moved(rig.pose(values[k])[None], points)[0]
            expected = moved(placed[name][None], 0.1 * in_actor)[0]
            np.testing.assert_allclose((np.c_[points, np.ones(len(points))] @ to_world)[:, :3], expected, atol=1e-6)
            shown = [prim.GetAttribute(f"jaw:d{j}").Get(float(frames[k])) for j in (1, 2, 3)]
            np.testing.assert_allclose(shown, values[k], atol=1e-12)
