"""The variant `detail`: by default a rig is what it was without it; the proxy replaces meshes and nothing else."""

import numpy as np
import pytest
from example_rig import FPS, assert_valid_usd, example_motion, example_proxies, example_rig, scanned_meshes
from pxr import Sdf, Usd, UsdGeom

from jawusd.formats.mesh import crown_face_mask
from jawusd.rig import load_rig
from jawusd.rig.bake import bake_rig
from jawusd.rig.geo import read_geometry, read_gum
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
    """Write a layer beside a rig that selects the proxy; return its path."""
    layer = Sdf.Layer.CreateNew(str(folder / f"crowd_{source.split('.')[0]}.usda"))
    layer.TransferContent(Sdf.Layer.FindOrOpen(str(folder / source)))
    layer.subLayerPaths = [f"./{source}"]
    for prim in list(layer.rootPrims):
        del layer.rootPrims[prim.name]
    Sdf.CreatePrimInLayer(layer, "/Actor").variantSelections["detail"] = "proxy"
    layer.Save()
    return layer.realPath


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


def test_the_proxy_replaces_meshes_and_nothing_else(baked):
    path = shot(baked / "with")
    found, gum, scans = read_geometry(path), read_gum(path), scanned_meshes()
    for name, mesh in {**scans, **PROXIES}.items():
        np.testing.assert_array_equal(found[name].vertices, mesh.vertices.astype(np.float32))
        np.testing.assert_array_equal(found[name].faces, mesh.faces)
        assert found[name].colors is None and found[name].uv is None
    np.testing.assert_array_equal(gum["upper_teeth"], ~crown_face_mask(PROXIES["upper_teeth"]))
    stage, rig = Usd.Stage.Open(path), load_rig(path)
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
    stage.GetPrimAtPath("/Actor").GetVariantSet("detail").SetVariantSelection("proxy")
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/Actor/geo/Skull/SkullMesh")).GetPointsAttr().Get()
    np.testing.assert_array_equal(points, PROXIES["skull"].vertices.astype(np.float32))
