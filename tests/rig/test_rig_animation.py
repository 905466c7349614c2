"""Animation layers: keys, gaps, time codes, paths."""

import numpy as np
import pytest
from example_rig import assert_valid_usd, example_motion, example_rig, mandible_vertices, moved
from pxr import Sdf, Usd, UsdGeom

from jawusd.base.errors import RigError
from jawusd.rig import write_animation


def pose_at(stage, time):
    mandible = UsdGeom.Xformable(stage.GetPrimAtPath("/Actor/geo/Mandible"))
    return np.array(mandible.GetLocalTransformation(float(time))).T


def test_sparse_keys_move_linearly_and_every_frame_is_baked(folder, kind):
    keys, d = np.array([101, 125, 149]), np.array([[0, 0, 0], [15, 2, 1], [3, -2, 0]])
    out = write_animation(folder / "anim_keys.usdc", folder / "actor.usda", keys, d, 60)
    assert_valid_usd(out)
    stage = Usd.Stage.Open(str(out))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (101, 149)
    assert (stage.GetTimeCodesPerSecond(), stage.GetFramesPerSecond()) == (60, 60)
    actor = stage.GetPrimAtPath("/Actor")
    assert actor.GetAttribute("jaw:d1").GetTimeSamples() == [101, 125, 149]
    translate = stage.GetPrimAtPath("/Actor/geo/Mandible").GetAttribute("xformOp:translate")
    assert set(range(101, 150)) <= set(translate.GetTimeSamples())
    rig = example_rig(kind)
    for time in np.arange(101, 149, 0.3):
        expected = [np.interp(time, keys, column) for column in d.T]
        shown = [actor.GetAttribute(f"jaw:d{i}").Get(time) for i in (1, 2, 3)]
        np.testing.assert_allclose(shown, expected, atol=1e-12)
        difference = moved(pose_at(stage, time)[None], mandible_vertices()) - moved(
            rig.pose(expected)[None], mandible_vertices()
        )
        assert np.linalg.norm(difference, axis=-1).max() < 0.05


def test_lost_frames_are_bridged_and_listed(folder):
    frames, d = example_motion()
    d[[0, 7, 8]] = np.nan
    out = write_animation(folder / "anim_gap.usdc", folder / "actor.usda", frames, d, 24)
    assert_valid_usd(out)
    layer = Sdf.Layer.FindOrOpen(str(out))
    assert list(layer.customLayerData["lostFrames"]) == [30, 37, 38]
    assert layer.startTimeCode == 30
    stage = Usd.Stage.Open(layer)
    assert 37 not in stage.GetPrimAtPath("/Actor").GetAttribute("jaw:d1").GetTimeSamples()
    np.testing.assert_allclose(pose_at(stage, 30), pose_at(stage, 31), atol=1e-12)


def test_fast_motion_gets_samples_between_frames(folder, kind):
    """15 mm in one frame: interpolating only between frames would leave the curved path."""
    out = write_animation(folder / "anim_fast.usdc", folder / "actor.usda", [0, 1], [[0, 0, 0], [15, 2, 1]], 24)
    assert_valid_usd(out)
    stage = Usd.Stage.Open(str(out))
    assert stage.GetPrimAtPath("/Actor/geo/Mandible").GetAttribute("xformOp:orient").GetNumTimeSamples() > 3
    rig = example_rig(kind)
    times = np.linspace(0, 1, 21)
    shown = np.array([pose_at(stage, time) for time in times])
    exact = rig.pose(times[:, None] * [15, 2, 1])
    difference = moved(shown, mandible_vertices()) - moved(exact, mandible_vertices())
    assert np.linalg.norm(difference, axis=-1).max() < 0.05


def test_animation_in_another_folder_finds_its_actor(folder, tmp_path):
    out = write_animation(tmp_path / "shots" / "a" / "anim.usda", folder / "actor.usda", [1], [[3, 0, 0]], 24)
    assert_valid_usd(out)
    assert list(Sdf.Layer.FindOrOpen(str(out)).subLayerPaths) == ["../../actor/actor.usda"]
    assert len(Usd.Stage.Open(str(out)).GetPrimAtPath("/Actor/geo/Mandible").GetChildren()) == 2


@pytest.mark.parametrize(
    ("frames", "d", "fps", "message"),
    [
        ([2, 1], np.zeros((2, 3)), 24, "must increase"),
        ([1, 1], np.zeros((2, 3)), 24, "must increase"),
        ([1, np.nan], np.zeros((2, 3)), 24, "must increase"),
        ([1, 2], np.full((2, 3), np.nan), 24, "nothing to animate"),
        ([], np.zeros((0, 3)), 24, "nothing to animate"),
        ([1, 2], np.zeros((2, 3)), 0, "greater than 0"),
        ([1, 2], np.zeros((2, 3)), np.nan, "greater than 0"),
    ],
)
def test_motions_that_make_no_animation(anchored_folder, frames, d, fps, message):
    out = anchored_folder / "anim_bad.usdc"
    with pytest.raises(RigError, match=message):
        write_animation(out, anchored_folder / "actor.usda", frames, d, fps)
    assert not out.exists()


def test_wrong_shapes_are_refused(anchored_folder):
    with pytest.raises(ValueError, match=r"d \(F, 3\)"):
        write_animation(anchored_folder / "x.usdc", anchored_folder / "actor.usda", [1, 2], np.zeros((2, 2)), 24)


def test_quaternions_keep_to_one_half_space(folder):
    stage = Usd.Stage.Open(str(folder / "anim_capture.usdc"))
    orient = stage.GetPrimAtPath("/Actor/geo/Mandible").GetAttribute("xformOp:orient")
    values = [orient.Get(time) for time in orient.GetTimeSamples()]
    wxyz = np.array([[q.GetReal(), *q.GetImaginary()] for q in values])
    assert (np.einsum("ij,ij->i", wxyz[1:], wxyz[:-1]) > 0).all()
