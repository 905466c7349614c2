"""In Blender, the jaw is at the same pixels of the take's cameras as by the calibration."""

import cv2
import numpy as np
import pytest
from example_rig import FPS, example_meshes, example_motion, example_rig, moved
from foreign import run_in
from scipy.spatial.transform import Rotation

from jawusd.geometry import Camera, make_transform
from jawusd.plugins.extension import build_extension
from jawusd.rig.bake import bake_rig
from jawusd.rig.cameras import PLATE, write_cameras

SIZE = (1920, 1080)


def cameras():
    """Return two cameras with square pixels and an off-centre axis, in front of the face and beside it."""
    found = []
    for i, (f, cx, cy) in enumerate(((2100, 959.5, 539.5), (1800, 930.0, 610.25))):
        K = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]])
        R = Rotation.from_euler("xyz", [0.1 - 0.2 * i, 0.5 * i - 0.2, 0.05]).as_matrix()
        distortion = np.array([-0.1, 0.02, 0, 0, 0])
        found.append(Camera(f"cam{i}", SIZE, K, distortion, make_transform(R, [5, -8, 250])))
    return found


@pytest.mark.parametrize("blender", ["blender45", "blender50"])
def test_blenders_cameras_see_the_jaw_where_the_calibration_does(tmp_path, blender):
    frames, d = example_motion()
    bake_rig(tmp_path, example_rig(), example_meshes(), name="x", fps=FPS, frames=frames, d=d, table_size=17)
    turn = np.stack([np.pi + np.linspace(0, 0.1, len(d)), np.zeros(len(d)), np.zeros(len(d))], axis=1)
    heads = make_transform(Rotation.from_euler("xyz", turn).as_matrix(), np.outer(np.arange(len(d)), [0.1, 0, 0.05]))
    write_cameras(tmp_path / "cameras.usda", cameras(), tmp_path / "anim_capture.usdc", frames, heads, FPS)
    shown = (0, 17, 39)
    found = run_in(
        blender,
        "blender_cameras.py",
        tmp_path / "cameras.usda",
        *SIZE,
        ",".join(str(frames[k]) for k in shown),
        "LowerTeethMesh",
        ",".join(camera.name for camera in cameras()),
    )
    for k in shown:
        in_world = moved((heads[k] @ example_rig().pose(d[k]))[None], example_meshes()["lower_teeth"].vertices)[0]
        for camera in cameras():
            difference = np.array(found[str(frames[k])][camera.name]) - camera.project_pinhole(in_world)
            assert np.abs(difference).max() < 0.05


@pytest.mark.parametrize("blender", ["blender45", "blender50"])
def test_the_add_on_puts_plates_behind_the_cameras(tmp_path, blender):
    frames, d = example_motion()
    bake_rig(tmp_path, example_rig(), example_meshes(), name="x", fps=FPS, frames=frames, d=d, table_size=17)
    heads = np.broadcast_to(np.eye(4), (len(d), 4, 4))
    write_cameras(tmp_path / "cameras.usda", cameras(), tmp_path / "anim_capture.usdc", frames, heads, FPS)
    plate = tmp_path / (PLATE.format(name="cam0") % frames[3])
    plate.parent.mkdir(parents=True)
    plate.write_bytes(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    archive = build_extension(tmp_path / "jawusd_blender.zip")
    found = run_in(blender, "blender_plates.py", archive, tmp_path, tmp_path / "cameras.usda")
    assert found["cameras"] == {"cam0": [str(plate), "SEQUENCE", 0], "cam1": None}
    assert found["scene"] == ["cam0", *SIZE]
    for camera in cameras():
        lens = 36.0 * camera.K[0, 0] / SIZE[0]
        np.testing.assert_allclose(found["lenses"][camera.name], [lens, 36.0], rtol=1e-4)
