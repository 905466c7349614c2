"""Files of bake_rig: valid USD whose motion, table and geometry match the model."""

import numpy as np
import pytest
import trimesh
from example_rig import (
    FPS,
    assert_valid_usd,
    example_meshes,
    example_motion,
    example_rig,
    mandible_vertices,
    moved,
)
from pxr import Kind, Usd, UsdGeom, UsdShade
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation

from jawusd.base.errors import RigError
from jawusd.formats.mesh import Mesh, crown_face_mask
from jawusd.geometry import so3_left_jacobian
from jawusd.rig.bake import bake_rig
from jawusd.rig.geo import vertex_normals
from jawusd.rig.table import SIZES, build_table, grid_axes, grid_points, sample_valid, table_error, valid_box

GRAPHS = {"actor.onnx", "actor_encode.onnx"}
FILES = {"actor.usda", "rig.usdc", "geo.usdc", "anim_capture.usdc", "actor_skel.usdc", "actor.usdz"} | GRAPHS


def mandible_at(stage, time):
    local = UsdGeom.Xformable(stage.GetPrimAtPath("/Actor/geo/Mandible")).GetLocalTransformation(time)
    return np.array(local).T


def test_every_file_is_valid_usd(folder):
    files = {path.name for path in folder.iterdir()}
    assert files == FILES
    for name in files - GRAPHS:
        assert_valid_usd(folder / name)


def test_hierarchy_units_and_kinds(folder):
    stage = Usd.Stage.Open(str(folder / "anim_capture.usdc"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 0.001
    actor = stage.GetDefaultPrim()
    assert actor.GetPath() == "/Actor" and Usd.ModelAPI(actor).GetKind() == Kind.Tokens.component
    assert Usd.ModelAPI(stage.GetPrimAtPath("/Actor/geo/Mandible")).GetKind() == Kind.Tokens.subcomponent
    meshes = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    assert len({prim.GetName() for prim in meshes}) == 4
    for prim in meshes:
        mesh = UsdGeom.Mesh(prim)
        assert len(mesh.GetNormalsAttr().Get()) == len(mesh.GetFaceVertexIndicesAttr().Get())
        assert mesh.GetNormalsInterpolation() == "faceVarying"
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        assert material.ComputeSurfaceSource()[0].GetIdAttr().Get() == "UsdPreviewSurface"
        extent = UsdGeom.Boundable(prim).GetExtentAttr().Get()
        points = np.array(mesh.GetPointsAttr().Get())
        np.testing.assert_array_equal(np.array(extent), [points.min(axis=0), points.max(axis=0)])


def test_geometry_arrives_unchanged(anchored_folder):
    stage = Usd.Stage.Open(str(anchored_folder / "actor.usda"))
    for name, path in (("lower_teeth", "Mandible/LowerTeethMesh"), ("skull", "Skull/SkullMesh")):
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/Actor/geo/{path}"))
        expected = example_meshes()[name]
        np.testing.assert_array_equal(np.array(mesh.GetPointsAttr().Get()), expected.vertices.astype(np.float32))
        np.testing.assert_array_equal(np.array(mesh.GetFaceVertexIndicesAttr().Get()), expected.faces.reshape(-1))


def test_baked_ops_equal_the_model_at_every_captured_frame(folder, kind):
    stage = Usd.Stage.Open(str(folder / "anim_capture.usdc"))
    frames, d = example_motion()
    baked = np.array([mandible_at(stage, float(frame)) for frame in frames])
    distance = np.linalg.norm(
        moved(baked, mandible_vertices()) - moved(example_rig(kind).pose(d), mandible_vertices()), axis=-1
    )
    assert distance.max() < 1e-9
    assert np.abs(mandible_at(stage, Usd.TimeCode.Default()) - example_rig(kind).arrays["T_rest"]).max() < 1e-12


def test_between_frames_the_mandible_stays_rigid_and_near_the_model(folder, kind):
    stage = Usd.Stage.Open(str(folder / "anim_capture.usdc"))
    frames, d = example_motion()
    times = np.arange(frames[0], frames[-1], 0.13)
    baked = np.array([mandible_at(stage, time) for time in times])
    assert np.abs(np.linalg.det(baked[:, :3, :3]) - 1).max() < 1e-9
    at = np.stack([np.interp(times, frames, column) for column in d.T], axis=1)
    exact = moved(example_rig(kind).pose(at), mandible_vertices())
    assert np.linalg.norm(moved(baked, mandible_vertices()) - exact, axis=-1).max() < 0.05


def test_table_in_the_file_agrees_with_the_model(folder, kind):
    """Evaluated with scipy's interpolator and Rodrigues vectors, at every mandible vertex, 1,000 random valid d."""
    rig = example_rig(kind)
    stage = Usd.Stage.Open(str(folder / "actor.usda"))
    prim = stage.GetPrimAtPath("/Actor")
    knots = [np.array(prim.GetAttribute(f"jaw:decoder:d{i}Knots").Get()) for i in (1, 2, 3)]
    twists = np.array(prim.GetAttribute("jaw:decoder:twists").Get(), dtype=float).reshape(-1, 6)
    d = sample_valid(rig, 1000, seed=11)
    if kind == "anchored":
        grid = twists.reshape(*(len(axis) for axis in knots), 6)
        twist = RegularGridInterpolator(knots, grid)(d)
    else:
        curves = np.split(twists, np.cumsum([len(axis) for axis in knots])[:2])
        rows = zip(curves, knots, d.T, strict=True)
        twist = sum(np.stack([np.interp(x, axis, c) for c in curve.T], axis=1) for curve, axis, x in rows)
    T = np.tile(np.eye(4), (len(d), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(twist[:, :3]).as_matrix()
    T[:, :3, 3] = np.einsum("nij,nj->ni", so3_left_jacobian(twist[:, :3]), twist[:, 3:])
    read = moved(T @ rig.T_rest, mandible_vertices())
    worst = np.linalg.norm(read - moved(rig.pose(d), mandible_vertices()), axis=-1).max()
    stated = prim.GetAttribute("jaw:decoder:maxError").Get()
    assert 0 < worst <= stated <= 0.06
    assert prim.GetAttribute("jaw:decoder:errorSamples").Get() > 10_000


@pytest.mark.slow
def test_finer_tables_are_better(kind):
    rig = example_rig(kind)
    errors = [build_table(rig, mandible_vertices(), size).max_error_mm for size in SIZES]
    assert errors[0] > 2 * errors[1] > 4 * errors[2] > 0
    with pytest.raises(RigError, match="17, 33, 65"):
        build_table(rig, mandible_vertices(), 20)


def test_knots_span_the_valid_box_and_hold_the_closed_bite(kind):
    rig = example_rig(kind)
    table = build_table(rig, mandible_vertices())
    for (low, high), axis in zip(valid_box(rig), table.axes, strict=True):
        assert (axis[0], axis[-1], len(axis)) == (low, high, 33)
        assert 0.0 in axis and (np.diff(axis) > 0).all()
    assert np.abs(table.twist(np.zeros((1, 3)))).max() < 1e-12


def test_a_table_errs_less_than_interpolated_values():
    rig = example_rig("anchored")
    table = build_table(rig, mandible_vertices())
    d = sample_valid(rig, 2000, seed=3)
    exact = RegularGridInterpolator(table.axes, rig.twist(grid_points(table.axes)).reshape(33, 33, 33, 6))(d)
    away = [np.linalg.norm(found - rig.twist(d), axis=1) for found in (table.twist(d), exact)]
    assert away[0].mean() < 0.7 * away[1].mean() and away[0].max() < 0.9 * away[1].max()


class BentAtTen:
    """A motion along x that turns a corner, rounded over 0.5 mm, at d1 = 10 mm."""

    def pose(self, d):
        T = np.tile(np.eye(4), (*d.shape[:-1], 1, 1))
        T[..., 0, 3] = self.path(d[..., 0])
        return T

    def margin(self, d):
        return np.ones(d.shape[:-1])

    def path(self, d1):
        return np.sqrt((d1 - 10.0) ** 2 + 0.25)


def test_knots_are_dense_where_the_motion_bends():
    box = np.array([[-1.0, 40.0], [-5.0, 5.0], [-2.0, 6.0]])
    rig = BentAtTen()
    d1, d2, _ = grid_axes(rig, box, np.zeros((1, 3)), 33)
    assert np.diff(d1)[np.searchsorted(d1, 10.0) - 1] < 0.25 * np.diff(d1).max()
    np.testing.assert_allclose(np.diff(d2), np.diff(d2).mean(), rtol=0.1)
    x = np.linspace(-1, 40, 5000)
    even = np.linspace(-1, 40, 33)
    error, even_error = (np.abs(np.interp(x, k, rig.path(k)) - rig.path(x)).max() for k in (d1, even))
    assert error < 0.2 * even_error


def test_valid_box_holds_all_valid_parameters(kind):
    rig = example_rig(kind)
    box = valid_box(rig)
    d = np.random.default_rng(8).uniform(box[:, 0] - 3, box[:, 1] + 3, (50_000, 3))
    outside = ((d < box[:, 0]) | (d > box[:, 1])).any(axis=1)
    assert outside.sum() > 1000
    assert (rig.margin(d[outside]) < 0).all()


def test_measured_error_is_that_of_the_worst_vertex(kind):
    rig, vertices = example_rig(kind), mandible_vertices()
    table = build_table(rig, vertices, 17)
    d = sample_valid(rig, 300, seed=2)
    T = np.tile(np.eye(4), (len(d), 1, 1))
    twist = table.twist(d)
    T[:, :3, :3] = Rotation.from_rotvec(twist[:, :3]).as_matrix()
    T[:, :3, 3] = np.einsum("nij,nj->ni", so3_left_jacobian(twist[:, :3]), twist[:, 3:])
    worst = np.linalg.norm(moved(T @ rig.T_rest, vertices) - moved(rig.pose(d), vertices), axis=-1).max()
    assert table_error(rig, table, vertices, d) == pytest.approx(worst, abs=1e-9)


def test_extent_hint_holds_the_moving_actor(anchored_folder):
    stage = Usd.Stage.Open(str(anchored_folder / "anim_capture.usdc"))
    low, high = np.array(stage.GetPrimAtPath("/Actor").GetAttribute("extentsHint").Get())
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_])
    for frame in example_motion()[0]:
        cache.SetTime(float(frame))
        box = cache.ComputeWorldBound(stage.GetPrimAtPath("/Actor/geo")).ComputeAlignedRange()
        assert (np.array(box.GetMin()) >= low - 1e-3).all() and (np.array(box.GetMax()) <= high + 1e-3).all()


def test_gum_and_enamel_split_the_teeth(anchored_folder):
    stage = Usd.Stage.Open(str(anchored_folder / "actor.usda"))
    mesh = UsdGeom.Imageable(stage.GetPrimAtPath("/Actor/geo/Mandible/LowerTeethMesh"))
    subsets = {subset.GetPrim().GetName(): subset for subset in UsdGeom.Subset.GetAllGeomSubsets(mesh)}
    assert set(subsets) == {"LowerTeethMeshGum", "LowerTeethMeshEnamel"}
    gum = np.array(subsets["LowerTeethMeshGum"].GetIndicesAttr().Get())
    np.testing.assert_array_equal(gum, np.flatnonzero(~crown_face_mask(example_meshes()["lower_teeth"])))
    names = {
        name: UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial()[0].GetPrim().GetName()
        for name, subset in subsets.items()
    }
    assert names == {"LowerTeethMeshGum": "Gum", "LowerTeethMeshEnamel": "Enamel"}


def test_unpainted_teeth_are_enamel():
    mesh = example_meshes()["lower_teeth"]
    assert crown_face_mask(Mesh(mesh.vertices, mesh.faces)).all()
    assert crown_face_mask(Mesh(mesh.vertices, mesh.faces, np.full_like(mesh.vertices, 90, dtype=np.uint8))).all()


def test_normals_point_outward_like_those_of_trimesh():
    mesh = example_meshes()["mandible"]
    ours = vertex_normals(mesh)[mesh.faces]
    np.testing.assert_allclose(np.linalg.norm(ours, axis=-1), 1, atol=1e-12)
    theirs = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).vertex_normals[mesh.faces]
    assert np.einsum("fci,fci->fc", ours, theirs).min() > 0.99


def test_a_vertex_without_faces_and_a_degenerate_face_have_unit_normals():
    mesh = Mesh(np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 5, 5]]), np.array([[0, 1, 2]]))
    np.testing.assert_allclose(np.linalg.norm(vertex_normals(mesh), axis=1), 1)


def test_rig_without_skull_and_mandible_meshes(tmp_path, kind):
    meshes = {name: mesh for name, mesh in example_meshes().items() if name.endswith("teeth")}
    for path in bake_rig(tmp_path, example_rig(kind), meshes, name="teeth", fps=FPS):
        if path.suffix != ".onnx":
            assert_valid_usd(path)


@pytest.mark.slow
def test_baking_again_replaces_what_an_open_stage_shows(tmp_path):
    rig, meshes = example_rig(), example_meshes()
    bake_rig(tmp_path, rig, meshes, name="first", fps=FPS)
    stage = Usd.Stage.Open(str(tmp_path / "actor.usda"))
    bake_rig(tmp_path, rig, meshes, name="second", fps=FPS)
    assert stage.GetPrimAtPath("/Actor").GetAttribute("jaw:actor").Get() == "second"
    assert_valid_usd(tmp_path / "actor.usda")
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.slow
def test_baking_twice_gives_the_same_bytes(tmp_path):
    frames, d = example_motion()
    for name in ("a", "b"):
        bake_rig(tmp_path / name, example_rig(), example_meshes(), name="same", fps=FPS, frames=frames, d=d)
        assert_valid_usd(tmp_path / name / "actor.usda")
    for name in FILES:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


def broken_meshes(change):
    meshes = example_meshes()
    if change == "missing":
        del meshes["lower_teeth"]
    elif change == "unknown":
        meshes["tongue"] = meshes["skull"]
    elif change == "empty":
        meshes["mandible"] = Mesh(np.zeros((3, 3)), np.zeros((0, 3), dtype=np.int32))
    else:
        vertices = meshes["skull"].vertices.copy()
        vertices[5] = np.nan
        meshes["skull"] = Mesh(vertices, meshes["skull"].faces)
    return meshes


@pytest.mark.parametrize(
    ("change", "message"),
    [("missing", "lower_teeth"), ("unknown", "tongue"), ("empty", "mandible"), ("nan", "not finite")],
)
def test_meshes_that_make_no_rig_are_refused(tmp_path, change, message):
    with pytest.raises(RigError, match=message):
        bake_rig(tmp_path, example_rig(), broken_meshes(change), name="x", fps=FPS)
    assert list(tmp_path.iterdir()) == []


def test_frame_rate_and_motion_are_checked_before_anything_is_written(tmp_path):
    with pytest.raises(RigError, match="greater than 0"):
        bake_rig(tmp_path, example_rig(), example_meshes(), name="x", fps=0.0)
    with pytest.raises(ValueError, match="both or neither"):
        bake_rig(tmp_path, example_rig(), example_meshes(), name="x", fps=FPS, frames=[1, 2])
    assert list(tmp_path.iterdir()) == []
