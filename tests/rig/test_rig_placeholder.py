"""The estimated head of a subject without bones: closed, in place, condyles from the motion, and marked."""

import types

import numpy as np
import pytest
import trimesh
from example_rig import FPS, assert_valid_usd, example_meshes, example_motion, example_rig
from pxr import Usd, UsdGeom, UsdShade

from jawusd.formats.mesh import Mesh
from jawusd.geometry import LANDMARKS, make_transform, so3_exp
from jawusd.geometry.anatomy import MEAN_CONDYLES
from jawusd.rig import describe
from jawusd.rig.bake import bake_rig
from jawusd.rig.placeholder import CONDYLE_ERROR_MM, find_condyles, with_estimated_bones

MEAN = np.array([[50.0, 36.0, -80.0], [-50.0, 36.0, -80.0]])  # the mean adult positions
INFERRED = {"inferred": [f"condyle_left, {MEAN_CONDYLES}, as", f"condyle_right, {MEAN_CONDYLES}, as"]}


def sliding_jaw(condyles, meta=INFERRED, travel_mm=9.0, noise_mm=0.05):
    """Return a fake rig with known condyles, which move along an arc while the jaw opens to any angle.

    Both condyles slide alike along a circle of 12 mm about a crest below and in front of them.
    """
    rng = np.random.default_rng(4)
    slide, angle = rng.uniform(0, travel_mm, 300), rng.uniform(0, 0.5, 300)
    centre = np.mean(condyles, axis=0) * [0, 1, 1]
    path = np.stack([np.zeros(300), 12 * np.cos(slide / 12) - 12, 12 * np.sin(slide / 12)], axis=1)
    path += rng.normal(0, noise_mm, path.shape) * [0, 1, 1]
    R = so3_exp(angle[:, None] * [1.0, 0, 0])
    poses = make_transform(R, centre + path - np.einsum("nij,j->ni", R, centre))
    landmarks = np.array([[0, 0, 0], [21, -1, -26], [-21, -1, -26], *MEAN])
    arrays = {"landmarks": landmarks, "codes": np.zeros((300, 3)), "T_anatomical_skull": np.eye(4), "T_rest": np.eye(4)}
    inferred, captured_d = tuple(meta["inferred"]), arrays["codes"]
    return types.SimpleNamespace(**arrays, captured_d=captured_d, inferred=inferred, pose=lambda d: poses[: len(d)])


@pytest.mark.parametrize("offset", [(0.0, -10.0, -4.0), (0.0, 6.0, 5.0)])
def test_condyles_come_from_the_motion(offset):
    truth = MEAN + offset
    found, source = find_condyles(sliding_jaw(truth))
    assert source == "estimated from the motion"
    assert np.linalg.norm(found - truth, axis=1).max() < 2.5
    assert np.linalg.norm(MEAN - truth, axis=1).min() > 7


def test_a_motion_that_cannot_tell_leaves_the_mean_places():
    for rig in (sliding_jaw(MEAN + [0, -10, -4], travel_mm=2.0), sliding_jaw(MEAN + [0, -10, -4], noise_mm=2.0)):
        found, source = find_condyles(rig)
        assert source == "mean adult positions"
        np.testing.assert_array_equal(found, MEAN)


def test_given_condyles_stay():
    found, source = find_condyles(sliding_jaw(MEAN + [0, -10, -4], meta={"inferred": ["molar_left, from the scans"]}))
    assert source == "landmarks of the model"
    np.testing.assert_array_equal(found, MEAN)


def closed(mesh):
    """Return the mesh in trimesh, which can check that it is closed and oriented outward."""
    made = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert made.is_watertight and made.is_winding_consistent and made.volume > 20_000
    return made


def winding(mesh, point):
    """Return the winding number of a surface about a point: solid angle / 4 pi (van Oosterom & Strackee 1983)."""
    a, b, c = np.moveaxis(mesh.triangles - point, 1, 0)
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    dots = (np.einsum("ij,ij->i", x, y) for x, y in ((b, c), (a, c), (a, b)))
    below = la * lb * lc + sum(dot * length for dot, length in zip(dots, (la, lb, lc)))
    return 2 * np.arctan2(np.einsum("ij,ij->i", a, np.cross(b, c)), below).sum() / (4 * np.pi)


def scans():
    """Return the meshes of the example without its bones."""
    return {name: mesh for name, mesh in example_meshes().items() if name.endswith("teeth")}


def test_bones_are_closed_with_the_body_below_the_scan_and_heads_at_the_condyles(kind):
    rig, meshes = example_rig(kind), scans()
    found, estimate = with_estimated_bones(rig, meshes)
    made = closed(found["mandible"])
    closed(found["skull"])
    assert set(estimate.bones) == {"mandible", "skull"} and estimate.error_mm is None
    condyles = rig.landmarks[[LANDMARKS.index(name) for name in ("condyle_left", "condyle_right")]]
    assert all(winding(made, point) == pytest.approx(1) for point in condyles)
    A = (rig.T_anatomical_skull @ rig.T_rest)[:3, :3]
    height = found["mandible"].vertices @ A[1]
    assert height.min() < (meshes["lower_teeth"].vertices @ A[1]).min() - 10
    assert height.max() < (condyles @ A[1]).max() + 8


def test_a_wider_arch_widens_the_body_and_not_the_rami():
    rig, meshes = example_rig(), scans()
    T = rig.T_anatomical_skull @ rig.T_rest
    widths = []
    for wider_mm in (0.0, 4.0):
        landmarks = rig.landmarks.copy()
        landmarks[1:3] += 0.5 * wider_mm * np.array([[1.0], [-1.0]]) * T[0, :3]
        shown = types.SimpleNamespace(T_anatomical_skull=rig.T_anatomical_skull, T_rest=rig.T_rest)
        shown.landmarks, shown.inferred = landmarks, ()
        points = with_estimated_bones(shown, meshes)[0]["mandible"].vertices @ T[:3, :3].T + T[:3, 3]
        front = points[points[:, 2] > points[:, 2].max() - 40.0]
        widths.append([np.ptp(front[:, 0]), np.ptp(points[:, 0])])
    assert 2.0 < widths[1][0] - widths[0][0] < 10.0
    assert widths[1][1] == pytest.approx(widths[0][1], abs=1e-6)


def test_scans_of_few_teeth_give_bones_too():
    rig, meshes = example_rig(), scans()
    lower = meshes["lower_teeth"]
    near = np.linalg.norm(lower.vertices - rig.landmarks[0], axis=1) < 8
    used, renamed = np.unique(lower.faces[near[lower.faces].all(axis=1)], return_inverse=True)
    few = Mesh(lower.vertices[used], renamed.reshape(-1, 3))
    for bone in ("mandible", "skull"):
        closed(with_estimated_bones(rig, {**meshes, "lower_teeth": few})[0][bone])


def test_given_bones_stay():
    rig, meshes = example_rig(), example_meshes()
    assert with_estimated_bones(rig, meshes) == (meshes, None)
    given = {name: mesh for name, mesh in meshes.items() if name != "mandible"}
    found, estimate = with_estimated_bones(rig, given)
    assert estimate.bones == ("mandible",) and found["skull"] is meshes["skull"]


def test_it_is_marked_wherever_it_goes(tmp_path, kind):
    rig = example_rig(kind)
    rig.meta["inferred"] = [f"condyle_left, {MEAN_CONDYLES}, as there is no mandible mesh"]
    frames, d = example_motion()
    bake_rig(tmp_path, rig, scans(), name="x", fps=FPS, frames=frames, d=d, table_size=17)
    for file in ("actor.usda", "anim_capture.usdc", "actor.usdz", "actor_skel.usdc"):
        assert_valid_usd(tmp_path / file)
        stage = Usd.Stage.Open(str(tmp_path / file))
        prim = stage.GetPrimAtPath("/Actor/geo/Mandible/MandibleMesh")
        assert "placeholder" in prim.GetDisplayName() and "Not anatomy" in prim.GetDocumentation()
        assert prim.GetCustomDataByKey("placeholder") is True
        attribute = prim.GetAttribute("jaw:placeholder")
        assert attribute.Get() is True and attribute.IsCustom()
        source = prim.GetAttribute("jaw:placeholder:condyles").Get()
        assert prim.GetAttribute("jaw:placeholder:condyleError").Get() == CONDYLE_ERROR_MM[source] > 0
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        assert material.GetPrim().GetName() == "Placeholder"
    assert describe(tmp_path / "actor.usda")["placeholders"] == ["SkullMesh", "MandibleMesh"]
    assert describe(tmp_path / "actor.usda")["estimated_condyles"] == {
        "source": source,
        "error_mm": CONDYLE_ERROR_MM[source],
    }


def test_a_given_mandible_bears_no_mark(anchored_folder):
    assert describe(anchored_folder / "actor.usda")["placeholders"] == []
    stage = Usd.Stage.Open(str(anchored_folder / "actor.usda"))
    assert UsdGeom.Mesh(stage.GetPrimAtPath("/Actor/geo/Mandible/MandibleMesh"))
    assert not stage.GetPrimAtPath("/Actor/mtl/Placeholder")
