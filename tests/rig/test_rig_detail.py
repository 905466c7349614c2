"""The variant `detail`: no change by default; proxies replace meshes, or are added next to them."""

import numpy as np
import pytest
from example_rig import (
    FPS,
    assert_valid_usd,
    choose_variants,
    example_motion,
    example_proxies,
    example_rig,
    moved,
    scanned_meshes,
)
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdSkel

from jawusd.formats.mesh import crown_face_mask
from jawusd.rig import load_rig
from jawusd.rig.bake import bake_rig
from jawusd.rig.geo import MESH_PATHS, read_geometry, read_gum
from jawusd.rig.motion_read import read_poses_of_stage
from jawusd.rig.publish import publish_rig

PROXIES = example_proxies()


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    """Return the same rig with proxies and without."""
    folder, (frames, d) = tmp_path_factory.mktemp("detail"), example_motion()
    for name, proxies in (("with", PROXIES), ("without", None)):
        options = {"name": "someone", "fps": FPS, "table_size": 17, "proxies": proxies}
        bake_rig(folder / name, example_rig(), scanned_meshes(), frames=frames, d=d, **options)
    return folder


def shot(folder, source="anim_capture.usdc"):
    """Write a layer next to a rig that selects the proxy; return its path."""
    return choose_variants(folder / source, folder / f"crowd_{source.split('.')[0]}.usda", detail="proxy")


def test_by_default_nothing_is_different(baked):
    assert (baked / "with" / "actor.usdz").read_bytes() == (baked / "without" / "actor.usdz").read_bytes()
    for file in ("geo.usdc", "rig.usdc", "anim_capture.usdc", "actor_skel.usdc"):
        assert (baked / "with" / file).read_bytes() == (baked / "without" / file).read_bytes()
    stages = [Usd.Stage.Open(str(baked / name / "actor.usda")) for name in ("with", "without")]
    layers = [stage.Flatten(False) for stage in stages]
    for layer in layers:
        layer.ClearCustomLayerData()  # the checksum of proxy.usdc
    flat = [layer.ExportToString().replace("/without/", "/with/") for layer in layers]
    assert flat[0] == flat[1] and "variant" not in flat[1]
    actor = Sdf.Layer.FindOrOpen(str(baked / "with" / "actor.usda")).GetPrimAtPath("/Actor")
    assert [payload.assetPath for payload in actor.payloadList.prependedItems] == ["./geo.usdc"]


def test_fields_of_proxies_are_in_the_order_of_their_text(baked, tmp_path):
    """Copied fields are in the order of memory addresses, which differs between runs."""
    stored = baked / "with" / "proxy.usdc"
    again = Sdf.Layer.CreateAnonymous(".usda")
    again.ImportFromString(Sdf.Layer.FindOrOpen(str(stored)).ExportToString())
    assert again.Export(str(tmp_path / "again.usdc"))
    assert (tmp_path / "again.usdc").read_bytes() == stored.read_bytes()


def test_the_proxy_replaces_meshes_and_nothing_else(baked):
    path = shot(baked / "with")
    found, gum, scans = read_geometry(path), read_gum(path), scanned_meshes()
    for name, mesh in {**scans, **PROXIES}.items():
        np.testing.assert_array_equal(found[name].vertices, mesh.vertices.astype(np.float32))
        np.testing.assert_array_equal(found[name].faces, mesh.faces)
        assert found[name].colors is None and found[name].uv is None
    np.testing.assert_array_equal(gum["upper_teeth"], ~crown_face_mask(PROXIES["upper_teeth"]))
    stage, rig = Usd.Stage.Open(str(path)), load_rig(path)
    mandible = UsdGeom.Xformable(stage.GetPrimAtPath("/Actor/geo/Mandible"))
    for frame, d in zip(*example_motion()):
        np.testing.assert_allclose(np.array(mandible.GetLocalTransformation(float(frame))).T, rig.pose(d), atol=1e-9)
    assert_valid_usd(path)
    assert_valid_usd(shot(baked / "with", "actor.usda"))
    stage.Unload("/Actor")
    assert not stage.GetPrimAtPath("/Actor/geo/Skull/SkullMesh")


def test_published_rigs_keep_their_proxies(baked, tmp_path):
    files = {path.name for path in publish_rig(baked / "with", tmp_path / "lib", "hero")}
    assert "hero_proxy.usdc" in files
    stage = Usd.Stage.Open(str(tmp_path / "lib" / "hero.usda"))
    stage.SetEditTarget(stage.GetSessionLayer())
    stage.GetDefaultPrim().GetVariantSet("detail").SetVariantSelection("proxy")
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/someone/geo/Skull/SkullMesh")).GetPointsAttr().Get()
    np.testing.assert_array_equal(points, PROXIES["skull"].vertices.astype(np.float32))
    stage.GetDefaultPrim().GetVariantSet("detail").SetVariantSelection("both")
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/someone/geo/Skull/SkullProxy")).GetPointsAttr().Get()
    np.testing.assert_array_equal(points, PROXIES["skull"].vertices.astype(np.float32))


def both(folder, motion="transforms"):
    """Return the path of a stage that selects scans and proxies."""
    out = folder / f"both_{motion}.usda"
    return choose_variants(folder / "anim_capture.usdc", out, detail="both", motion=motion)


def test_scans_are_for_rendering_and_proxies_for_showing(baked):
    path = both(baked / "with")
    assert_valid_usd(path)
    stage, scans = Usd.Stage.Open(str(path)), scanned_meshes()
    assert not stage.GetCompositionErrors()
    for name, place in MESH_PATHS.items():
        scan = UsdGeom.Mesh(stage.GetPrimAtPath(place))
        assert len(scan.GetPointsAttr().Get()) == len(scans[name].vertices)
        if name not in PROXIES:  # it already has few faces
            assert scan.ComputePurpose() == "default"
            continue
        found, purpose = scan.ComputeProxyPrim()
        proxy = UsdGeom.Mesh(found)
        assert scan.ComputePurpose() == "render" and proxy.ComputePurpose() == "proxy" and purpose == scan.GetPrim()
        points = np.array(proxy.GetPointsAttr().Get())
        np.testing.assert_array_equal(points, PROXIES[name].vertices.astype(np.float32))
        materials = [UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()[0] for mesh in (scan, proxy)]
        assert materials[0] and materials[0].GetPath() == materials[1].GetPath()
    names = [prim.GetName() for prim in Usd.PrimRange(stage.GetPrimAtPath("/Actor/geo"))]
    assert len(names) == len(set(names))  # Blender and other programs confuse equal names
    stage.Unload("/Actor")
    assert not [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]


def test_with_both_the_rig_reads_as_its_scans(baked):
    path = both(baked / "with")
    expected, found = read_geometry(baked / "with" / "anim_capture.usdc"), read_geometry(path)
    assert set(found) == set(expected)
    for name, mesh in expected.items():
        np.testing.assert_array_equal(found[name].vertices, mesh.vertices)
        np.testing.assert_array_equal(found[name].faces, mesh.faces)
    assert (found["upper_teeth"].colors is None) == (expected["upper_teeth"].colors is None)


@pytest.mark.parametrize("motion", ["transforms", "skeleton"])
def test_proxies_beside_the_scans_move_with_them(baked, motion):
    path, (frames, d) = both(baked / "with", motion), example_motion()
    assert_valid_usd(path)
    np.testing.assert_allclose(read_poses_of_stage(path)[1], example_rig().pose(d), atol=2e-5)
    stage = Usd.Stage.Open(Usd.Stage.Open(str(path)).Flatten())
    if motion == "skeleton":
        assert UsdSkel.BakeSkinning(UsdSkel.Root(stage.GetPrimAtPath("/Actor/geo")), Gf.Interval(0, 100))
    for k in (9, 30):
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Actor/geo/Mandible/LowerTeethProxy"))
        world = np.array(UsdGeom.XformCache(float(frames[k])).GetLocalToWorldTransform(mesh.GetPrim())).T
        shown = moved(world[None], np.array(mesh.GetPointsAttr().Get(float(frames[k])), dtype=float))[0]
        expected = moved(example_rig().pose(d[k])[None], PROXIES["lower_teeth"].vertices)[0]
        assert np.abs(shown - expected).max() < 1e-4
