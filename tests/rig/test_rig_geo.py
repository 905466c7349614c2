"""Meshes written to a rig are read back unchanged; placeholders are not returned."""

from dataclasses import replace

import numpy as np
import pytest
from example_rig import FPS, assert_valid_usd, example_meshes, example_motion, example_rig, scanned_meshes
from pxr import Usd, UsdGeom

from jawusd.base.errors import RigError
from jawusd.rig.bake import bake_rig
from jawusd.rig.geo import linear_from_srgb, read_geometry, read_gum, srgb_from_linear


def bake(folder, meshes):
    frames, d = example_motion()
    bake_rig(folder, example_rig(), meshes, name="someone", fps=FPS, frames=frames, d=d, table_size=17)
    return folder / "geo.usdc"


def test_meshes_come_back_in_single_precision(tmp_path):
    meshes = example_meshes()
    found = read_geometry(bake(tmp_path, meshes))
    assert set(found) == set(meshes)
    for name, mesh in meshes.items():
        np.testing.assert_array_equal(found[name].vertices, mesh.vertices.astype(np.float32))
        np.testing.assert_array_equal(found[name].faces, mesh.faces)


def test_vertices_that_no_face_uses_lie_where_others_do(tmp_path):
    meshes = example_meshes()
    upper = meshes["upper_teeth"]
    loose = np.concatenate([upper.vertices, [(900.0, 0, 0), (0, -9e3, 5)]])
    colors = None if upper.colors is None else np.concatenate([upper.colors, upper.colors[:2]])
    found = read_geometry(bake(tmp_path, {**meshes, "upper_teeth": replace(upper, vertices=loose, colors=colors)}))
    assert len(found["upper_teeth"].vertices) == len(loose)
    np.testing.assert_array_equal(found["upper_teeth"].vertices[:-2], upper.vertices.astype(np.float32))
    assert np.isin(found["upper_teeth"].vertices[-2:], upper.vertices.astype(np.float32)).all()


def test_colours_and_texture_coordinates_of_scans_are_kept(tmp_path):
    meshes = scanned_meshes()
    upper = meshes["upper_teeth"]
    path = bake(tmp_path, meshes)
    for file in (path, tmp_path / "actor.usdz"):
        stage = Usd.Stage.Open(str(file))
        prim = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/Actor/geo/Skull/UpperTeethMesh"))
        shown, places = prim.GetPrimvar("displayColor"), prim.GetPrimvar("st")
        assert (shown.GetInterpolation(), places.GetInterpolation()) == ("vertex", "faceVarying")
        assert (str(shown.GetTypeName()), str(places.GetTypeName())) == ("color3f[]", "texCoord2f[]")
        np.testing.assert_allclose(np.array(shown.Get()), linear_from_srgb(upper.colors), atol=1e-7)
        np.testing.assert_array_equal(np.array(places.Get()), upper.uv.reshape(-1, 2))
        other = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/Actor/geo/Mandible/LowerTeethMesh"))
        assert other.GetPrimvar("displayColor").GetInterpolation() == "constant" and not other.HasPrimvar("st")
        assert_valid_usd(file)
    found = read_geometry(path)
    np.testing.assert_array_equal(found["upper_teeth"].colors, upper.colors)
    np.testing.assert_array_equal(found["upper_teeth"].uv, upper.uv)
    assert all(found[name].colors is None and found[name].uv is None for name in found if name != "upper_teeth")
    painted = read_gum(bake(tmp_path / "painted", example_meshes()))
    np.testing.assert_array_equal(read_gum(path)["upper_teeth"], painted["upper_teeth"])


@pytest.mark.parametrize("values", [[(0.5, np.nan, 0.5)] * 258, [(0.5, 0.5, 0.5)] * 3])
def test_colours_that_fit_no_mesh_are_left_out(tmp_path, values):
    path = bake(tmp_path, scanned_meshes())
    stage = Usd.Stage.Open(str(path))
    for name, given in (("displayColor", values), ("st", [value[:2] for value in values])):
        UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/Actor/geo/Skull/UpperTeethMesh")).GetPrimvar(name).Set(given)
    stage.Save()
    found = read_geometry(path)["upper_teeth"]
    assert found.colors is None and found.uv is None


@pytest.mark.parametrize("colors", [np.full((1, 3), 200), np.full((1, 3), [215, 45, 40])])
def test_one_colour_all_over_says_nothing(tmp_path, colors):
    meshes = example_meshes()
    skull = meshes["skull"]
    meshes["skull"] = replace(skull, colors=np.repeat(colors, len(skull.vertices), axis=0).astype(np.uint8))
    assert read_geometry(bake(tmp_path, meshes))["skull"].colors is None


def test_colours_are_linear_in_usd():
    """The curve of the sRGB standard: 128 of 255 is linear 0.2159, and all codes survive a round trip."""
    np.testing.assert_allclose(linear_from_srgb(np.array([0, 10, 128, 255])), [0, 0.003035, 0.215861, 1], atol=1e-6)
    codes = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(srgb_from_linear(linear_from_srgb(codes).astype(np.float32)), codes)


def test_a_placeholder_is_no_bone(tmp_path):
    meshes = {name: mesh for name, mesh in example_meshes().items() if name != "mandible"}
    path = bake(tmp_path, meshes)
    assert "mandible" not in read_geometry(path) and set(read_geometry(path, placeholders=True)) == {"mandible"}


def test_what_is_no_geometry_is_refused(tmp_path):
    with pytest.raises(RigError, match="no such file"):
        read_geometry(tmp_path / "geo.usdc")
