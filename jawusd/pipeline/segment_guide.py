"""Poses tracked by colour alone: they guide the segmentation, are stored beside the masks and compared with tracks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import JawusdError
from jawusd.base.npz import read_npz, take
from jawusd.formats.atomic import write_described_npz
from jawusd.formats.capture import Capture
from jawusd.formats.finding import Finding
from jawusd.formats.tracks import Tracks
from jawusd.geometry import se3_inverse, transform_points
from jawusd.pipeline.segment_record import auto_masks_folder
from jawusd.pipeline.subject import registration_of
from jawusd.tracking.region.tracker import RegionPose
from jawusd.tracking.sequence.smoothing import combine, relative_poses

# Distance [mm] between the jaw poses from masks and from colours above which one of them must be wrong; correct poses
# of three takes differed by at most 0.9 mm. Fractions of wrong or lost frames above which a take is reported as partly
# unreliable (`_FEW`) or unusable (`_MANY`).
_APART_MM, _FEW, _MANY = 1.0, 0.03, 0.2
GUIDE, _FAMILY = "guide.npz", "jawusd-guide"


def save_guide(folder: Path, inputs: str, guide: Mapping[int, RegionPose]) -> None:
    """Write poses tracked by colour, with the hash of the inputs used; raises OutputError."""
    frames = sorted(guide)
    fields = ("poses", "found", "covariance")
    arrays = {name: np.stack([getattr(guide[frame], name) for frame in frames]) for name in fields}
    arrays["frames"] = np.array(frames)
    write_described_npz(folder / GUIDE, f"{_FAMILY}/1", arrays, {"inputs": inputs}, packed=False)


def known_guide(folder: Path, inputs: str) -> dict[int, RegionPose]:
    """Return the stored poses if their inputs are unchanged; empty if the file is missing or unreadable."""
    try:
        guide, made_from = _read(folder / GUIDE)
    except JawusdError:
        return {}
    return guide if made_from == inputs else {}


def _read(path: Path) -> tuple[dict[int, RegionPose], str]:
    """Return the stored poses and the hash of their inputs; both are empty if the file is missing."""
    if not path.exists():
        return {}, ""
    arrays, meta = read_npz(path, _FAMILY, 1)
    frames = take(arrays, "frames", (None,), path)
    poses = take(arrays, "poses", (len(frames), 2, 4, 4), path)
    found = take(arrays, "found", (len(frames), 2), path).astype(bool)
    covariance = take(arrays, "covariance", (len(frames), 2, 6, 6), path, finite=False)
    rows = zip(frames, poses, found, covariance, strict=True)
    return {int(frame): RegionPose(*row) for frame, *row in rows}, str(meta.get("inputs"))


def combine_guide(capture: Capture, tracks: Tracks, landmarks: Array) -> tuple[Tracks, list[Finding]]:
    """Combine tracks from automatic masks with the poses tracked by colour; also return findings on their agreement.

    Tracks from other masks are returned unchanged. Masks segmented around a wrong pose confirm that pose; colour edges
    have independent errors, so the wrong pose shows as a disagreement. `landmarks` (5, 3) are the lower teeth, then the
    condyles, in mandible coordinates [mm]. Raises FormatError if the file of the poses is corrupt.
    """
    folder = auto_masks_folder(capture)
    if folder is None:
        return tracks, []
    guide = _read(folder / GUIDE)[0]
    rows = [k for k, frame in enumerate(tracks.frames.tolist()) if frame in guide]
    if not rows:
        message = (
            "the colour-tracked poses of these masks are missing: masks made around wrong poses cannot be detected"
        )
        hint = "Run `jawusd segment` again, and keep its guide.npz beside the masks."
        return tracks, [Finding("footage_unchecked", "warning", message, path=str(folder / GUIDE), hint=hint)]
    count = len(tracks.frames)
    poses, covariance = np.full((count, 2, 4, 4), np.nan), np.full((count, 2, 6, 6), np.nan)
    for k in rows:
        shown = guide[int(tracks.frames[k])]
        poses[k, shown.found], covariance[k, shown.found] = shown.poses[shown.found], shown.covariance[shown.found]
    registration = registration_of(tracks.meta)
    if registration is not None:
        poses[:, 1] = poses[:, 1] @ se3_inverse(registration)
    return combine(tracks, poses, covariance, landmarks), _disagreement(tracks, poses, landmarks[:3])


def _disagreement(tracks: Tracks, poses: Array, points: Array) -> list[Finding]:
    """Return a finding if, in too many frames, masks and colours disagree on points (N, 3) of the lower teeth."""
    away = transform_points(tracks.raw_T_upper_lower, points) - transform_points(relative_poses(poses), points)
    apart_mm = np.linalg.norm(away, axis=-1).mean(-1)
    bad = ~(apart_mm <= _APART_MM)  # the distance is NaN where an arch is lost
    share = float(bad.mean())
    if share <= _FEW:
        return []
    judgement = "is unusable" if share > _MANY else "is partly unreliable"
    worst = int(np.nanargmax(apart_mm)) if np.isfinite(apart_mm).any() else int(np.flatnonzero(bad)[0])
    return [
        Finding(
            "footage_doubtful",
            "warning",
            f"the footage {judgement}: in {bad.sum()} of {len(bad)} frames the jaw is lost, or masks and colours "
            f"disagree on its pose by more than {_APART_MM:g} mm; at most {_FEW:.0%} of the frames is usual",
            value=round(100 * share, 1),
            limit=100 * _FEW,
            frame=int(tracks.frames[worst]),
            hint="Inspect the overlay, draw masks for some frames (`jawusd segment --keys`), or improve the lighting.",
        )
    ]
