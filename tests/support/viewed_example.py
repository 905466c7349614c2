"""The example as the viewer is given it: a copy that says its offsets, and tracks that are the truth."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
from package_copy import ROOT

from jawusd.formats.tracks import LOST, PARTIAL, TRACKED, LostReason, Tracks, save_tracks
from jawusd.pipeline.state import BuildState

EXAMPLE = ROOT / "examples" / "capture"
FIRST, STOP = 20, 50


def quiet(stage: str, done: int, total: int) -> None:
    """Swallow progress."""


def truth() -> dict[str, np.ndarray]:
    """Return the true motion of the example."""
    with np.load(EXAMPLE / "truth" / "truth.npz") as archive:
        return {name: archive[name] for name in archive.files}


def write_true_tracks(path: Path, cameras: tuple[str, ...] = ("cam0", "cam1", "cam2")) -> Path:
    """Write tracks of the example's first frames that are the truth, one frame lost."""
    known = truth()
    rows = slice(*np.searchsorted(known["frames"], (FIRST, STOP)))
    count = STOP - FIRST
    poses = {name: known[name][rows].copy() for name in ("T_world_upper", "T_world_lower", "T_upper_lower")}
    poses["T_world_lower"][7] = poses["T_upper_lower"][7] = np.nan
    status = np.full((count, 2), TRACKED, np.int8)
    status[7, 1], status[3] = LOST, PARTIAL
    reason, value, limit = np.zeros((count, 2), np.uint8), np.full((count, 2), np.nan), np.full((count, 2), np.nan)
    reason[7, 1], value[7, 1], limit[7, 1] = LostReason.LOW_SCORE, 0.31, 0.6
    covariance = np.zeros((count, 6, 6))
    save_tracks(path, Tracks(
        frames=known["frames"][rows], **poses, **{f"raw_{name}": value for name, value in poses.items()}, status=status,
        prior_aided=np.arange(count) == 3, coverage_error=np.full((count, 2, 3), 0.004),
        masks_used=np.ones((count, 2, 3), bool), covariance_upper=covariance, covariance_lower=covariance,
        covariance_relative=covariance, sigma_mm=np.zeros((count, 5)), residual_px=np.zeros((count, 2)),
        matched_px=np.zeros((count, 2)), camera_names=cameras, lost_reason=reason, lost_value=value, lost_limit=limit,
    ))  # fmt: skip
    return path


def record_build(folder: Path, capture: Path) -> Path:
    """Let a rig's folder be that of a build of a capture, with tracks that are the truth."""
    write_true_tracks(folder / "tracks.npz")
    known, state = truth(), BuildState(folder)
    offsets = {str(name): int(k) for name, k in zip(known["camera_names"], known["offsets"], strict=True)}
    state.finish("sync", "", [], 0.0, {"offsets": offsets})
    state.finish("report", "", [], 0.0, {"capture": os.path.relpath(capture, folder)})
    return folder


def copy_example(folder: Path) -> Path:
    """Copy the example into a folder that is not there yet; its offsets are given, so that nothing has to be found."""
    shutil.copytree(EXAMPLE, folder)
    known = truth()
    offsets = ", ".join(f"{n} = {k}" for n, k in zip(known["camera_names"], known["offsets"], strict=True))
    path = folder / "capture.toml"
    text = path.read_text().replace('method = "flash"', f'method = "offsets"\noffsets = {{ {offsets} }}')
    path.write_text(text)
    return folder
