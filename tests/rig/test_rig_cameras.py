"""The take: USD cameras project points like the calibrated cameras."""

import numpy as np
import pytest
from example_rig import assert_valid_usd, example_motion, moved
from pxr import Gf, Usd, UsdGeom
from scipy.spatial.transform import Rotation

from jawusd.base.errors import RigError
from jawusd.geometry import Camera, make_transform
from jawusd.rig.cameras import write_cameras


def cameras(skew=0.0):
    """Return two cameras in front of the face, one with oblong pixels and an off-centre axis."""
    found = []
    for i, (fx, fy, cx, cy) in enumerate(((2100, 2100, 959.5, 539.5), (1800, 1750, 700.0, 610.25))):
        R = Rotation.from_euler("xyz", [0.1 - 0.2 * i, 0.5 * i - 0.2, 0.05]).as_matrix()
        K = np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1.0]])
        distortion = np.array([-0.1, 0.02, 0, 0, 0])
        found.append(Camera(f"cam {i}", (1920, 1080), K, distortion, make_transform(R, [5, -8, 250])))
    return found


def head_motion(count):
    """Return world poses of a skull before the cameras, nodding; the world has OpenCV's axes."""
    R = Rotation.from_euler("xyz", np.stack([np.pi + np.linspace(0, 0.1, count), np.zeros(count), np.zeros(count)], 1))
    return make_transform(R.as_matrix(), np.stack([np.linspace(0, 4, count), np.zeros(count), np.zeros(count)], axis=1))


def seen_by_usd(stage, name, points, frame):
    """Project stage points with the frustum of a USD camera to pixels."""
    frustum = UsdGeom.Camera(stage.GetPrimAtPath(f"/Take/Cameras/{name}")).GetCamera(frame).frustum
    matrix = np.array(frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix())
    clip = np.c_[points, np.ones(len(points))] @ matrix
    ndc = clip[:, :2] / clip[:, 3:]
    return np.stack([(ndc[:, 0] + 1) / 2 * 1920 - 0.5, (1 - ndc[:, 1]) / 2 * 1080 - 0.5], axis=1)


def test_usd_cameras_see_the_jaw_where_the_calibration_does(anchored_folder):
    frames, d = example_motion()
    head = head_motion(len(frames))
    actor = anchored_folder / "anim_capture.usdc"
    _, out = write_cameras(anchored_folder / "cameras.usda", cameras(), actor, frames, head, 24)
    assert_valid_usd(out)
    stage = Usd.Stage.Open(str(out))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 0.001)
    mesh = stage.GetPrimAtPath("/Take/Actor/geo/Mandible/LowerTeethMesh")
    points = np.array(UsdGeom.Mesh(mesh).GetPointsAttr().Get(), dtype=float)
    local = stage.GetPrimAtPath("/Take/Actor/geo/Mandible")
    for k in (0, 17, 39):
        cache = UsdGeom.XformCache(float(frames[k]))
        in_stage = moved(np.array(cache.GetLocalToWorldTransform(mesh)).T[None], points)[0]
        T = np.array(UsdGeom.Xformable(local).GetLocalTransformation(float(frames[k]))).T
        in_world = moved((head[k] @ T)[None], points)[0]
        for camera in cameras():
            name = camera.name.replace(" ", "_")
            difference = seen_by_usd(stage, name, in_stage, float(frames[k])) - camera.project_pinhole(in_world)
            assert np.abs(difference).max() < 0.01


def test_the_actor_stands_upright_and_distortion_is_kept(anchored_folder):
    head = head_motion(2)
    actor = anchored_folder / "actor.usda"
    _, out = write_cameras(anchored_folder / "cameras.usda", cameras(), actor, [1, 2], head, 24)
    assert_valid_usd(out)
    stage = Usd.Stage.Open(str(out))
    world = UsdGeom.XformCache(1.0).GetLocalToWorldTransform(stage.GetPrimAtPath("/Take/Actor"))
    assert world.TransformDir(Gf.Vec3d(0, 1, 0))[1] > 0.9
    camera = stage.GetPrimAtPath("/Take/Cameras/cam_1")
    assert list(camera.GetAttribute("jaw:distortion").Get()) == [-0.1, 0.02, 0, 0, 0]
    assert tuple(camera.GetAttribute("jaw:imageSize").Get()) == (1920, 1080)
    assert camera.GetAttribute("jaw:plate").Get() == "./plates/cam 1/cam 1.%06d.jpg"


def test_no_samples_lie_in_text(anchored_folder):
    """NVIDIA's validator reports them, and rewriting must replace the binary layer."""
    actor = anchored_folder / "actor.usda"
    for count in (40, 12):
        motion, out = write_cameras(
            anchored_folder / "cameras.usda", cameras(), actor, np.arange(count), head_motion(count), 24
        )
        assert "timeSamples" not in out.read_text() and motion.suffix == ".usdc"
        stage = Usd.Stage.Open(str(out))
        translate = stage.GetPrimAtPath("/Take/Actor").GetAttribute("xformOp:translate")
        assert translate.GetNumTimeSamples() == count
        np.testing.assert_allclose(translate.Get(count - 1), [4, 0, 0])


def test_lost_frames_get_no_sample(anchored_folder):
    head = head_motion(4)
    head[2] = np.nan
    actor = anchored_folder / "actor.usda"
    _, out = write_cameras(anchored_folder / "cameras.usda", cameras(), actor, [1, 2, 3, 4], head, 24)
    assert_valid_usd(out)
    stage = Usd.Stage.Open(str(out))
    assert stage.GetPrimAtPath("/Take/Actor").GetAttribute("xformOp:orient").GetTimeSamples() == [1, 2, 4]


@pytest.mark.parametrize(
    ("chosen", "head", "message"),
    [
        ([], head_motion(2), "needs cameras"),
        ([*cameras(), cameras()[0]], head_motion(2), "unique names"),
        (cameras(skew=2.0), head_motion(2), "skewed"),
        (cameras(), np.full((2, 4, 4), np.nan), "no pose"),
    ],
)
def test_takes_that_cannot_be_written(anchored_folder, chosen, head, message):
    with pytest.raises(RigError, match=message):
        write_cameras(anchored_folder / "cameras.usda", chosen, anchored_folder / "actor.usda", [1, 2], head, 24)
    assert not (anchored_folder / "cameras.usda").exists()
