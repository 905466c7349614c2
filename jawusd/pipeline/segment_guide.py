"""Where the teeth are in every frame by colours alone: what masks are made around."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jawusd.errors import JawusdError
from jawusd.formats.atomic import write_bytes_atomic
from jawusd.formats.capture import Capture
from jawusd.formats.finding import Finding
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import Tracks
from jawusd.geometry import Camera, relative_pose, se3_inverse, transform_points
from jawusd.geometry.arrays import Array
from jawusd.npz import TWIST_ORDER, UNITS, read_npz, take
from jawusd.pipeline.cuts import Cutter
from jawusd.pipeline.prepare import Subject, registration_of
from jawusd.pipeline.segment_record import auto_masks_folder
from jawusd.pipeline.state import Progress

if TYPE_CHECKING:
    from jawusd.segmentation.footage import ColourFootage
    from jawusd.tracking.region.tracker import RegionPose

# Distance of the jaw by masks and by colours from which one is wrong [mm]: right ones of three takes were at most 0.9
# apart. Shares of such frames, or lost ones, from which a take is doubtful, and not usable.
_APART_MM, _FEW, _MANY = 1.0, 0.03, 0.2
# Change of the jaw's motion from frame to frame [mm] after which the frames before are looked at again, and distance of
# poses that are the same. Speech and chewing reach 1 mm at 24 frames a second: needless looks end after a frame.
_JUMP_MM, _SAME_MM = 0.8, 0.15
GUIDE, _FAMILY = "guide.npz", "jawusd-guide"
STAGE = "follow"


def followed_teeth(
    footage: ColourFootage,
    cameras: Mapping[str, Camera],
    teeth: tuple[Mesh, Mesh],
    subject: Subject,
    frames: range,
    start: tuple[int, Array],
    progress: Progress,
    pool: Executor | None,
) -> dict[int, RegionPose]:
    """Follow both arches from one frame to both ends of a take, by colours alone.

    Args:
        footage, cameras: pictures, and the calibrated cameras by the same names.
        teeth: upper and lower scan.
        subject: gives axes and condyles.
        frames: of the reference camera.
        start: one of them, and T_world_upper and T_world_lower there, shape (2, 4, 4).

    Raises:
        CaptureError: a picture cannot be decoded.
        TrackingError: a scan cannot be tracked.
    """
    from jawusd.tracking.contour.scan import prepare_scan, teeth_centre
    from jawusd.tracking.region.tracker import RegionTracker

    scans = [prepare_scan(mesh, name) for mesh, name in zip(teeth, ("upper", "lower"), strict=True)]
    frame, poses = start
    centre = teeth_centre(scans, poses)
    cutter = Cutter(cameras, scans, centre)
    axes = subject.T_anatomical_skull[:3, :3]
    tracker = RegionTracker(scans, list(cameras.values()), subject.landmarks, axes, executor=pool)
    out = {frame: tracker.begin(cutter.cut(footage.at(frame)), poses)}
    progress(STAGE, 1, len(frames))

    for way in (range(frame + 1, frames.stop), range(frame - 1, frames.start - 1, -1)):
        for at, found in zip(way, tracker.follow(cutter.walk(footage, way), out[frame].poses), strict=True):
            out[at] = found
            progress(STAGE, len(out), len(frames))
        for jump in _jumps(way, out, subject.landmarks[:3]):
            back = range(jump - way.step, frame, -way.step)
            _follow_back(back, tracker.follow(cutter.walk(footage, back), out[jump].poses), out, subject.landmarks[:3])
    return out


def _places(found: RegionPose, points: Array) -> Array:
    """Return where points of the lower teeth (N, 3) are against the upper ones [mm], shape (N, 3)."""
    return transform_points(relative_pose(found.poses[0], found.poses[1]), points)


def _jumps(way: range, known: Mapping[int, RegionPose], points: Array) -> list[int]:
    """Return the frames of a way on which the jaw changes its motion more suddenly than jaws do."""
    if len(way) < 3:
        return []
    places = np.stack([_places(known[frame], points) for frame in way])
    bend_mm = np.linalg.norm(np.diff(places, 2, axis=0), axis=-1).mean(-1)
    return [way[k + 2] for k in np.flatnonzero(bend_mm > _JUMP_MM).tolist()]


def _follow_back(back: range, again: Iterator[RegionPose], known: dict[int, RegionPose], points: Array) -> None:
    """Put in poses followed the other way, as long as they differ and more contour fits them.

    A jaw that is found again has been followed wrongly before; the frames up to there look right one by one.
    """
    for frame, found in zip(back, again, strict=False):
        apart_mm = np.linalg.norm(_places(found, points) - _places(known[frame], points), axis=-1).mean()
        better = found.worth_px > known[frame].worth_px or not known[frame].found.all()
        if apart_mm < _SAME_MM or not found.found.all() or not better:
            return
        known[frame] = found


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
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    write_bytes_atomic(folder / GUIDE, buffer.getvalue())


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
    from jawusd.tracking.sequence.combined import combine

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
