"""Calibrations of COLMAP and nerfstudio, against points projected by their own formulas, and files that are wrong."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jawusd.base.errors import CalibrationError
from jawusd.cameras.calibration import load_calibration, save_calibration
from jawusd.cameras.files import calibration_files, load_cameras_file

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-0.05, 0.05, (20, 3))  # in the files' unit, metres


def colmap_pixels(points, quaternion_wxyz, t, model, params):
    """Project as COLMAP documents its camera models; pixel centres at half integers."""
    w, x, y, z = quaternion_wxyz
    p = Rotation.from_quat([x, y, z, w]).apply(points) + t
    u, v = p[:, 0] / p[:, 2], p[:, 1] / p[:, 2]
    r2 = u * u + v * v
    if model == "SIMPLE_RADIAL":
        f, cx, cy, k = params
        return np.stack([f * u * (1 + k * r2) + cx, f * v * (1 + k * r2) + cy], axis=1)
    fx, fy, cx, cy = params[:4]
    if model == "OPENCV":
        k1, k2, p1, p2 = params[4:]
        radial = k1 * r2 + k2 * r2 * r2
        du = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
        dv = v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v)
        u, v = u + du, v + dv
    return np.stack([fx * u + cx, fy * v + cy], axis=1)


COLMAP = {
    "cam0": ((0.9, 0.1, -0.3, 0.2), (0.01, 0.02, 0.3), "PINHOLE", (900.0, 910.0, 321.5, 239.0)),
    "cam1": ((0.8, -0.2, 0.4, 0.1), (-0.05, 0.02, 0.25), "SIMPLE_RADIAL", (880.0, 320.0, 240.0, -0.08)),
    "cam2": (
        (1.0, 0.0, 0.2, 0.1),
        (0.03, 0.01, 0.28),
        "OPENCV",
        (905.0, 903.0, 318.0, 243.0, -0.1, 0.05, 0.002, -0.003),
    ),
}


@pytest.fixture
def colmap(tmp_path):
    cameras, images = ["# Camera list", ""], ["# Image list", "#   POINTS2D[]"]
    for k, (name, (q, t, model, params)) in enumerate(COLMAP.items()):
        cameras.append(f"{k + 1} {model} 640 480 {' '.join(map(str, params))}")
        # The second line of an image lists its points and may be empty.
        images += [f"{k + 1} {' '.join(map(str, (*q, *t)))} {k + 1} {name}/0001.png", "" if k else "1.5 2.5 -1"]
    (tmp_path / "cameras.txt").write_text("\n".join([*cameras, ""]))
    (tmp_path / "images.txt").write_text("\n".join([*images, ""]))
    return tmp_path


def test_colmap_cameras_see_what_colmap_says(colmap):
    for path in (colmap, colmap / "images.txt", colmap / "cameras.txt"):
        cameras = load_cameras_file(path, unit_mm=1000.0)
        assert [camera.name for camera in cameras] == list(COLMAP)
        assert calibration_files(path) == [colmap / "cameras.txt", colmap / "images.txt"]
        for camera, (q, t, model, params) in zip(cameras, COLMAP.values(), strict=True):
            expected = colmap_pixels(POINTS, np.array(q) / np.linalg.norm(q), t, model, params) - 0.5
            np.testing.assert_allclose(camera.project(POINTS * 1000), expected, atol=1e-8)
            assert camera.size_px == (640, 480)


def change(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("cameras.txt", "PINHOLE", "OPENCV_FISHEYE", "model OPENCV_FISHEYE; it must be one of SIMPLE_PINHOLE"),
        ("cameras.txt", "900.0 910.0", "900.0", "camera 1 of the model PINHOLE has 5 values; expected 6"),
        ("cameras.txt", "900.0", "many", "is not a list of numbers"),
        ("cameras.txt", "900.0", "-900.0", "focal lengths -900"),
        ("images.txt", "0.9 0.1 -0.3 0.2", "0 0 0 0", "zero quaternion"),
        ("images.txt", "0.9", "nan", "not finite"),
        ("images.txt", " 1 cam0/", " 7 cam0/", "refers to camera 7"),
        ("images.txt", "cam1/0001.png", "cam0/0002.png", "camera cam0 has different poses"),
        ("images.txt", " cam2/0001.png", "", "is not an image"),
    ],
)
def test_colmap_files_that_are_wrong_are_refused(colmap, file, old, new, words):
    change(colmap / file, old, new)
    with pytest.raises(CalibrationError, match=words):
        load_cameras_file(colmap)


def test_a_colmap_model_needs_both_files_and_images(colmap):
    (colmap / "images.txt").write_text("# nothing\n")
    with pytest.raises(CalibrationError, match="has no images"):
        load_cameras_file(colmap)
    (colmap / "images.txt").unlink()
    with pytest.raises(CalibrationError, match=r"images\.txt: cannot be read.*cameras\.txt and images\.txt"):
        load_cameras_file(colmap)


def look_at(eye, target, up):
    """Return camera-to-world with OpenGL axes: the camera looks along its -z, y is up."""
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross(up, back) / np.linalg.norm(np.cross(up, back))
    T = np.eye(4)
    T[:3] = np.stack([right, np.cross(back, right), back, eye], axis=1)
    return T


@pytest.fixture
def transforms():
    lens = {"fl_x": 900.0, "fl_y": 905.0, "cx": 321.0, "cy": 238.5, "w": 640, "h": 480, "k1": -0.05, "p2": 0.001}
    eyes = {"left": [0.1, 0.02, 0.3], "right": [-0.15, 0.0, 0.25]}
    frames = [
        {"file_path": f"images/{name}.png", "transform_matrix": look_at(np.array(eye), np.zeros(3), [0, 1, 0]).tolist()}
        for name, eye in eyes.items()
    ]
    return {"camera_model": "OPENCV", **lens, "frames": frames}


def written(tmp_path, data):
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(data))
    return path


def test_nerfstudio_cameras_see_with_opengl_axes(tmp_path, transforms):
    cameras = load_cameras_file(written(tmp_path, transforms), unit_mm=1000.0)
    assert [camera.name for camera in cameras] == ["left", "right"]
    for camera, frame in zip(cameras, transforms["frames"], strict=True):
        T = np.array(frame["transform_matrix"])
        gl = (POINTS - T[:3, 3]) @ T[:3, :3]  # right, up, backward
        assert (gl[:, 2] < 0).all()
        u, v = gl[:, 0] / -gl[:, 2], -gl[:, 1] / -gl[:, 2]  # pictures count downward
        r2 = u * u + v * v
        u, v = u * (1 - 0.05 * r2) + 0.001 * (r2 + 2 * u * u), v * (1 - 0.05 * r2) + 2 * 0.001 * u * v
        expected = np.stack([900 * u + 321 - 0.5, 905 * v + 238.5 - 0.5], axis=1)
        np.testing.assert_allclose(camera.project(POINTS * 1000), expected, atol=1e-8)


def test_nerfstudio_scale_is_undone_and_frames_may_have_their_own_lens(tmp_path, transforms):
    plain = load_cameras_file(written(tmp_path, transforms))
    for frame in transforms["frames"]:
        T = np.array(frame["transform_matrix"])
        T[:3, 3] *= 0.25
        frame["transform_matrix"] = T[:3].tolist()
    transforms["frames"][1]["fl_x"] = 500.0
    scaled = load_cameras_file(written(tmp_path, transforms | {"applied_scale": 0.25}))
    for a, b in zip(plain, scaled, strict=True):
        np.testing.assert_allclose(a.T_cam_world, b.T_cam_world, atol=1e-12)
    assert (scaled[0].K[0, 0], scaled[1].K[0, 0]) == (900, 500)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"camera_model": "OPENCV_FISHEYE"}, "only perspective models"),
        ({"k4": 0.1}, "k4 = 0.1; it must be 0"),
        ({"fl_x": None}, 'has no "fl_x"'),
        ({"fl_x": 0}, "focal lengths 0"),
        ({"frames": []}, 'has no "frames"'),
        ({"frames": [{"file_path": "a.png"}]}, "frames.0. has no .transform_matrix"),
        ({"frames": [{"transform_matrix": []}]}, 'has no "file_path"'),
        ({"frames": [{"file_path": "a.png", "transform_matrix": (2 * np.eye(4)).tolist()}]}, "not a rigid"),
    ],
)
def test_nerfstudio_files_that_are_wrong_are_refused(tmp_path, transforms, changes, words):
    with pytest.raises(CalibrationError, match=words):
        load_cameras_file(written(tmp_path, transforms | changes))


def test_damaged_json_is_refused(tmp_path):
    path = tmp_path / "transforms.json"
    for text in ("{", "[1]", ""):
        path.write_text(text)
        with pytest.raises(CalibrationError, match="JSON"):
            load_cameras_file(path)


def test_toml_in_another_unit_is_scaled(tmp_path, colmap):
    cameras = load_cameras_file(colmap)
    save_calibration(tmp_path / "c.toml", cameras)
    assert calibration_files(tmp_path / "c.toml") == [tmp_path / "c.toml"]
    plain, scaled = load_calibration(tmp_path / "c.toml"), load_cameras_file(tmp_path / "c.toml", 10.0)
    for a, b in zip(plain, scaled, strict=True):
        np.testing.assert_allclose(10 * a.T_cam_world[:3, 3], b.T_cam_world[:3, 3])
        np.testing.assert_allclose(a.T_cam_world[:3, :3], b.T_cam_world[:3, :3])
