"""Ways to measure the jaw, on the same frames of captures with truth: trackers, picked points, markers."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from report import Origin, table, title

from jawusd.formats.capture import Bootstrap, Capture, Pick, PickView, load_capture
from jawusd.formats.mesh import Mesh, crown_face_mask, tooth_labels
from jawusd.geometry import Camera, make_transform, rigid_fits, se3_inverse, transform_points
from jawusd.paper.take import PaperConfig, track_capture_paper
from jawusd.pipeline.cameras import load_cameras
from jawusd.pipeline.subject import load_meshes, subject_of_capture
from jawusd.tracking import track_capture

Array = np.ndarray
ROWS = ("upper", "lower")
OFF_MM = 2.0  # incisal error from which a pose is of no use
# Points per row that a person picks in every picture, how far off along each axis, and the fewest that will do.
PICKS, PICK_PX, FEWEST_PICKS = 8, 1.5, 6
# Markers at the four corners of a plate this far before the teeth, and the noise of their places: 0.18 mm rms, as the
# optical jaw-tracking-system reports of its cameras.
PLATE_MM, BEFORE_MM, MARKER_MM = (50.0, 76.0), 60.0, 0.18
MM_PER_M = 1000.0


@dataclass(frozen=True)
class Scene:
    """Hold a window of a capture with its truth."""

    capture: Capture
    cameras: list[Camera]
    offsets: dict[str, int]
    scans: tuple[Mesh, Mesh]
    landmarks: Array  # (5, 3) of the lower scan
    poses: tuple[Array, Array]  # true T_world_upper and T_world_lower, (F, 4, 4)

    def frames(self) -> range:
        """Return the frames of the window on the reference camera."""
        return range(*self.capture.frames)


def run(captures: list[Path], frames: int, m3t: Path | None) -> None:
    """Print a table per capture."""
    if not captures:
        raise SystemExit("the peers need captures with truth: --captures CAPTURE ..., as examples/capture")
    for path in captures:
        scene = scene_of(path, frames)
        first, last = scene.capture.frames
        origin = Origin(f"{scene.capture.name}, frames {first} to {last - 1}, simulated by jawusd", "ours", "peers")
        title(f"Peers on {scene.capture.name}", origin)
        print(f"Errors of T_upper_lower [mm]; frames without a pose; frames more than {OFF_MM:g} mm off.\n")
        header = ("method", "incisor mean", "largest", "condyles mean", "no pose", "off", "CPU s per frame")
        table(header, (row(name, scene, method) for name, method in methods(m3t).items()), origin)
    if m3t is None:
        print("M3T was not run: name a program that README.md describes with --m3t.")


def scene_of(path: Path, frames: int) -> Scene:
    """Return the window of a capture that begins after a third of it."""
    capture = load_capture(path)
    cameras, meshes = load_cameras(capture), load_meshes(capture)
    truth = load_truth(capture)
    scans = (meshes["upper_teeth"], meshes["lower_teeth"])
    start = min(len(truth["frames"]) // 3, len(truth["frames"]) - frames)
    window = slice(start, start + frames)
    poses = (truth["T_world_upper"][window], truth["T_world_lower"][window])
    first = int(truth["frames"][start])
    picks = {name: exact_picks(scan, T[0], cameras) for name, scan, T in zip(ROWS, scans, poses, strict=True)}
    given = {"frames": (first, first + frames), "bootstrap": Bootstrap(frame=first, **picks)}
    return Scene(
        capture.model_copy(update=given),
        cameras,
        dict(zip(truth["camera_names"].tolist(), truth["offsets"].tolist(), strict=True)),
        scans,
        subject_of_capture(capture, meshes).landmarks,
        poses,
    )


def load_truth(capture: Capture) -> dict[str, Array]:
    """Return the arrays of a capture's truth."""
    with np.load(capture.folder / "truth" / "truth.npz", allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def exact_picks(scan: Mesh, pose: Array, cameras: list[Camera]) -> tuple[Pick, ...]:
    """Return points of a row where they truly are, in the pictures of all cameras that they lie in."""
    picks = []
    for vertex in spread_vertices(scan):
        pixels = {camera.name: inside(camera, transform_points(pose, scan.vertices[[vertex]])) for camera in cameras}
        views = [PickView(camera=name, x=seen[0, 0], y=seen[0, 1]) for name, seen in pixels.items() if len(seen)]
        if len(views) > 1:
            picks.append(Pick(vertex=int(vertex), views=tuple(views)))
    return tuple(picks)


def inside(camera: Camera, points_world: Array) -> Array:
    """Return where points (N, 3) are seen that lie in a camera's picture [px], shape (M, 2)."""
    pixels = camera.project(points_world)
    return pixels[((pixels > 0) & (pixels < np.array(camera.size_px) - 1)).all(axis=1)]


def methods(m3t: Path | None) -> dict[str, Callable[[Scene], Array]]:
    """Return what brings T_upper_lower (F, 4, 4) of a scene, NaN without a pose, by what it is called."""
    found: dict[str, Callable[[Scene], Array]] = {
        "jawusd, contours of masks": contours,
        "paper's tracker (Yang et al. 2019), masks": paper,
        f"OpenCV PnP, {PICKS} picks a row and frame, one camera": picked_points,
        f"markers on both rows, {MARKER_MM} mm noise": markers,
    }
    if m3t is not None:
        found["M3T (Stoiber et al. 2022), footage, all cameras"] = lambda scene: m3t_tracks(scene, m3t)
    return found


def row(name: str, scene: Scene, method: Callable[[Scene], Array]) -> list[str]:
    """Return the row of a method."""
    begun = sum(os.times()[:4])
    found = method(scene)
    seconds = (sum(os.times()[:4]) - begun) / len(found)
    exact = se3_inverse(scene.poses[0]) @ scene.poses[1]
    places = [transform_points(T, scene.landmarks) for T in (found, exact)]
    off = np.linalg.norm(places[0] - places[1], axis=-1)
    there = np.isfinite(off[:, 0])
    if not there.any():
        return [name, "-", "-", "-", str(len(off)), "-", f"{seconds:.2f}"]
    figures = (off[there, 0].mean(), off[there, 0].max(), off[there, 3:].mean())
    counts = (np.count_nonzero(~there), np.count_nonzero(off[there, 0] > OFF_MM))
    return [name, *(f"{figure:.3f}" for figure in figures), *map(str, counts), f"{seconds:.2f}"]


def contours(scene: Scene) -> Array:
    """Track with jawusd's solver."""
    tracks = track_capture(scene.capture, scene.cameras, scene.offsets, *scene.scans, scene.landmarks, threads=1)
    return tracks.T_upper_lower


def paper(scene: Scene) -> Array:
    """Track with the paper's energy and solver."""
    config = PaperConfig()
    tracks = track_capture_paper(scene.capture, scene.cameras, scene.offsets, *scene.scans, config, threads=1)
    return tracks.T_upper_lower


def picked_points(scene: Scene) -> Array:
    """Pose both rows by points that a person picks in every picture of the first camera."""
    rng, camera = np.random.default_rng(0), scene.cameras[0]
    poses = []
    for scan, truth in zip(scene.scans, scene.poses, strict=True):
        points = scan.vertices[spread_vertices(scan)]
        seen = [camera.project(transform_points(T, points)) + rng.normal(0, PICK_PX, (PICKS, 2)) for T in truth]
        poses.append(np.stack([posed(points, pixels, camera) for pixels in seen]))
    return se3_inverse(poses[0]) @ poses[1]


def posed(points: Array, pixels: Array, camera: Camera) -> Array:
    """Return T_cam_row by OpenCV's SQPNP and its refinement by Levenberg-Marquardt; NaN where too few points show."""
    lens, shown = (camera.K, camera.distortion), ((pixels > 0) & (pixels < camera.size_px)).all(axis=1)
    if shown.sum() < FEWEST_PICKS:
        return np.full((4, 4), np.nan)
    points, pixels = points[shown], pixels[shown]
    _, turn, shift = cv2.solvePnP(points, pixels, *lens, flags=cv2.SOLVEPNP_SQPNP)
    turn, shift = cv2.solvePnPRefineLM(points, pixels, *lens, turn, shift)
    return make_transform(cv2.Rodrigues(turn)[0], shift.ravel())


def spread_vertices(scan: Mesh) -> Array:
    """Return vertices of the front half of a row that lie as far apart as they can, (PICKS,)."""
    crown = np.flatnonzero(tooth_labels(scan) > 0)
    depth = scan.vertices[crown, 2]
    crown = crown[depth > np.median(depth)]
    chosen = [crown[scan.vertices[crown, 2].argmax()]]
    while len(chosen) < PICKS:
        apart = np.linalg.norm(scan.vertices[crown, None] - scan.vertices[chosen], axis=-1).min(axis=1)
        chosen.append(crown[apart.argmax()])
    return np.array(chosen)


def markers(scene: Scene) -> Array:
    """Pose both rows by noisy markers on plates before the teeth, whose places on the teeth are known exactly."""
    rng, (height, width) = np.random.default_rng(0), PLATE_MM
    corners = np.array([[x, y, 0.0] for x in (-width / 2, width / 2) for y in (-height / 2, height / 2)])
    poses = []
    for scan, truth in zip(scene.scans, scene.poses, strict=True):
        front = scan.vertices[scan.vertices[:, 2].argmax()]
        plate = corners + front + [0, 0, BEFORE_MM]
        seen = transform_points(truth, plate) + rng.normal(0, MARKER_MM / np.sqrt(3), (len(truth), 4, 3))
        poses.append(rigid_fits(plate, seen)[0])
    return se3_inverse(poses[0]) @ poses[1]


def m3t_tracks(scene: Scene, program: Path) -> Array:
    """Track both rows with M3T, from the true poses of the first frame."""
    with tempfile.TemporaryDirectory() as folder:
        job, poses = Path(folder) / "job.txt", Path(folder) / "poses.txt"
        job.write_text(m3t_job(scene, Path(folder)))
        done = subprocess.run([program.resolve(), job, poses], capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{program} ended with {done.returncode}: {(done.stderr or done.stdout)[-500:]}")
        rows = [line.split() for line in poses.read_text().splitlines()]
    found = {name: np.array([row[2:] for row in rows if row[1] == name], float).reshape(-1, 4, 4) for name in ROWS}
    T = se3_inverse(found["upper"]) @ found["lower"]
    T[:, :3, 3] *= MM_PER_M
    return T


def m3t_job(scene: Scene, folder: Path) -> str:
    """Write pictures without distortion and bodies of the crowns; return the text that the program reads."""
    lines = [str(folder), str(len(scene.poses[0])), str(len(scene.cameras))]
    for camera in scene.cameras:
        pictures = folder / camera.name
        pictures.mkdir()
        write_pictures(scene, camera, pictures)
        lens = (camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2], *camera.size_px)
        lines += [" ".join(map(str, lens)), str(pictures), numbers(se3_inverse(camera.T_cam_world))]
    lines.append(str(len(ROWS)))
    for name, scan, truth in zip(ROWS, scene.scans, scene.poses, strict=True):
        path = folder / f"{name}.obj"
        path.write_text(obj_of_crowns(scan))
        lines += [f"{name} {path}", numbers(truth[0])]
    return "\n".join(lines) + "\n"


def numbers(T: Array) -> str:
    """Return a transform [mm] as 16 numbers by rows [m]."""
    T = T.copy()
    T[:3, 3] /= MM_PER_M
    return " ".join(repr(float(value)) for value in T.ravel())


def obj_of_crowns(scan: Mesh) -> str:
    """Return the crowns of a scan as OBJ."""
    faces = scan.faces[crown_face_mask(scan)]
    used, index = np.unique(faces, return_inverse=True)
    lines = [f"v {x} {y} {z}" for x, y, z in scan.vertices[used]]
    lines += [f"f {a} {b} {c}" for a, b, c in index.reshape(-1, 3) + 1]
    return "\n".join(lines) + "\n"


def write_pictures(scene: Scene, camera: Camera, folder: Path) -> None:
    """Write the window of a camera's video as 0.png, 1.png, ..., the first picture twice, without distortion."""
    video = camera_video(scene.capture, camera)
    reader = cv2.VideoCapture(str(video))
    first = scene.frames()[0] - scene.offsets[camera.name]
    for number in range(first + len(scene.frames())):
        whole, picture = reader.read()
        if not whole:
            raise SystemExit(f"{video} ends before picture {number}")
        if number < first:
            continue
        straight = cv2.undistort(picture, camera.K, camera.distortion)
        for name in (0, 1) if number == first else (number - first + 1,):
            cv2.imwrite(str(folder / f"{name}.png"), straight)


def camera_video(capture: Capture, camera: Camera) -> Path:
    """Return the video of a camera."""
    return next(one.video for one in capture.cameras if one.name == camera.name)
