"""The skeleton variant moves every vertex as the model does."""

import numpy as np
import pytest
from example_rig import FPS, assert_valid_usd, example_meshes, example_motion, example_rig, moved
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel

from jawusd.rig.bake import bake_rig
from jawusd.rig.geo import MESH_PATHS


def baked_vertices(stage, name, frame):
    """Return the world positions of a mesh after UsdSkel's own skinning."""
    prim = stage.GetPrimAtPath(MESH_PATHS[name])
    world = np.array(UsdGeom.XformCache(float(frame)).GetLocalToWorldTransform(prim)).T
    return moved(world[None], np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(float(frame)), dtype=float))[0]


def test_skinned_vertices_are_where_the_model_puts_them(folder, kind):
    assert_valid_usd(folder / "actor_skel.usdc")
    stage = Usd.Stage.Open(Usd.Stage.Open(str(folder / "actor_skel.usdc")).Flatten())
    assert UsdSkel.BakeSkinning(UsdSkel.Root(stage.GetPrimAtPath("/Actor")), Gf.Interval(0, 100))
    frames, d = example_motion()
    for k in (0, 13, 39):
        pose = example_rig(kind).pose(d[k])
        for name, mesh in example_meshes().items():
            T = pose if name in ("mandible", "lower_teeth") else np.eye(4)
            expected = moved(T[None], mesh.vertices)[0]
            assert np.abs(baked_vertices(stage, name, frames[k]) - expected).max() < 1e-3, name


def test_every_mesh_is_rigidly_bound_and_the_jaw_has_a_key_per_frame(anchored_folder):
    stage = Usd.Stage.Open(str(anchored_folder / "actor_skel.usdc"))
    cache = UsdSkel.Cache()
    cache.Populate(UsdSkel.Root(stage.GetPrimAtPath("/Actor")), Usd.PrimDefaultPredicate)
    for path in MESH_PATHS.values():
        assert cache.GetSkinningQuery(stage.GetPrimAtPath(path)).IsRigidlyDeformed()
    motion = UsdSkel.Animation(stage.GetPrimAtPath("/Actor/Skel/Motion"))
    assert motion.GetRotationsAttr().GetTimeSamples() == example_motion()[0].tolist()
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (30, 69, FPS)


def test_without_motion_the_jaw_rests(tmp_path):
    meshes = {name: mesh for name, mesh in example_meshes().items() if name != "skull"}
    bake_rig(tmp_path, example_rig(), meshes, name="still", fps=FPS)
    assert_valid_usd(tmp_path / "actor_skel.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "actor_skel.usdc"))
    motion = UsdSkel.Animation(stage.GetPrimAtPath("/Actor/Skel/Motion"))
    assert motion.GetRotationsAttr().GetNumTimeSamples() == 0
    real, imaginary = motion.GetRotationsAttr().Get()[0].GetReal(), motion.GetRotationsAttr().Get()[0].GetImaginary()
    assert real == pytest.approx(1) and Gf.Vec3f(imaginary).GetLength() == 0


def test_lost_frames_get_no_key(tmp_path):
    frames, d = example_motion()
    d[5] = np.nan
    bake_rig(tmp_path, example_rig(), example_meshes(), name="gap", fps=FPS, frames=frames, d=d)
    assert_valid_usd(tmp_path / "actor_skel.usdc")
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "actor_skel.usdc"))
    times = layer.ListTimeSamplesForPath("/Actor/Skel/Motion.rotations")
    assert times == [frame for frame in frames.tolist() if frame != 35]
