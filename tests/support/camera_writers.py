"""Three cameras, and files of them as other programs write them."""

import json

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from jawusd.geometry import Camera, make_transform, se3_inverse

NAMES = ("front", "left", "right")
SIZE = (1280, 720)
K = np.array([[1400.0, 0, 641.5], [0, 1410.0, 357.0], [0, 0, 1]])
LENS = np.array([0.05, -0.02, 0.001, -0.0007])


def look(angle):
    R = Rotation.from_euler("yx", [angle, 4], degrees=True).as_matrix() @ np.diag([1.0, -1, -1])
    return make_transform(R, np.array([3.0, -2.0, 330.0]))


CAMERAS = [Camera(name, SIZE, K, LENS, look(angle)) for name, angle in zip(NAMES, (0, -25, 30))]
POINTS = np.random.default_rng(0).uniform(-40, 40, (200, 3))


def same(found, names=NAMES, wanted=CAMERAS):
    assert [camera.name for camera in found] == list(names)
    for one, other in zip(found, wanted, strict=True):
        assert one.size_px == other.size_px
        np.testing.assert_allclose(one.project(POINTS), other.project(POINTS), atol=1e-5)


def metashape(labels=NAMES, cameras=CAMERAS, extra=""):
    out = [
        '<document version="1.5.0"><chunk><sensors><sensor id="0" type="frame"><resolution width="1280" height="720"/>'
    ]
    k1, k2, p1, p2 = LENS
    terms = {"f": K[1, 1], "b1": K[0, 0] - K[1, 1], "cx": K[0, 2] + 0.5 - 640, "cy": K[1, 2] + 0.5 - 360}
    terms |= {"k1": k1, "k2": k2, "p1": p2, "p2": p1}
    out += ['<calibration class="adjusted"><resolution width="1280" height="720"/>']
    out += [f"<{key}>{float(value)!r}</{key}>" for key, value in terms.items()]
    out += [f"{extra}</calibration></sensor></sensors><cameras>"]
    for label, camera in zip(labels, cameras, strict=True):
        matrix = " ".join(repr(float(x)) for x in se3_inverse(camera.T_cam_world).ravel())
        out.append(f'<camera sensor_id="0" label="{label}"><transform>{matrix}</transform></camera>')
    return "".join([*out, "</cameras></chunk></document>"])


def stored(camera, suffix, *, key="camera_matrix", before="", after=""):
    """Return what OpenCV's own writer makes of a camera, with text before or behind its values."""
    file = cv2.FileStorage(f"x{suffix}", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    file.write("image_width", camera.size_px[0])
    file.write("image_height", camera.size_px[1])
    file.write(key, camera.K)
    file.write("distortion_coefficients", camera.distortion[None])
    file.write("R", camera.T_cam_world[:3, :3])
    file.write("T", camera.T_cam_world[:3, 3:])
    text = file.releaseAndGetString()
    if suffix == ".xml":
        return text.replace("<opencv_storage>", f"<opencv_storage>{before}").replace(
            "</opencv_storage>", f"{after}</opencv_storage>"
        )
    if suffix == ".json":
        return text.replace("{", "{" + before, 1)
    return text.replace("---\n", f"---\n{before}", 1) + after


def colmap(folder, points, *, model="OPENCV", names=None, ids=None, lens=None):
    """Write a text model; points says what stands below each image: None for no line at all."""
    folder.mkdir(parents=True, exist_ok=True)
    values = " ".join(map(repr, map(float, (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, *LENS))))
    (folder / "cameras.txt").write_text(f"# Camera list\n1 {model} 1280 720 {values}\n" + (lens or ""))
    lines = ["# Image list with two lines of data per image:"]
    for k, camera in enumerate(CAMERAS):
        q = np.roll(Rotation.from_matrix(camera.T_cam_world[:3, :3]).as_quat(), 1)
        pose = " ".join(repr(float(x)) for x in (*q, *camera.T_cam_world[:3, 3]))
        lines.append(f"{k + 1} {pose} {(ids or [1, 1, 1])[k]} {(names or [f'{n}.png' for n in NAMES])[k]}")
        lines += [] if points[k] is None else [points[k]]
    (folder / "images.txt").write_text("\n".join([*lines, ""]))
    return folder


def nerfstudio(**changes):
    frames = []
    for camera in CAMERAS:
        T = se3_inverse(camera.T_cam_world) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"images/{camera.name}.png", "transform_matrix": T.tolist()})
    values = {"w": 1280, "h": 720, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5}
    values |= dict(zip(("k1", "k2", "p1", "p2"), map(float, LENS)))
    return json.dumps({**values, "camera_model": "OPENCV", "frames": frames, **changes})
