"""d from stages without a rig: Xforms, bones and point caches of the actor's meshes."""

import json

import numpy as np
import pytest
from example_rig import FPS, assert_valid_usd, example_meshes, example_motion, example_rig, moved
from pxr import Gf, Sdf, Usd, UsdGeom, Vt
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from jawusd.base.errors import FormatError
from jawusd.cli.main import app
from jawusd.rig.motion_read import read_parameters_of_stage
from jawusd.rig.stage_poses import fit_poses_of_stage

FRAMES, D = example_motion(20)


def run(*arguments, code=0):
    done = CliRunner().invoke(app, [str(x) for x in arguments])
    assert done.exit_code == code, (done.output, done.exception)
    return done.stdout


def exported(path, T, cached=False, names=("UpperTeethMesh", "LowerTeethMesh"), size=0.1, change=None):
    """Write a take like an export of another program: other units, axes, hierarchy; transforms, or points per frame."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(FPS)
    stage.SetStartTimeCode(float(FRAMES[0]))
    stage.SetEndTimeCode(float(FRAMES[-1]))
    heads = np.tile(np.eye(4), (len(T), 1, 1))
    heads[:, :3, :3] = size * Rotation.from_rotvec(np.linspace(0, 1, len(T))[:, None] * [0.3, 1, 0.2]).as_matrix()
    heads[:, :3, 3] = np.linspace(0, 2, len(T))[:, None] * [1, 2, 3]
    for name, mesh, poses in zip(names, ("upper_teeth", "lower_teeth"), (heads, heads @ T), strict=True):
        prim = UsdGeom.Mesh.Define(stage, f"/World/{name}")
        shape = example_meshes()[mesh]
        vertices = change(shape.vertices) if change else shape.vertices
        prim.CreateFaceVertexCountsAttr(Vt.IntArray([3] * len(shape.faces)))
        prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(shape.faces.astype(np.int32).ravel()))
        points = prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices.astype(np.float32)))
        op = None if cached else prim.AddTransformOp()
        for frame, pose in zip(FRAMES.tolist(), poses, strict=True):
            if cached:
                points.Set(Vt.Vec3fArray.FromNumpy(moved(pose[None], vertices)[0].astype(np.float32)), frame)
            else:
                op.Set(Gf.Matrix4d(pose.T.tolist()), frame)
    stage.Save()
    return path


@pytest.mark.parametrize("cached", [False, True])
def test_exports_come_back_to_d_and_to_a_valid_layer(folder, kind, cached):
    rig, actor = example_rig(kind), folder / "actor.usda"
    path = exported(folder / "shot.usda", rig.pose(D), cached)
    summary = json.loads(run("encode", actor, path, "-o", folder / "d.csv", "--json"))
    assert summary["encoded"] == len(D) and summary["outside"] == 0
    read = np.loadtxt(folder / "d.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(read[:, 0], FRAMES)
    np.testing.assert_allclose(read[:, 1:4], D, atol=1e-3)
    np.testing.assert_allclose(read[:, 5], rig.margin(D), atol=1e-3)
    run("rebake", actor, path, "-o", folder / "anim.usdc")
    times, d, fps = read_parameters_of_stage(folder / "anim.usdc")
    np.testing.assert_array_equal(times, FRAMES)
    np.testing.assert_allclose(d, D, atol=1e-3)
    assert fps == FPS
    run("animate", actor, path, "-o", folder / "again.usdc")
    for name in ("anim.usdc", "again.usdc"):
        run("validate", actor, folder / name)
        assert_valid_usd(folder / name)


@pytest.mark.parametrize("frames", [len(D), 1])
def test_a_take_without_motion_is_said_to_have_none(frames, anchored_folder):
    """Like an export whose drivers were not baked: valid, but nothing moves."""
    actor, path = anchored_folder / "actor.usda", anchored_folder / "still.usda"
    exported(path, np.tile(example_rig().pose(np.zeros(3)), (len(D), 1, 1)))
    if frames == 1:
        stage = Usd.Stage.Open(str(path))
        stage.SetEndTimeCode(stage.GetStartTimeCode())
        stage.Save()
    said = f"the mandible does not move in {frames} frames: was it exported without baking?"
    for command, name in (("encode", "d.csv"), ("rebake", "anim.usdc"), ("animate", "again.usdc")):
        assert said in run(command, actor, path, "-o", anchored_folder / name)
    found = json.loads(run("encode", actor, path, "-o", anchored_folder / "e.csv", "--json"))
    assert found["moved_mm"] < 0.001
    moving = exported(anchored_folder / "moving.usda", example_rig().pose(D))
    found = json.loads(run("encode", actor, moving, "-o", anchored_folder / "f.csv", "--json"))
    assert found["moved_mm"] > 5
    assert "does not move" not in run("encode", actor, moving, "-o", anchored_folder / "g.csv")


def test_edited_bones_come_back(folder, kind):
    """The skeleton variant with a changed key: one pose outside the bound is reported and moved inside."""
    rig, (frames, d) = example_rig(kind), example_motion()
    stage = Usd.Stage.Open(str(folder / "actor_skel.usdc"))
    run("encode", folder / "actor.usda", folder / "actor_skel.usdc", "-o", folder / "d.csv")
    read = np.loadtxt(folder / "d.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(read[:, 1:4], d, atol=1e-3)
    translations = stage.GetPrimAtPath("/Actor/Skel/Motion").GetAttribute("translations")
    value = np.array(translations.Get(frames[20].item())) + [0, 0, 14]
    translations.Set(Vt.Vec3fArray.FromNumpy(value.astype(np.float32)), frames[20].item())
    stage.GetRootLayer().Export(str(folder / "edited.usdc"))
    out = run("rebake", folder / "actor.usda", folder / "edited.usdc", "-o", folder / "anim.usdc")
    assert "1 of 40 samples lay outside the bound; worst at frame 50, margin -" in out
    _, back, _ = read_parameters_of_stage(folder / "anim.usdc")
    assert rig.is_inside(back).all()
    run("validate", folder / "actor.usda", folder / "anim.usdc")


def test_a_point_cache_of_the_rig_itself_counts(folder, kind):
    """If the mandible mesh of a stage with the rig deforms, the motion is read from its points."""
    rig = example_rig(kind)
    stage = Usd.Stage.CreateNew(str(folder / "cached.usda"))
    stage.GetRootLayer().subLayerPaths.append("./actor.usda")
    stage.SetStartTimeCode(float(FRAMES[0]))
    stage.SetEndTimeCode(float(FRAMES[-1]))
    for name, mesh in (("MandibleMesh", "mandible"), ("LowerTeethMesh", "lower_teeth")):
        points = UsdGeom.Mesh(stage.GetPrimAtPath(f"/Actor/geo/Mandible/{name}")).GetPointsAttr()
        at_rest = np.linalg.inv(rig.T_rest) @ rig.pose(D)
        for frame, vertices in zip(FRAMES.tolist(), moved(at_rest, example_meshes()[mesh].vertices), strict=True):
            points.Set(Vt.Vec3fArray.FromNumpy(vertices.astype(np.float32)), frame)
    stage.Save()
    run("encode", folder / "actor.usda", folder / "cached.usda", "-o", folder / "d.csv")
    np.testing.assert_allclose(np.loadtxt(folder / "d.csv", delimiter=",", skiprows=1)[:, 1:4], D, atol=1e-3)


@pytest.mark.parametrize("split", [True, False])
def test_vertices_may_be_split_or_shuffled(folder, kind, split):
    rig, rng = example_rig(kind), np.random.default_rng(5)
    path = exported(folder / "shot.usda", rig.pose(D))
    stage = Usd.Stage.Open(str(path))
    for name, mesh in (("UpperTeethMesh", "upper_teeth"), ("LowerTeethMesh", "lower_teeth")):
        shape, prim = example_meshes()[mesh], UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}"))
        twice = np.arange(0, len(shape.vertices), 4) if split else np.arange(0)
        of = np.concatenate([np.arange(len(shape.vertices)), twice])
        place = np.argsort(of, kind="stable") if split else rng.permutation(len(of))
        where = np.argsort(place)
        prim.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(shape.vertices[of[place]].astype(np.float32)))
        corners = shape.faces.astype(np.int32).ravel().copy()
        for k, vertex in enumerate(twice):  # every other corner of it uses the second one
            corners[np.flatnonzero(shape.faces.ravel() == vertex)[::2]] = len(shape.vertices) + k
        prim.GetFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(where[corners].astype(np.int32)))
    stage.Save()
    np.testing.assert_allclose(fit_poses_of_stage(path, folder / "actor.usda").T, rig.pose(D), atol=1e-3)


def test_names_tell_or_are_told(folder, kind):
    rig, actor = example_rig(kind), folder / "actor.usda"
    path = exported(folder / "shot.usda", rig.pose(D), names=("a", "b"))
    with pytest.raises(FormatError, match="vertices"):
        fit_poses_of_stage(path, actor)
    found = fit_poses_of_stage(path, actor, mandible="/World/b", skull="/World/a")
    np.testing.assert_allclose(found.T, rig.pose(D), atol=1e-3)
    assert found.meshes == ("/World/a", "/World/b") and found.misfit_mm < 1e-3
    with pytest.raises(FormatError, match="no prim /nowhere"):
        fit_poses_of_stage(path, actor, mandible="/nowhere", skull="/World/a")


def test_another_mesh_of_as_many_vertices_is_refused(folder, kind):
    path = exported(folder / "shot.usda", example_rig(kind).pose(D), change=lambda v: v * [1, 1.5, 1])
    with pytest.raises(FormatError, match="from those of the rig; at most 0.5 mm is allowed"):
        fit_poses_of_stage(path, folder / "actor.usda")


def test_a_stage_without_range_is_refused(folder, kind):
    path = exported(folder / "shot.usda", example_rig(kind).pose(D))
    layer = Sdf.Layer.FindOrOpen(str(path))
    layer.ClearStartTimeCode()
    layer.ClearEndTimeCode()
    layer.Save()
    with pytest.raises(FormatError, match="no start and end"):
        fit_poses_of_stage(path, folder / "actor.usda")


def two_actors(path, rig):
    """Write two copies of an actor side by side, the second moving half as far."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(FPS)
    stage.SetStartTimeCode(float(FRAMES[0]))
    stage.SetEndTimeCode(float(FRAMES[-1]))
    for name, share in (("Anna", 1.0), ("Ben", 0.5)):
        one = exported(path.with_name(f"{name}.usda"), rig.pose(share * D))
        stage.DefinePrim(f"/Shot/{name}", "Xform").GetReferences().AddReference(f"./{one.name}", "/World")
    stage.Save()
    return path


def test_of_two_copies_of_an_actor_one_has_to_be_named(anchored_folder):
    rig, actor = example_rig(), anchored_folder / "actor.usda"
    path = two_actors(anchored_folder / "shot.usda", rig)
    with pytest.raises(FormatError, match="several meshes .*: /Shot/Anna/UpperTeethMesh, /Shot/Ben/UpperTeethMesh"):
        fit_poses_of_stage(path, actor)
    for name, share in (("Anna", 1.0), ("Ben", 0.5)):
        out = anchored_folder / f"{name}.csv"
        run("encode", actor, path, "-o", out, "--prim", f"/Shot/{name}")
        np.testing.assert_allclose(np.loadtxt(out, delimiter=",", skiprows=1)[:, 1:4], share * D, atol=1e-3)
        run("rebake", actor, path, "-o", anchored_folder / f"{name}.usdc", "--prim", f"/Shot/{name}")
        _, d, _ = read_parameters_of_stage(anchored_folder / f"{name}.usdc")
        np.testing.assert_allclose(d, share * D, atol=1e-3)


def test_a_point_cache_of_something_else_changes_no_rig(anchored_folder):
    """Like a cached face: two actors of the same person, chosen by prim, moved by transforms."""
    stage = Usd.Stage.CreateNew(str(anchored_folder / "shot.usda"))
    frames, d = example_motion()
    stage.SetStartTimeCode(float(frames[0]))
    stage.SetEndTimeCode(float(frames[-1]))
    stage.SetTimeCodesPerSecond(FPS)
    for name, source in (("Anna", "anim_capture.usdc"), ("Ben", "actor.usda")):
        stage.DefinePrim(f"/Shot/{name}", "Xform").GetReferences().AddReference(f"./{source}")
    points = UsdGeom.Mesh.Define(stage, "/Shot/Face").CreatePointsAttr()
    for frame in frames.tolist():
        points.Set(Vt.Vec3fArray([(0, 0, frame), (1, 0, 0), (0, 1, 0)]), frame)
    stage.Save()
    actor, path = anchored_folder / "actor.usda", anchored_folder / "shot.usda"
    for name, expected in (("Anna", d), ("Ben", 0 * d)):
        out = anchored_folder / f"{name}.csv"
        run("encode", actor, path, "-o", out, "--prim", f"/Shot/{name}")
        np.testing.assert_allclose(np.loadtxt(out, delimiter=",", skiprows=1)[:, 1:4], expected, atol=1e-5)
