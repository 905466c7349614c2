"""The package for viewers: flat, complete except for the ONNX files."""

import zipfile

import numpy as np
import pytest
from example_rig import assert_valid_usd, example_motion, example_rig
from pxr import Sdf, Usd, UsdGeom

from jawusd.base.errors import RigError
from jawusd.rig import load_rig
from jawusd.rig.motion_read import read_poses_of_stage
from jawusd.rig.publish import write_package


def test_package_holds_one_binary_layer(folder):
    package = folder / "actor.usdz"
    assert_valid_usd(package)
    assert Sdf.ZipFile.Open(str(package)).GetFileNames() == ["actor.usdc"]
    layer = Sdf.Layer.FindOrOpen(str(package))
    assert not layer.GetCompositionAssetDependencies() and not layer.GetExternalAssetDependencies()
    layer.Export(str(folder / "flat.usda"))
    assert package.stat().st_size < 0.5 * (folder / "flat.usda").stat().st_size
    assert str(folder.parent.parent) not in layer.ExportToString()


def test_package_moves_and_loads_like_the_rig(folder, kind):
    rig = load_rig(folder / "actor.usdz")
    frames, d = example_motion()
    np.testing.assert_array_equal(rig.pose(d), example_rig(kind).pose(d))
    stage = Usd.Stage.Open(str(folder / "actor.usdz"))
    mandible = UsdGeom.Xformable(stage.GetPrimAtPath("/Actor/geo/Mandible"))
    for k in (0, 11, 39):
        shown = np.array(mandible.GetLocalTransformation(float(frames[k]))).T
        assert np.abs(shown - rig.pose(d[k])).max() < 1e-9
    assert (stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode()) == (24, 30)


def test_attributes_stay_custom(anchored_folder):
    layer = Sdf.Layer.FindOrOpen(str(anchored_folder / "actor.usdz"))
    actor = layer.GetPrimAtPath("/Actor")
    names = [prop.name for prop in actor.properties if prop.name.startswith("jaw:")]
    assert "jaw:d1" in names and "jaw:onnx" not in names
    assert all(actor.properties[name].custom for name in names)


def test_packing_later_gives_the_same_bytes(anchored_folder, tmp_path):
    again = write_package(tmp_path / "again.usdz", anchored_folder / "anim_capture.usdc")
    assert again.read_bytes() == (anchored_folder / "actor.usdz").read_bytes()
    with zipfile.ZipFile(again) as archive:
        assert {entry.date_time[0] for entry in archive.infolist()} == {1980}


def test_a_source_that_is_no_usd_leaves_the_old_package(anchored_folder):
    package = anchored_folder / "actor.usdz"
    before = package.read_bytes()
    with pytest.raises(RigError, match="no such file"):
        write_package(package, anchored_folder / "nothing.usda")
    assert package.read_bytes() == before


def test_a_stage_without_a_rig_is_not_packed(tmp_path):
    (tmp_path / "empty.usda").write_text('#usda 1.0\ndef Xform "Shot" {}\n')
    with pytest.raises(RigError, match="no jaw rig"):
        write_package(tmp_path / "empty.usdz", tmp_path / "empty.usda")


def test_no_transform_of_a_shot_is_whole(anchored_folder, tmp_path):
    stage = Usd.Stage.CreateNew(str(anchored_folder / "shot.usda"))
    prim = stage.DefinePrim("/Shot/Person", "Xform")
    prim.GetReferences().AddReference("./actor.usda")
    place = UsdGeom.XformCommonAPI(prim)
    values = {"translate": (3, 0, -4), "rotateXYZ": (0, 90, 0), "scale": (1, 1, 1)}
    for time in (0.0, 1.0):
        place.SetXformVectors(
            *(values[key] for key in ("translate", "rotateXYZ", "scale")), (0, 0, 0), place.RotationOrderXYZ, time
        )
    stage.Save()
    package = Usd.Stage.Open(str(write_package(tmp_path / "shot.usdz", anchored_folder / "shot.usda")))
    for key, value in values.items():
        attribute = package.GetPrimAtPath("/Shot/Person").GetAttribute(f"xformOp:{key}")
        for time in (0.0, 1.0):
            assert tuple(attribute.Get(time)) != value
            np.testing.assert_allclose(attribute.Get(time), value, atol=1e-6)


def test_actors_inside_instances_are_packed(anchored_folder, tmp_path):
    """Prototypes have other paths in a flattened layer; their ONNX files are left out as well."""
    for name, source, below in (("unit", "anim_capture.usdc", "Person"), ("shot", "unit.usda", "Unit")):
        stage = Usd.Stage.CreateNew(str(anchored_folder / f"{name}.usda"))
        UsdGeom.SetStageUpAxis(stage, "Y")
        UsdGeom.SetStageMetersPerUnit(stage, 0.001)
        stage.SetTimeCodesPerSecond(24)
        stage.SetStartTimeCode(30)
        stage.SetEndTimeCode(69)
        stage.SetDefaultPrim(stage.DefinePrim("/Shot", "Xform"))
        for number in range(1 if name == "unit" else 2):
            prim = stage.DefinePrim(f"/Shot/{below}{number}", "Xform")
            prim.GetReferences().AddReference(f"./{source}")
            prim.SetInstanceable(name == "shot")
        stage.Save()
    package = write_package(tmp_path / "shot.usdz", anchored_folder / "shot.usda")
    assert zipfile.ZipFile(package).namelist() == ["shot.usdc"]
    assert_valid_usd(package)
    frames, d = example_motion()
    for number in range(2):
        found, T = read_poses_of_stage(package, f"/Shot/Unit{number}/Person0")
        np.testing.assert_array_equal(found, frames)
        np.testing.assert_allclose(T, example_rig().pose(d), atol=1e-6)
