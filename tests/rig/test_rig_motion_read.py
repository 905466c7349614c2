"""Poses read from stages of other programs."""

import json

import numpy as np
import pytest
from example_rig import example_motion, example_rig
from pxr import Gf, Usd, UsdGeom
from typer.testing import CliRunner

from jawusd.base.errors import FormatError
from jawusd.cli.main import app
from jawusd.rig import write_animation
from jawusd.rig.motion_read import read_poses_of_stage


@pytest.fixture
def animation(folder):
    frames, d = example_motion()
    return write_animation(folder / "anim.usdc", folder / "actor.usda", frames, d, 24), frames, d


def test_baked_motion_is_read_back(animation, kind):
    path, frames, d = animation
    read, poses = read_poses_of_stage(path)
    np.testing.assert_array_equal(read, frames)
    np.testing.assert_allclose(poses, example_rig(kind).pose(d), atol=1e-6)


def shot(folder, path, change=None):
    """A shot in centimetres in which the actor has been moved and scaled."""
    stage = Usd.Stage.CreateNew(str(folder / "shot.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetStartTimeCode(30)
    stage.SetEndTimeCode(33)
    prim = stage.DefinePrim("/Shot/Person", "Xform")
    prim.GetReferences().AddReference(str(path))
    xform = UsdGeom.XformCommonAPI(prim)
    xform.SetTranslate(Gf.Vec3d(4, 5, 6))
    xform.SetRotate(Gf.Vec3f(10, 20, 30))
    xform.SetScale(Gf.Vec3f(0.1, 0.1, 0.1))
    if change:
        change(stage)
    stage.Save()
    return folder / "shot.usda"


def test_where_the_actor_stands_does_not_matter(animation, folder, kind):
    path, frames, d = animation
    read, poses = read_poses_of_stage(shot(folder, path))
    assert read.tolist() == [30, 31, 32, 33]
    np.testing.assert_allclose(poses, example_rig(kind).pose(d)[np.isin(frames, read)], atol=1e-5)


def test_a_sheared_mandible_is_refused(animation, folder):
    def shear(stage):
        mandible = UsdGeom.Xformable(stage.GetPrimAtPath("/Shot/Person/geo/Mandible"))
        mandible.MakeMatrixXform().Set(Gf.Matrix4d(1, 0.2, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1))

    with pytest.raises(FormatError, match="not rigid at frame 30"):
        read_poses_of_stage(shot(folder, animation[0], shear))


def test_a_stage_without_frames_is_refused(folder):
    with pytest.raises(FormatError, match="time code"):
        read_poses_of_stage(folder / "actor.usda")


def test_the_command_judges_an_animation(animation, folder):
    path, _, d = animation
    result = CliRunner().invoke(app, ["validate", str(folder / "actor.usda"), str(path), "--json"])
    verdicts = json.loads(result.stdout)
    assert verdicts["poses"] == len(d) and result.exit_code == int(verdicts["invalid"] > 0)

    def unhinge(stage):
        mandible = UsdGeom.Xformable(stage.GetPrimAtPath("/Shot/Person/geo/Mandible"))
        mandible.MakeMatrixXform().Set(Gf.Matrix4d().SetTranslate(Gf.Vec3d(0, 25, 0)))

    bad = shot(folder, path, unhinge)
    result = CliRunner().invoke(app, ["validate", str(folder / "actor.usda"), str(bad), "--json"])
    assert result.exit_code == 1 and json.loads(result.stdout)["invalid"] == 4
