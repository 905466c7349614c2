"""What colours alone show of the teeth, kept beside the masks that were made around it, and compared with them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import JawusdError
from jawusd.base.npz import TWIST_ORDER, UNITS, read_npz, take
from jawusd.formats.atomic import write_npz_atomic
from jawusd.formats.capture import Capture
from jawusd.formats.finding import Finding
from jawusd.formats.tracks import Tracks
from jawusd.geometry import relative_pose, se3_inverse, transform_points
from jawusd.pipeline.meshes import registration_of
from jawusd.pipeline.segment_record import auto_masks_folder

if TYPE_CHECKING:
    from jawusd.tracking.region.tracker import RegionPose

# Distance of the jaw by masks and by colours from which one is wrong [mm]: right ones of three takes were at most 0.9
# apart. Shares of such frames, or lost ones, from which a take is doubtful, and not usable.
_APART_MM, _FEW, _MANY = 1.0, 0.03, 0.2
GUIDE, _FAMILY = "guide.npz", "jawusd-guide"


def save_guide(folder: Path, inputs: str, guide: Mapping[int, RegionPose]) -> None:
    """Write what was followed, with the hash of everything it depends on.

    Raises:
        OutputError: the file cannot be written.
    """
    frames = sorted(guide)
    meta = {"format": f"{_FAMILY}/1", "units": UNITS, "twist_order": TWIST_ORDER, "inputs": inputs}
    arrays = {
        "meta": np.array(json.dumps(meta)),
        "frames": np.array(frames),
        "poses": np.stack([guide[frame].poses for frame in frames]),
        "found": np.stack([guide[frame].found for frame in frames]),
        "covariance": np.stack([guide[frame].covariance for frame in frames]),
    }
    write_npz_atomic(folder / GUIDE, arrays, packed=False)


def known_guide(folder: Path, inputs: str) -> dict[int, RegionPose]:
    """Return what was followed from the same inputs; nothing if there is none, or it cannot be read."""
    try:
        guide, made_from = _read(folder / GUIDE)
    except JawusdError:
        return {}
    return guide if made_from == inputs else {}


def _read(path: Path) -> tuple[dict[int, RegionPose], str]:
    """Return a guide and the hash of what it was made from; nothing if it is missing.

    Raises:
        FormatError: it is damaged.
    """
    from jawusd.tracking.region.tracker import RegionPose

    if not path.exists():
        return {}, ""
    arrays, meta = read_npz(path, _FAMILY, 1)
    frames = take(arrays, "frames", (None,), path)
    poses = take(arrays, "poses", (len(frames), 2, 4, 4), path)
    found = take(arrays, "found", (len(frames), 2), path).astype(bool)
    covariance = take(arrays, "covariance", (len(frames), 2, 6, 6), path, finite=False)
    rows = zip(frames, poses, found, covariance, strict=True)
    return {int(frame): RegionPose(*row) for frame, *row in rows}, str(meta.get("inputs"))


def take_up_guide(capture: Capture, tracks: Tracks, landmarks: Array) -> tuple[Tracks, list[Finding]]:
    """Return tracks with poses that colours alone gave taken in, and what to say of both; other masks change nothing.

    Kinds: "footage_doubtful" [%], for frames that are lost or in which both differ by more than a millimetre, and
    "footage_unchecked" where there are no such poses. Masks made around a wrong pose confirm it, and borders of colours
    err otherwise than masks do, so that both seldom agree on it.

    Args:
        landmarks: lower teeth, then condyles, mandible coordinates [mm], shape (5, 3).

    Raises:
        FormatError: the file of the poses is damaged.
    """
    from jawusd.tracking.sequence.smoothing import combine

    folder = auto_masks_folder(capture)
    if folder is None:
        return tracks, []
    guide = _read(folder / GUIDE)[0]
    rows = [k for k, frame in enumerate(tracks.frames.tolist()) if frame in guide]
    if not rows:
        message = "no poses by colours lie beside these masks: whether masks were made around wrong poses is not known"
        hint = "Run `jawusd segment` again, and keep its guide.npz beside the masks."
        return tracks, [Finding("footage_unchecked", "warning", message, path=str(folder / GUIDE), hint=hint)]
    poses, covariance = np.full((len(tracks.frames), 2, 4, 4), np.nan), np.full((len(tracks.frames), 2, 6, 6), np.nan)
    for k in rows:
        shown = guide[int(tracks.frames[k])]
        poses[k, shown.found], covariance[k, shown.found] = shown.poses[shown.found], shown.covariance[shown.found]
    registration = registration_of(tracks.meta)
    if registration is not None:
        poses[:, 1] = poses[:, 1] @ se3_inverse(registration)
    return combine(tracks, poses, covariance, landmarks), _disagreement(tracks, poses, landmarks[:3])


def _disagreement(tracks: Tracks, poses: Array, points: Array) -> list[Finding]:
    """Return what to say if masks and colours place points of the lower teeth (N, 3) apart too often."""
    relative = np.full((len(poses), 4, 4), np.nan)
    both = np.isfinite(poses).all((1, 2, 3))
    relative[both] = relative_pose(poses[both, 0], poses[both, 1])
    away = transform_points(tracks.raw_T_upper_lower, points) - transform_points(relative, points)
    apart_mm = np.linalg.norm(away, axis=-1).mean(-1)
    bad = ~(apart_mm <= _APART_MM)  # NaN where an arch is lost
    share = float(bad.mean())
    if share <= _FEW:
        return []
    judgement = "is not usable as it is" if share > _MANY else "is doubtful in parts"
    worst = int(np.nanargmax(apart_mm)) if np.isfinite(apart_mm).any() else int(np.flatnonzero(bad)[0])
    return [
        Finding(
            "footage_doubtful",
            "warning",
            f"the footage {judgement}: in {bad.sum()} of {len(bad)} frames the jaw is lost, or masks and colours "
            f"place it more than {_APART_MM:g} mm apart; at most {_FEW:.0%} of the frames is usual",
            value=round(100 * share, 1),
            limit=100 * _FEW,
            frame=int(tracks.frames[worst]),
            hint="Look at the overlay, draw masks of some frames (`jawusd segment --keys`), or light the mouth better.",
        )
    ]
