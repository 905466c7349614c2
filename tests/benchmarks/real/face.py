"""How far the jaw is open by MediaPipe's face mesh in pictures of one camera, against the truth of a capture."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
from peers import ROWS, camera_video, load_truth
from report import Origin, table, title

from jawusd.formats.capture import Capture, load_capture
from jawusd.geometry import Camera, se3_inverse, transform_point, transform_points
from jawusd.pipeline.cameras import load_cameras
from jawusd.pipeline.subject import load_meshes, subject_of_capture

Array = np.ndarray
SAMPLES = 40  # frames spread over the take
FEWEST = 10  # faces that a line is fitted to
ORIGIN = Origin("frames of one camera spread over each capture, simulated by jawusd", "ours", "face")
NOSE, CHIN, EARS, LIPS = 1, 152, (234, 454), (13, 14)  # numbers of landmarks; of the lips the inner edges


def run(captures: list[Path], python: Path | None) -> None:
    """Print a row per capture."""
    title("Opening by MediaPipe", ORIGIN)
    if python is None:
        print("MediaPipe was not run: name the Python of an environment with mediapipe 0.10.21 with --mediapipe.")
        return
    print("Distance of the lower incisal point from its place in the bite [mm] by the line through all measurements")
    print("that fits the truth best: MediaPipe's own figures have no scale.\n")
    header = ("capture", "camera", "frames", "no face", "truth, spread", "jaw angle, rms off", "lips, rms off")
    table(header, (row(path, python) for path in captures), ORIGIN)


def row(path: Path, python: Path) -> list[str]:
    """Return the row of a capture."""
    capture = load_capture(path)
    cameras, meshes = load_cameras(capture), load_meshes(capture)
    truth, incisor = load_truth(capture), subject_of_capture(capture, meshes).landmarks[0]
    camera = most_frontal(cameras, truth["T_world_upper"][0], meshes[f"{ROWS[0]}_teeth"].vertices)
    offsets = dict(zip(truth["camera_names"].tolist(), truth["offsets"].tolist(), strict=True))
    chosen = np.linspace(0, len(truth["frames"]) - 1, SAMPLES).astype(int)
    T = (se3_inverse(truth["T_world_upper"]) @ truth["T_world_lower"])[chosen]
    opening = np.linalg.norm(transform_points(T, incisor[None])[:, 0] - incisor, axis=-1)
    frames = truth["frames"][chosen] - offsets[camera.name]
    shown = (frames >= 0) & (frames < length(capture, camera))
    faces = landmarks(camera_video(capture, camera), frames[shown], python)
    seen = np.array([face is not None for face in faces], dtype=bool)
    told = [str(len(faces)), str(np.count_nonzero(~seen))]
    if seen.sum() < FEWEST:
        return [capture.name, camera.name, *told, "-", "-", "-"]
    points, opening = np.array([face for face in faces if face is not None]), opening[shown][seen]
    figures = (opening.std(), off_line(jaw_angle(points), opening), off_line(lips_apart(points), opening))
    return [capture.name, camera.name, *told, *(f"{figure:.1f}" for figure in figures)]


def most_frontal(cameras: list[Camera], T_world_upper: Array, vertices: Array) -> Camera:
    """Return the camera that stands nearest to the line on which the upper row faces forward."""
    teeth = transform_point(T_world_upper, vertices.mean(axis=0))

    def towards(camera: Camera) -> float:
        away = se3_inverse(camera.T_cam_world)[:3, 3] - teeth
        return float(T_world_upper[:3, 2] @ away / np.linalg.norm(away))

    return max(cameras, key=towards)


def length(capture: Capture, camera: Camera) -> int:
    """Return the number of frames of a camera's video."""
    import cv2

    return int(cv2.VideoCapture(str(camera_video(capture, camera))).get(cv2.CAP_PROP_FRAME_COUNT))


def landmarks(video: Path, frames: Array, python: Path) -> list[list[list[float]] | None]:
    """Return the landmarks of each frame, None without a face."""
    script = Path(__file__).with_name("face_mesh.py")
    command = [str(python), str(script), str(video.resolve()), *map(str, frames.tolist())]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{python} ended with {done.returncode}: {done.stderr[-500:]}")
    return json.loads(done.stdout)


def jaw_angle(points: Array) -> Array:
    """Return the angles [rad] between nose and chin as seen from between the ears, of landmarks (F, N, 3)."""
    middle = points[:, EARS].mean(axis=1)
    rays = [points[:, k] - middle for k in (NOSE, CHIN)]
    rays = [ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays]
    return np.arccos(np.clip((rays[0] * rays[1]).sum(axis=1), -1, 1))


def lips_apart(points: Array) -> Array:
    """Return the distances of the lips' inner edges in widths of the face, of landmarks (F, N, 3)."""
    gap, width = (np.linalg.norm(points[:, a] - points[:, b], axis=1) for a, b in (LIPS, EARS))
    return gap / width


def off_line(measured: Array, truth: Array) -> float:
    """Return the rms distance of the truth from its best line over what was measured."""
    line = np.polyfit(measured, truth, 1)
    return float(np.sqrt(((np.polyval(line, measured) - truth) ** 2).mean()))
