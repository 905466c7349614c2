"""Where the teeth are in every frame by colours alone: what masks are made around."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping, Sequence
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
from jawusd.geometry import Camera, relative_pose, transform_points
from jawusd.geometry.arrays import Array
from jawusd.npz import TWIST_ORDER, UNITS, read_npz, take
from jawusd.pipeline.prepare import Subject
from jawusd.pipeline.segment_record import auto_masks_folder
from jawusd.pipeline.state import Progress

if TYPE_CHECKING:
    from jawusd.segmentation.footage import ColourFootage, Pictures
    from jawusd.segmentation.picture import PictureFrame
    from jawusd.tracking.contour.scan import Scan
    from jawusd.tracking.region.tracker import Cut, Picture, RegionPose

# Distance of the jaw by masks and by colours from which one is wrong [mm]: right ones of three takes were at most 0.9
# apart. Shares of such frames, or lost ones, from which a take is doubtful, and not usable.
_APART_MM, _FEW, _MANY = 1.0, 0.03, 0.2
GUIDE, _FAMILY = "guide.npz", "jawusd-guide"
STAGE = "follow"
_WORKING_PX_PER_MM, _MARGIN_MM = 7.2, 6.0  # resolution at the teeth, and what is looked at around them


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
    from jawusd.segmentation.picture import PictureFrame
    from jawusd.tracking.contour.scan import prepare_scan, teeth_centre
    from jawusd.tracking.region.tracker import RegionPose, RegionTracker

    scans = [prepare_scan(mesh, name) for mesh, name in zip(teeth, ("upper", "lower"), strict=True)]
    frame, poses = start
    centre = teeth_centre(scans, poses)
    views = {name: PictureFrame(camera, centre, _WORKING_PX_PER_MM) for name, camera in cameras.items()}
    axes, condyles = subject.T_anatomical_skull[:3, :3], subject.landmarks[-2:]
    tracker = RegionTracker(scans, list(cameras.values()), condyles, axes, executor=pool)
    poses = tracker.begin(_cut(views, scans, footage.at(frame)), poses)
    out = {frame: RegionPose(poses, np.ones(2, bool))}
    progress(STAGE, 1, len(frames))
    for way in (range(frame + 1, frames.stop), range(frame - 1, frames.start - 1, -1)):
        cuts: Iterator[Cut] = (_cut(views, scans, pictures) for _, pictures in footage.walk(way))
        for at, found in zip(way, tracker.follow(cuts, poses), strict=True):
            out[at] = found
            progress(STAGE, len(out), len(frames))
    return out


def _cut(views: Mapping[str, PictureFrame], scans: Sequence[Scan], pictures: Pictures) -> Cut:
    from jawusd.tracking.region.tracker import Picture

    def one(name: str, around: Array) -> Picture | None:
        image = pictures[name]
        window = None if image is None else views[name].window(image, around, _MARGIN_MM)
        return None if window is None else Picture(window.camera, window.rgb)

    def cut(poses: Array) -> list[Picture | None]:
        around = np.concatenate([transform_points(T, scan.probes) for T, scan in zip(poses, scans, strict=True)])
        return [one(name, around) for name in views]

    return cut


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
    }
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    write_bytes_atomic(folder / GUIDE, buffer.getvalue())


def known_guide(folder: Path, inputs: str) -> dict[int, RegionPose]:
    """Return what was followed from the same inputs; nothing if there is none, or it cannot be read."""
    guide, made_from = _read(folder / GUIDE)
    return guide if made_from == inputs else {}


def _read(path: Path) -> tuple[dict[int, RegionPose], str]:
    """Return a guide and the hash of what it was made from; nothing if it is missing or damaged."""
    from jawusd.tracking.region.tracker import RegionPose

    if not path.exists():
        return {}, ""
    try:
        arrays, meta = read_npz(path, _FAMILY, 1)
        frames = take(arrays, "frames", (None,), path)
        poses = take(arrays, "poses", (len(frames), 2, 4, 4), path)
        found = take(arrays, "found", (len(frames), 2), path).astype(bool)
    except JawusdError:
        return {}, ""
    rows = zip(frames, poses, found, strict=True)
    return {int(frame): RegionPose(each, seen) for frame, each, seen in rows}, str(meta.get("inputs"))


def guide_findings(capture: Capture, tracks: Tracks, points: Array) -> list[Finding]:
    """Compare tracks of masks that jawusd made with where colours alone showed the jaw; nothing for other masks.

    Kind: "footage_doubtful" [%], for frames that are lost or in which both differ by more than a millimetre. Masks made
    around a wrong pose confirm it, and borders of colours err otherwise than masks do, so that both seldom agree on it.

    Args:
        points: of the lower teeth, scan coordinates [mm], shape (N, 3).
    """
    folder = auto_masks_folder(capture)
    guide = _read(folder / GUIDE)[0] if folder is not None else {}
    rows = [k for k, frame in enumerate(tracks.frames.tolist()) if frame in guide]
    if not rows:
        return []
    shown = np.stack([guide[int(tracks.frames[k])].poses for k in rows])
    colours = transform_points(relative_pose(shown[:, 0], shown[:, 1]), points)
    apart_mm = np.linalg.norm(transform_points(tracks.raw_T_upper_lower[rows], points) - colours, axis=-1).mean(-1)
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
            f"the footage {judgement}: in {bad.sum()} of {len(rows)} frames the jaw is lost, or masks and colours "
            f"place it more than {_APART_MM:g} mm apart; at most {_FEW:.0%} of the frames is usual",
            value=round(100 * share, 1),
            limit=100 * _FEW,
            frame=int(tracks.frames[rows[worst]]),
            hint="Look at the overlay, draw masks of some frames (`jawusd segment --keys`), or light the mouth better.",
        )
    ]
