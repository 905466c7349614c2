"""Read what `jawusd animate` and `jawusd retarget` take, and keep it inside the bound."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jawusd.cli.output import emit
from jawusd.errors import FormatError
from jawusd.formats.arkit import read_arkit
from jawusd.formats.keys import FARTHEST_FRAME, MOST_FRAMES, load_keys
from jawusd.formats.poses import read_parameters, read_poses, table_columns
from jawusd.geometry.arrays import Array

if TYPE_CHECKING:
    from jawusd.evaluator import JawRig

_USD = (".usd", ".usda", ".usdc", ".usdz")


@dataclass(frozen=True, eq=False)
class AuthoredMotion:
    """Hold a motion as it was read."""

    frames: Array  # frame numbers (F,), increasing
    d: Array  # parameters (F, 3) [mm], NaN in frames without parameters
    fps: float | None  # frames per second, None where the source does not say

    def __post_init__(self) -> None:
        """Refuse what cannot be written out frame by frame."""
        if not len(self.frames):
            raise FormatError("the motion has no frames.")
        first, last = self.frames[0], self.frames[-1]
        if not (last - first <= MOST_FRAMES and max(abs(first), abs(last)) <= FARTHEST_FRAME):
            raise FormatError(
                f"the motion runs from frame {first:g} to {last:g}; allowed are {MOST_FRAMES} frames within "
                f"+-{FARTHEST_FRAME:g}."
            )


def read_motion(rig: JawRig, source: Path) -> AuthoredMotion:
    """Read keys, parameters or poses. Keys are interpolated to every whole frame; poses are encoded.

    Args:
        source: keys.json, or a CSV or JSON table of d or of poses.

    Raises:
        FormatError: not such a file.
    """
    if source.suffix.lower() == ".json" and source.read_bytes().lstrip()[:1] == b"{":
        keys = load_keys(source)
        key_frames, key_d = keys.arrays()
        at = np.unique(np.concatenate([np.arange(np.ceil(key_frames[0]), np.floor(key_frames[-1]) + 1), key_frames]))
        return AuthoredMotion(at, rig.interpolate(key_frames, key_d, at, method=keys.interpolation), keys.fps)
    if "d1" in table_columns(source):
        frames, d = read_parameters(source)
    else:
        frames, T = read_poses(source)
        d, _ = rig.encode(T)
    return AuthoredMotion(frames.astype(np.float64), d, None)


def read_face(rig: JawRig, source: Path, fps: float | None) -> AuthoredMotion:
    """Read the jaw of an ARKit face capture, its weights taken as shares of the person's own ranges.

    JawOpen 1 is the full opening; JawLeft less JawRight, and JawForward, are shares of the reach to that side at that
    opening. Left is the subject's left.

    Args:
        source: CSV of Live Link Face.
        fps: rate of the time codes, None to find it from them.

    Raises:
        FormatError: not such a file, or no row with a face.
    """
    capture = read_arkit(source, fps)
    opening, left, right, forward = capture.weights.T
    d = rig.denormalized(np.stack([opening, left - right, forward], axis=1))
    if not np.isfinite(d).any():
        raise FormatError("no row has a face (BlendShapeCount is 0 in all of them).", path=source)
    return AuthoredMotion(capture.frames, d, capture.fps)


@dataclass(frozen=True)
class Changes:
    """Say what was changed in a motion."""

    figures: dict[str, float]  # counts and sizes [mm]
    lines: list[str]  # for people; the first continues the line that names the file


def emit_motion(out: Path, rate: float, motion: AuthoredMotion, changes: Changes, as_json: bool) -> None:
    """Print which motion was written, and what was changed in it."""
    first, last = float(motion.frames[0]), float(motion.frames[-1])
    head, *rest = changes.lines
    result = {"file": str(out), "fps": rate, "frames": [first, last], **changes.figures}
    emit(result, as_json, lambda: [f"{out}: frames {first:g} .. {last:g} at {rate:g} fps{head}", *rest])


def kept_inside(rig: JawRig, motion: AuthoredMotion) -> tuple[AuthoredMotion, Changes]:
    """Move parameters to the nearest valid ones where they lie outside the bound."""
    outside = np.isfinite(motion.d).all(axis=1) & ~rig.is_inside(motion.d)
    kept = motion.d.copy()
    kept[outside] = rig.project(motion.d[outside])
    moved_mm = np.linalg.norm(kept - motion.d, axis=1)[outside]
    lost, clamped = int(np.isnan(kept).any(axis=1).sum()), int(outside.sum())
    largest, mean = float(moved_mm.max(initial=0.0)), float(moved_mm.mean()) if moved_mm.size else 0.0
    lines = ["", *_lost_line(lost)]
    if clamped:
        moved = f"moved by {mean:.2f} mm on average, {largest:.2f} mm at most"
        lines.append(f"{clamped} frames lay outside the bound, {moved}")
    figures = {"lost": lost, "clamped": clamped, "largest_clamp_mm": largest, "mean_clamp_mm": mean}
    return AuthoredMotion(motion.frames, kept, motion.fps), Changes(figures, lines)


def carried_over(source_rig: Path, source: Path, target: JawRig) -> tuple[AuthoredMotion, Changes]:
    """Read a motion of one rig and carry it to another, see `pipeline.library.retarget`.

    Args:
        source: an animation layer, keys, or a table of d or of poses.

    Raises:
        FormatError: no such motion or rig.
        EvaluatorError: no frame of the motion has parameters.
    """
    from jawusd.pipeline.library import load_any_rig, retarget

    rig = load_any_rig(source_rig)
    motion = _motion_of(rig, source)
    carried = retarget(rig, target, motion.frames, motion.d)
    known = np.isfinite(carried.d).all(axis=1)
    samples, lost = int(known.size), int((~known).sum())
    valid, clamped = int(target.validate_parameters(carried.d[known]).valid.sum()), int(carried.outside.sum())
    mean, largest = float(carried.moved_mm[known].mean()), float(carried.moved_mm[known].max())
    lines = [f", {valid} of {samples - lost} samples valid", *_lost_line(lost)]
    if clamped:
        lines.append(f"{clamped} samples lay outside the bound at equal shares of the ranges")
    if largest > 0.005:
        moved = f"{mean:.2f} mm on average, {largest:.2f} mm at most"
        lines.append(f"moved from equal shares by {moved}, to turn where the source turns and stay inside")
    figures = {"samples": samples, "lost": lost, "valid": valid, "clamped": clamped}
    sizes = {"mean_move_mm": mean, "largest_move_mm": largest}
    return AuthoredMotion(carried.frames, carried.d, motion.fps), Changes({**figures, **sizes}, lines)


def _lost_line(lost: int) -> list[str]:
    return [f"{lost} frames say nothing and were bridged"] if lost else []


def _motion_of(rig: JawRig, path: Path) -> AuthoredMotion:
    """Return a motion of a rig: samples of d of a stage, its transforms where it has none, or a table."""
    from jawusd.rig.motion_read import read_parameters_of_stage, read_poses_of_stage
    from jawusd.rig.read import open_stage

    if path.suffix.lower() not in _USD:
        return read_motion(rig, path)
    sampled = read_parameters_of_stage(path)
    if sampled is not None:
        return AuthoredMotion(*sampled)
    frames, poses = read_poses_of_stage(path)
    rate = float(open_stage(path).GetTimeCodesPerSecond())
    return AuthoredMotion(frames.astype(np.float64), rig.encode(poses)[0], rate)
