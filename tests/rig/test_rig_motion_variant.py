"""The variant `motion`: no change by default; `skeleton` moves the rig by bones, and is read from them."""

import numpy as np
import pytest
from example_rig import FPS, assert_valid_usd, example_meshes, example_motion, example_rig, moved
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
from typer.testing import CliRunner

from jawusd.base.errors import FormatError, RigError
from jawusd.cli.main import app
from jawusd.rig import load_rig, validate_stage, write_animation
from jawusd.rig.bake import bake_rig
from jawusd.rig.geo import MESH_PATHS
from jawusd.rig.motion_read import read_parameters_of_stage, read_poses_of_stage
from jawusd.rig.publish import publish_rig, write_package
from jawusd.rig.rebake import Rebaked, deviation, motion_of_stage, write_rebaked

FRAMES, D = example_motion()
OTHER = {30: (4.0, 0.0, 0.0), 69: (4.0, 1.0, 0.5)}
KEYED = "/Actor/geo/Skel/Motion"


def run(*arguments, code=0):
    done = CliRunner().invoke(app, [str(x) for x in arguments])
    assert done.exit_code == code, done.output
    return done.stdout


def shot(folder, change=lambda actor: None, selected="skeleton", source="anim_capture.usdc", path="/Actor"):
    """Write a stage that uses a rig's motion, as a sublayer at /Actor, as a reference elsewhere; return its path."""
    stage = Usd.Stage.CreateNew(str(folder / f"shot_{source.split('.')[0]}_{path.count('/')}.usda"))
    UsdGeom.SetStageUpAxis(stage, "Y")
    UsdGeom.SetStageMetersPerUnit(stage, 0.001)
    stage.SetTimeCodesPerSecond(FPS)
    stage.SetStartTimeCode(float(FRAMES[0]))
    stage.SetEndTimeCode(float(FRAMES[-1]))
    if path == "/Actor":
        stage.GetRootLayer().subLayerPaths = [f"./{source}"]
        stage.SetDefaultPrim(stage.OverridePrim("/Actor"))
    else:
        stage.SetDefaultPrim(stage.DefinePrim(Sdf.Path(path).GetPrefixes()[0], "Xform"))
        stage.DefinePrim(path, "Xform").GetReferences().AddReference(f"./{source}")
    actor = stage.GetPrimAtPath(path)
    actor.GetVariantSet("motion").SetVariantSelection(selected)
    change(actor)
    stage.Save()
    return folder / stage.GetRootLayer().GetDisplayName()


def skinned(stage, root, path, frame):
    """Return the world positions of a mesh after UsdSkel's own skinning of everything below a prim."""
    prim = stage.GetPrimAtPath(root + path.removeprefix("/Actor"))
    world = np.array(UsdGeom.XformCache(float(frame)).GetLocalToWorldTransform(prim)).T
    return moved(world[None], np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(float(frame)), dtype=float))[0]


def test_by_default_nothing_is_different(anchored_folder):
    with_it = anchored_folder / "anim_capture.usdc"
    without = write_animation(anchored_folder / "plain.usdc", anchored_folder / "actor.usda", FRAMES, D, FPS)
    packages = [write_package(anchored_folder / f"{path.stem}.usdz", path) for path in (with_it, without)]
    assert packages[0].read_bytes() == packages[1].read_bytes()
    assert packages[0].read_bytes() == (anchored_folder / "actor.usdz").read_bytes()
    flat = [Usd.Stage.Open(str(path)).Flatten(False).ExportToString() for path in (with_it, without)]
    assert flat[0] == flat[1] and "variant" not in flat[0] and "Skel" not in flat[0]
    layer = Sdf.Layer.FindOrOpen(str(with_it))
    assert layer.GetPrimAtPath("/Actor").variantSelections["motion"] == "transforms"
    frames, T = read_poses_of_stage(with_it)
    np.testing.assert_allclose(T, example_rig().pose(D), atol=1e-9)


@pytest.mark.parametrize("path", ["/Actor", "/Shot/Person"])
def test_the_skeleton_moves_every_vertex_as_the_model_does(folder, kind, path):
    file = shot(folder, path=path)
    assert_valid_usd(file)
    stage = Usd.Stage.Open(Usd.Stage.Open(str(file)).Flatten())
    assert stage.GetPrimAtPath(path).GetTypeName() == "Xform"
    assert not UsdGeom.Xformable(stage.GetPrimAtPath(f"{path}/geo/Mandible")).GetOrderedXformOps()
    assert UsdSkel.BakeSkinning(UsdSkel.Root(stage.GetPrimAtPath(f"{path}/geo")), Gf.Interval(0, 100))
    poses = example_rig(kind).pose(D)
    for k in (0, 13, 21, 39):
        for name, mesh in example_meshes().items():
            T = poses[k] if name in ("mandible", "lower_teeth") else np.eye(4)
            found = skinned(stage, path, MESH_PATHS[name], FRAMES[k])
            assert np.abs(found - moved(T[None], mesh.vertices)[0]).max() < 1e-4, name


def test_the_bones_are_those_of_the_skeleton_file(anchored_folder):
    layer = Sdf.Layer.FindOrOpen(str(anchored_folder / "anim_capture.usdc"))
    held = layer.GetPrimAtPath("/Actor{motion=skeleton}geo/Skel")
    assert [reference.assetPath for reference in held.referenceList.prependedItems] == ["./actor_skel.usdc"]
    assert not list(held.nameChildren) and not list(held.properties)
    stage = Usd.Stage.Open(str(shot(anchored_folder)))
    stage.Unload("/Actor")
    assert not stage.GetPrimAtPath("/Actor/geo/Mandible").IsDefined()


@pytest.mark.parametrize("path", ["/Actor", "/Shot/Person"])
def test_jawusd_reads_the_skeleton(anchored_folder, tmp_path, path):
    file, rig = shot(anchored_folder, path=path), example_rig()
    assert load_rig(file, path).model_hash == rig.model_hash
    frames, T = read_poses_of_stage(file, path)
    np.testing.assert_array_equal(frames, FRAMES)
    np.testing.assert_allclose(T, rig.pose(D), atol=2e-5)
    away = deviation(file, rig)
    assert away.frames == 0 and away.of == len(D) and away.largest_mm < 1e-4
    assert "40 poses: 40 inside" in run("validate", anchored_folder / "actor.usda", file, "--prim", path)
    said = run("encode", anchored_folder / "actor.usda", file, "--prim", path, "-o", tmp_path / "d.csv")
    assert "d" in said
    table = np.genfromtxt(tmp_path / "d.csv", delimiter=",", names=True)
    np.testing.assert_allclose(np.stack([table[name] for name in ("d1", "d2", "d3")], axis=1), D, atol=1e-4)
    found = motion_of_stage(file, rig, path, "mandible")
    np.testing.assert_allclose(found.d, D, atol=1e-4)


@pytest.mark.slow
def test_edited_bones_are_read_and_baked_to_transforms(anchored_folder, tmp_path):
    rig, wanted = example_rig(), np.array([6.0, -1.0, 0.5])

    def raise_keys(actor):
        """Key two other poses over those of the take, as keys of the joint."""
        bake_rig(tmp_path / "other", rig, example_meshes(), name="x", fps=FPS, frames=[30, 69], d=[wanted, wanted / 2])
        other = Sdf.Layer.FindOrOpen(str(tmp_path / "other" / "actor_skel.usdc"))
        animation = UsdSkel.Animation(actor.GetPrimAtPath("geo/Skel/Motion"))
        for attribute in (animation.GetTranslationsAttr(), animation.GetRotationsAttr()):
            for time in (30.0, 69.0):
                attribute.Set(other.QueryTimeSample(f"/Actor/Skel/Motion.{attribute.GetName()}", time), time)

    file = shot(anchored_folder, raise_keys)
    found = motion_of_stage(file, rig)
    assert found.origin == "mandible"  # in the stronger layer
    np.testing.assert_allclose(found.d[[0, -1]], [wanted, wanted / 2], atol=1e-4)
    assert [finding.rule for finding in validate_stage(file)] == ["Mandible"]
    out = anchored_folder / "mended.usda"
    run("rebake", anchored_folder / "actor.usda", file, "--root", "-o", out)
    assert_valid_usd(out)
    stage = Usd.Stage.Open(str(out))
    assert stage.GetPrimAtPath("/Actor").GetVariantSet("motion").GetVariantSelection() == "transforms"
    np.testing.assert_allclose(read_poses_of_stage(out)[1][[0, -1]], rig.pose([wanted, wanted / 2]), atol=1e-4)


def test_d_keyed_over_a_skeleton_is_found_and_mended(anchored_folder):
    def key_d(actor):
        for i in range(3):
            attribute = actor.GetAttribute(f"jaw:d{i + 1}")
            for time, d in OTHER.items():
                attribute.Set(d[i], time)

    file = shot(anchored_folder, key_d)
    assert "Mandible" in run("validate", file, code=1)
    assert "run `jawusd rebake`" in run("validate", anchored_folder / "actor.usda", file, code=1)
    out = anchored_folder / "mended.usda"
    run("rebake", anchored_folder / "actor.usda", file, "--root", "-o", out)
    assert_valid_usd(out)
    wanted = example_rig().pose(list(OTHER.values()))
    np.testing.assert_allclose(read_poses_of_stage(out)[1][[0, -1]], wanted, atol=1e-6)


def other_key(actor):
    rotations = UsdSkel.Animation(actor.GetPrimAtPath("geo/Skel/Motion")).GetRotationsAttr()
    for time, value in [(time, rotations.Get(time)) for time in rotations.GetTimeSamples()]:
        rotations.Set(Vt.QuatfArray([Gf.Quatf(0.99, 0, 0.141, 0)]) if time == 50 else value, time)


def binding(name, attribute, value):
    def change(actor):
        prim = actor.GetStage().GetPrimAtPath(MESH_PATHS[name])
        prim.GetAttribute(f"primvars:skel:{attribute}").Set(value)

    return change


def unbound(actor):
    prim = actor.GetStage().GetPrimAtPath(MESH_PATHS["lower_teeth"])
    prim.GetRelationship("skel:skeleton").SetTargets([Sdf.Path("/Actor/nowhere")])


def bent(actor):
    mesh = actor.GetStage().GetPrimAtPath(MESH_PATHS["mandible"])
    api, count = UsdSkel.BindingAPI(mesh), len(example_meshes()["mandible"].vertices)
    api.CreateJointIndicesPrimvar(False, 1).Set(Vt.IntArray([k % 2 for k in range(count)]))
    api.CreateJointWeightsPrimvar(False, 1).Set(Vt.FloatArray(count, 1.0))


@pytest.mark.parametrize(
    ("change", "words", "read"),
    [
        (other_key, "the baked pose at 50 is", True),
        (binding("skull", "jointIndices", Vt.IntArray([1])), "differently", True),
        (binding("upper_teeth", "geomBindTransform", Gf.Matrix4d().SetTranslate((0, 1, 0))), "differently", True),
        (binding("lower_teeth", "jointIndices", Vt.IntArray([0])), "differently", False),
        (unbound, "but not /Actor/geo/Mandible/LowerTeethMesh", False),
        (bent, "deform /Actor/geo/Mandible/MandibleMesh", False),
    ],
    ids=["key", "skull", "upper teeth", "lower teeth", "unbound", "bent"],
)
def test_wrong_skeletons_are_caught(anchored_folder, change, words, read):
    file = shot(anchored_folder, change)
    found = [finding for finding in validate_stage(file) if finding.severity == "error"]
    assert [finding.rule for finding in found] == ["Mandible"] and words in found[0].message
    if not read:
        with pytest.raises(FormatError, match="bones"):
            read_poses_of_stage(file)


def test_a_moved_skull_is_caught(anchored_folder):
    def change(actor):
        for name in ("skull", "upper_teeth"):
            binding(name, "jointIndices", Vt.IntArray([1]))(actor)

    found = validate_stage(shot(anchored_folder, change))
    assert [finding.rule for finding in found] == ["Mandible"]
    assert "the skull is moved in the actor by" in found[0].message


def test_bones_that_no_variant_takes_away_are_not_written_over(anchored_folder, tmp_path):
    package, rig = write_package(tmp_path / "flat.usdz", shot(anchored_folder)), example_rig()
    assert not Usd.Stage.Open(str(package)).GetPrimAtPath("/Actor").GetVariantSets().GetNames()
    np.testing.assert_allclose(motion_of_stage(package, rig).d, D, atol=1e-9)  # d and bones agree
    with pytest.raises(RigError, match="bones move /Actor/geo/Mandible"):
        write_rebaked(tmp_path / "out.usda", package, [Rebaked(rig, FRAMES.astype(float), D)])


def test_published_rigs_keep_their_skeleton(anchored_folder, tmp_path):
    publish_rig(anchored_folder, tmp_path / "lib", "hero")
    file = shot(tmp_path / "lib", source="hero_anim_capture.usdc")
    assert_valid_usd(file)
    np.testing.assert_allclose(read_poses_of_stage(file)[1], example_rig().pose(D), atol=2e-5)
    package = write_package(tmp_path / "hero.usdz", file)
    assert_valid_usd(package)
    np.testing.assert_allclose(read_poses_of_stage(package)[1], example_rig().pose(D), atol=2e-5)


def test_lost_frames_do_not_make_the_skeleton_wrong(tmp_path):
    d = D.copy()
    d[8:20] = np.nan
    bake_rig(tmp_path, example_rig(), example_meshes(), name="gap", fps=FPS, frames=FRAMES, d=d, table_size=17)
    file = shot(tmp_path)
    assert_valid_usd(file)
    assert "0 invalid" in run("validate", tmp_path / "actor.usda", file)
    sampled = read_parameters_of_stage(file)
    assert len(sampled[0]) == 40 - 12  # the list of lost frames is in the layer below


def test_without_motion_there_is_no_choice(tmp_path):
    bake_rig(tmp_path, example_rig(), example_meshes(), name="still", fps=FPS, table_size=17)
    path = write_animation(tmp_path / "anim_take.usdc", tmp_path / "actor.usda", [1, 2], [[0, 0, 0], [5, 0, 0]], FPS)
    layer = Sdf.Layer.FindOrOpen(str(path))
    assert not layer.GetPrimAtPath("/Actor").variantSets


def test_instances_are_read_and_rebaked(anchored_folder):
    file = shot(anchored_folder, lambda actor: actor.SetInstanceable(True), path="/Shot/Person")
    assert Usd.Stage.Open(str(file)).GetPrimAtPath("/Shot/Person").IsInstance()
    np.testing.assert_allclose(read_poses_of_stage(file)[1], example_rig().pose(D), atol=2e-5)
    out = anchored_folder / "own.usda"
    run("rebake", anchored_folder / "actor.usda", file, "--root", "-o", out, "--from", "mandible")
    assert_valid_usd(out)
    np.testing.assert_allclose(read_poses_of_stage(out)[1], example_rig().pose(D), atol=1e-4)
    assert not UsdSkel.Root.Find(Usd.Stage.Open(str(out)).GetPrimAtPath("/Shot/Person/geo/Mandible"))
