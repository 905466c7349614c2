"""Write a synthetic capture: scans, videos, masks, boards, calibration, picks and ground truth."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.base.arrays import Array
from jawusd.cameras.calibration import save_calibration
from jawusd.formats.atomic import write_bytes_atomic, write_npz_atomic, write_text_atomic
from jawusd.formats.capture import Bootstrap, Pick
from jawusd.formats.capture_writing import pick_lines
from jawusd.formats.mesh import Mesh
from jawusd.geometry import LANDMARKS, Camera
from jawusd.media.writers import VideoWriter
from jawusd.synthetic.anatomy import build_anatomy
from jawusd.synthetic.annotations import Outline, choose_picks, drawn_mask
from jawusd.synthetic.person import Person
from jawusd.synthetic.render import Picture, Renderer
from jawusd.synthetic.take import (
    BOARD_COLUMNS,
    BOARD_ROWS,
    FPS,
    LEAD,
    OPEN_HOLD,
    REST_HOLD,
    SQUARE_MM,
    TAIL,
    Scene,
    Take,
    board,
    board_poses,
    build_cameras,
    perform,
)

Progress = Callable[[int, int], None]

# Offset of each camera; frame k of a camera is simultaneous with frame k + offset of the first camera.
_OFFSETS = (0, 5, -3)
_SCANS = ("upper_teeth", "lower_teeth", "mandible", "skull")
_PICKS = 4
_PICK_NOISE_PX = 1.0
_PICTURES_PER_BOARD = 2
# Sensor noise: standard deviation [gray levels, 0..255], and number of patterns; every image gets a randomly shifted
# copy of one pattern.
_SENSOR_NOISE = 1.3
_NOISE_PATTERNS = 5


_IMAGE_S = 0.93  # rendering time per image on two cores without a GPU; the default capture has 900 images


@dataclass(frozen=True)
class DemoConfig:
    """Seed, size and video quality of a synthetic capture."""

    seed: int = 0  # seed of the subject and the performance
    frames: int = 240  # number of tracked frames, at 24 per second
    size_px: tuple[int, int] = (1280, 720)  # width and height of the images
    boards: int = 24  # number of poses of the calibration board
    quality_crf: int = 23  # H.264 constant rate factor of the videos

    def __post_init__(self) -> None:
        if self.frames <= OPEN_HOLD + REST_HOLD:
            raise ValueError(f"frames must be greater than {OPEN_HOLD + REST_HOLD}, got {self.frames}")
        if min(self.size_px) < 64 or self.size_px[0] % 2 or self.size_px[1] % 2:
            raise ValueError(f"size_px must be even and at least 64, got {self.size_px}")
        if self.boards < 1:
            raise ValueError(f"boards must be at least 1, got {self.boards}")

    @property
    def images(self) -> int:
        """Return the total number of images of all cameras."""
        return len(build_cameras(self.size_px)) * (LEAD + self.frames + TAIL + self.boards)

    @property
    def seconds(self) -> float:
        """Return the approximate rendering time without a GPU [s]."""
        return self.images * _IMAGE_S


def write_demo(folder: str | os.PathLike[str], config: DemoConfig, progress: Progress | None = None) -> Path:
    """Record a synthetic subject to a capture folder, overwriting existing files; return the path of capture.toml.

    Progress is the number of images done and the total number.

    Raises:
        MissingDependencyError: there is no headless OpenGL (EGL).
        OutputError: the folder cannot be written.
    """
    folder = Path(folder)
    person = Person(config.seed)
    cameras = build_cameras(config.size_px)
    with Renderer(cameras) as renderer:  # without OpenGL, raises before a file is written
        anatomy = build_anatomy(person)
        take = perform(person, anatomy.occlusion, config.frames, _OFFSETS, config.seed)
        recorder = _Recorder(folder, config, cameras, renderer, progress)
        recorder.performance(Scene(person, anatomy, renderer), take)
        T_world_board = recorder.boards()
    scans = (anatomy.upper.mesh, anatomy.lower.mesh, anatomy.mandible, anatomy.skull)
    for name, mesh in zip(_SCANS, scans, strict=True):
        write_bytes_atomic(folder / "scans" / f"{name}.ply", _ply(mesh))
    save_calibration(folder / "calibration.toml", cameras)
    write_npz_atomic(folder / "truth" / "truth.npz", _truth(person, cameras, take, T_world_board))
    path = folder / "capture.toml"
    write_text_atomic(path, _description(config, cameras, take, recorder.picks))
    return path


class _Recorder:
    """Writer that renders every image of a capture and writes the video files."""

    def __init__(
        self, folder: Path, config: DemoConfig, cameras: list[Camera], renderer: Renderer, progress: Progress | None
    ) -> None:
        self._folder = folder
        self._config = config
        self._cameras = cameras
        self._renderer = renderer
        self._progress = progress
        self._frames = LEAD + config.frames + TAIL
        self._total = config.images
        self._done = 0
        self._rng = [np.random.default_rng([config.seed, 0xCA3, k]) for k in range(len(cameras))]
        shape = (_NOISE_PATTERNS, config.size_px[1], config.size_px[0], 3)
        self._grain = np.rint(self._rng[0].normal(0.0, _SENSOR_NOISE, shape)).astype(np.int8)
        self.picks: dict[str, tuple[Pick, ...]] = {}

    def performance(self, scene: Scene, take: Take) -> None:
        """Record videos and masks of the exercises, and the picks in the first tracked frame."""
        outlines = [[Outline(self._config.size_px, rng) for _ in ("upper", "lower")] for rng in self._rng]
        black = np.zeros(self._config.size_px[::-1], np.uint8)
        with contextlib.ExitStack() as stack:
            videos = [stack.enter_context(self._video("video", camera)) for camera in self._cameras]
            masks = [[stack.enter_context(self._mask(c, jaw)) for jaw in ("upper", "lower")] for c in self._cameras]
            for index in range(len(take.phase)):
                instant = take.first_instant + index
                poses = scene.pose(take, index)
                tracked = take.tracked[0] <= instant < take.tracked[1]
                if instant == take.tracked[0]:
                    self._pick(scene, take, index)
                for k in range(len(self._cameras)):
                    if not 0 <= instant - _OFFSETS[k] < self._frames:
                        continue
                    jitter = (outlines[k][0].next(), outlines[k][1].next()) if tracked else None
                    picture = scene.draw(k, take, index, poses, jitter)
                    videos[k].write(self._noisy(picture, k))
                    for writer, coverage in zip(masks[k], (picture.upper, picture.lower), strict=True):
                        writer.write(drawn_mask(coverage, self._rng[k]) if tracked else black)
                    self._count()

    def boards(self) -> Array:
        """Record the calibration board; return its poses T_world_board, shape (B, 4, 4)."""
        self._renderer.add("board", board())
        poses = board_poses(self._config.boards, np.random.default_rng([self._config.seed, 0xB0A2D]))
        with contextlib.ExitStack() as stack:
            videos = [stack.enter_context(self._video("boards", camera)) for camera in self._cameras]
            for T in poses:
                for k, video in enumerate(videos):
                    picture = self._renderer.render(k, {"board": T}, T)
                    for _ in range(_PICTURES_PER_BOARD):
                        video.write(self._noisy(picture, k))
                    self._count()
        return poses

    def _pick(self, scene: Scene, take: Take, index: int) -> None:
        head = take.T_world_skull[index]
        occluders = scene.occluders(take, index)
        rng = np.random.default_rng([self._config.seed, 0x91C])
        for jaw, arch, T in (
            ("upper", scene.anatomy.upper, head),
            ("lower", scene.anatomy.lower, head @ take.T_skull_mandible[index]),
        ):
            self.picks[jaw] = choose_picks(arch, T, self._cameras, occluders, _PICKS, _PICK_NOISE_PX, rng)

    def _video(self, kind: str, camera: Camera) -> VideoWriter:
        path = self._folder / kind / f"{camera.name}.mp4"
        return VideoWriter(path, self._config.size_px, FPS, quality_crf=self._config.quality_crf)

    def _mask(self, camera: Camera, jaw: str) -> VideoWriter:
        path = self._folder / "masks" / camera.name / f"{jaw}.mkv"
        return VideoWriter(path, self._config.size_px, FPS, lossless=True)

    def _noisy(self, picture: Picture, camera: int) -> NDArray[np.uint8]:
        """Add sensor noise."""
        rng = self._rng[camera]
        pattern = self._grain[rng.integers(_NOISE_PATTERNS)]
        shift = tuple(int(rng.integers(s)) for s in pattern.shape[:2])
        return np.clip(picture.color + np.roll(pattern, shift, (0, 1)).astype(np.int16), 0, 255).astype(np.uint8)

    def _count(self) -> None:
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, self._total)


def _ply(mesh: Mesh) -> bytes:
    """Encode a coloured mesh as binary PLY with float32 positions."""
    vertices = np.zeros(len(mesh.vertices), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    vertices["xyz"], vertices["rgb"] = mesh.vertices, mesh.colors
    faces = np.zeros(len(mesh.faces), [("n", "u1"), ("index", "<i4", 3)])
    faces["n"], faces["index"] = 3, mesh.faces
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment lengths in mm\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return header.encode() + vertices.tobytes() + faces.tobytes()


def _truth(person: Person, cameras: list[Camera], take: Take, T_world_board: Array) -> dict[str, ArrayLike]:
    """Return the ground truth of the tracked frames."""
    frames = np.arange(*take.tracked)
    rows = frames - take.first_instant
    upper = take.T_world_skull[rows]
    return {
        "frames": frames,
        "T_world_upper": upper,
        "T_world_lower": upper @ take.T_skull_mandible[rows],
        "T_upper_lower": take.T_skull_mandible[rows],
        "phase": take.phase[rows],
        "controls": take.controls[rows],
        "camera_names": np.array([camera.name for camera in cameras]),
        "offsets": np.array(_OFFSETS),
        "K": np.stack([camera.K for camera in cameras]),
        "dist": np.stack([camera.distortion for camera in cameras]),
        "R": np.stack([camera.T_cam_world[:3, :3] for camera in cameras]),
        "t": np.stack([camera.T_cam_world[:3, 3] for camera in cameras]),
        "flash": take.dark,
        "rest_frame": np.array(take.rest_frame),
        "landmark_names": np.array(LANDMARKS),
        "landmarks": person.landmarks,
        "board_T_world": T_world_board,
    }


def _description(config: DemoConfig, cameras: list[Camera], take: Take, picks: dict[str, tuple[Pick, ...]]) -> str:
    """Return the text of capture.toml."""
    lines = [
        'format = "jawusd-capture/1"',
        f'name = "synthetic_{config.seed}"',
        'units = "mm"',
        f"fps = {FPS}",
        'calibration = "calibration.toml"',
        f"frames = [{take.tracked[0]}, {take.tracked[1]}]",
        "",
        "[scans]",
        *(f'{name} = "scans/{name}.ply"' for name in _SCANS),
        "",
    ]
    for camera in cameras:
        lines += ["[[camera]]", f'name = "{camera.name}"', f'video = "video/{camera.name}.mp4"']
        lines += [f'masks.{jaw} = "masks/{camera.name}/{jaw}.mkv"' for jaw in ("upper", "lower")] + [""]
    videos = ", ".join(f'"boards/{camera.name}.mp4"' for camera in cameras)
    lines += ["[boards]", 'pattern = "chessboard"', f"cols = {BOARD_COLUMNS}", f"rows = {BOARD_ROWS}"]
    lines += [f"square_mm = {SQUARE_MM}", f"videos = [{videos}]", ""]
    lines += ["[sync]", 'method = "flash"', f'reference = "{cameras[0].name}"', ""]
    lines += ["[bootstrap]", *pick_lines(Bootstrap(frame=take.tracked[0], upper=picks["upper"], lower=picks["lower"]))]
    lines += ["", "[motion]", f"rest_frame = {take.rest_frame}", ""]
    return "\n".join(lines)
