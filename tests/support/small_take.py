"""A small take of the made-up mouth: PNG masks, picks and the capture that names them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from bumpy_teeth import arch, jaw_poses, make_cameras, render_masks, vertex_error_mm

from jawusd.formats.capture import Capture
from jawusd.formats.tracks import Tracks
from jawusd.geometry import transform_point
from jawusd.tracking import track_capture

ROWS = ("upper", "lower")
FIRST = 5  # first frame of the reference camera
START = 3  # the bootstrap frame, counted from the first
OFFSETS = {"cam0": 0, "cam1": 2, "cam2": -1}
MESHES = (arch(True), arch(False))
CAMERAS = make_cameras()
LANDMARKS = np.array([[0, 0, 1], [20, -3, -20], [-20, -3, -20], [45, 30, -70], [-45, 30, -70.0]])


def png(folder: Path, camera: str, row: str, k: int) -> Path:
    """Return the mask file of the take's k-th frame."""
    return folder / camera / row / f"{FIRST + k - OFFSETS[camera]:06d}.png"


def write_masks(folder: Path, count: int, delays: tuple[float, ...] = (0.0, 0.0, 0.0), grown_px: float = 0.0) -> Path:
    """Write the masks of a take.

    Args:
        folder: where to.
        count: frames.
        delays: camera c shows frame + delays[c].
        grown_px: how far the masks reach beyond the teeth.
    """
    rng = np.random.default_rng(0)
    for camera, delay in zip(CAMERAS, delays):
        for row in ROWS:
            (folder / camera.name / row).mkdir(parents=True)
        for k, poses in enumerate(jaw_poses(np.arange(count) + delay)):
            masks = render_masks(MESHES, poses, camera, (7.5, -16.0), 0.3, rng, grown_px=grown_px)
            for row, mask in zip(ROWS, masks):
                cv2.imwrite(str(png(folder, camera.name, row, k)), (mask > 127).astype(np.uint8) * 255)
    return folder


def source(folder: Path, name: str) -> dict:
    """Return the capture's entry of one camera with its masks."""
    return {"name": name, "masks": {row: folder / name / row / "%06d.png" for row in ROWS}}


def make_capture(folder: Path, count: int, away_mm: float = 0.0, **change: object) -> Capture:
    """Return the capture of a take.

    Args:
        folder: where the masks are.
        count: frames.
        away_mm: error of the picks.
        change: fields to replace.
    """
    rng = np.random.default_rng(1)
    picks = {row: [] for row in ROWS}
    poses = jaw_poses(START + 1)[START]
    for r, row in enumerate(ROWS):
        for vertex in rng.choice(len(MESHES[r].vertices), 5, replace=False):
            place = transform_point(poses[r], MESHES[r].vertices[vertex]) + [0, away_mm, 0]
            pixels = [(c.name, c.project(place) + rng.normal(size=2) * 0.7) for c in CAMERAS[:2]]
            views = [{"camera": n, "x": float(p[0]), "y": float(p[1])} for n, p in pixels]
            picks[row].append({"vertex": int(vertex), "views": views})
    fields = {
        "folder": folder,
        "name": "take",
        "fps": 25.0,
        "frames": (FIRST, FIRST + count),
        "scans": {"upper_teeth": "u.ply", "lower_teeth": "l.ply"},
        "cameras": [source(folder, c.name) for c in CAMERAS],
        "bootstrap": {"frame": FIRST + START, **picks},
    }
    return Capture(**{**fields, **change})


def track(capture: Capture, **options: object) -> Tracks:
    """Track a take with its true cameras, offsets and scans."""
    return track_capture(capture, CAMERAS, OFFSETS, *MESHES, LANDMARKS, **options)


def errors_mm(tracks: Tracks, raw: bool = False) -> np.ndarray:
    """Return the mean vertex error of both rows, shape (F, 2)."""
    prefix = "raw_" if raw else ""
    poses = np.stack([getattr(tracks, f"{prefix}T_world_{row}") for row in ROWS], 1)
    truth = jaw_poses(int(tracks.frames.max()) - FIRST + 1)
    return np.array(
        [
            [vertex_error_mm(MESHES[r], poses[k, r], truth[f - FIRST, r]) for r in (0, 1)]
            for k, f in enumerate(tracks.frames)
        ]
    )
