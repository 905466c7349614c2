"""Read, resample and clamp the motions of `jawusd animate` and `jawusd retarget`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import FormatError, naming_file
from jawusd.base.inputs import check_input
from jawusd.cli import options
from jawusd.cli.output import emit
from jawusd.evaluator.authoring import smooth_tangents
from jawusd.evaluator.clamping import Inside
from jawusd.evaluator.curves import HermiteCurve
from jawusd.formats.keys import FARTHEST_FRAME, FARTHEST_MM, MOST_FRAMES, Key, Keys, load_keys
from jawusd.formats.poses import read_poses, read_poses_or_parameters
from jawusd.formats.tracks import load_tracks

if TYPE_CHECKING:
    from jawusd.evaluator import JawRig


_MOVED_MM = 1e-6
_FINE = 10  # number of samples per frame at which curves are checked against the bound
_OFF_CURVE_MM, _MOST_HALVINGS = 0.003, 4  # tolerance of a polyline, and maximum number of refinements


@dataclass(frozen=True, eq=False)
class AuthoredMotion:
    """A jaw motion as read from its source file."""

    frames: Array  # frame numbers (F,), increasing
    d: Array  # jaw parameters (F, 3) [mm], NaN in frames without parameters
    fps: float | None  # frame rate [1/s], None if the source does not state it
    keys: Keys | None = None  # keys between which the motion was interpolated

    def __post_init__(self) -> None:
        if not len(self.frames):
            raise FormatError("the motion has no frames.")
        falls = np.flatnonzero(np.diff(self.frames) <= 0)
        if falls.size:
            before, after = self.frames[falls[0] : falls[0] + 2]
            raise FormatError(f"frames must increase: frame {after:g} follows {before:g}.")
        if (np.abs(self.d) > FARTHEST_MM).any():
            raise FormatError(f"a parameter is {np.nanmax(np.abs(self.d)):g} mm; the limit is +-{FARTHEST_MM:g} mm.")
        first, last = self.frames[0], self.frames[-1]
        if not (last - first <= MOST_FRAMES and max(abs(first), abs(last)) <= FARTHEST_FRAME):
            raise FormatError(
                f"the motion runs from frame {first:g} to {last:g}; at most {MOST_FRAMES} frames are allowed, "
                f"with numbers from -{FARTHEST_FRAME:g} to {FARTHEST_FRAME:g}."
            )


def read_motion(rig: JawRig, source: Path) -> AuthoredMotion:
    """Read key frames, interpolated at every whole frame, or a table of d or of poses, which are encoded as d."""
    with naming_file(source):
        check_input(source)
        if source.suffix.lower() == ".npz":
            raise FormatError(
                "is an npz file; expected key frames, or a table of d values or poses.",
                hint="`jawusd encode` writes the d values of tracks as a table.",
            )
        if source.suffix.lower() == ".json" and source.is_file() and source.read_bytes().lstrip()[:1] == b"{":
            keys = load_keys(source)
            key_frames, _ = keys.arrays()
            at = np.union1d(np.arange(np.ceil(key_frames[0]), np.floor(key_frames[-1]) + 1), key_frames)
            d = curve_at(rig, keys, at)
            return AuthoredMotion(at, d, keys.fps, keys)
        frames, d = read_poses_or_parameters(source)
        if d.ndim > 2:
            d, _ = rig.encode(d)
        return AuthoredMotion(frames.astype(np.float64), d, None)


def curve_at(rig: JawRig, keys: Keys, at: Array) -> Array:
    """Return d (n, 3) [mm] of the curve through keys at frames (n,), which may leave the bound."""
    return rig.interpolate(*keys.arrays(), at, keys.interpolation, inside=False, tangents=keys.tangents())


def _retimed(key: Key, ratio: float) -> Key:
    """Return a key with its frame multiplied by a ratio, and its slopes per frame divided by it."""
    slopes = key.tangents and tuple(None if slope is None else slope / ratio for slope in key.tangents)
    return key.model_copy(update={"frame": key.frame * ratio, "tangents": slopes})


def read_pose_table(path: Path) -> tuple[NDArray[np.int64], Array]:
    """Return the frame numbers (F,) and poses (F, 4, 4) of a table or of tracks."""
    if path.suffix == ".npz":
        tracks = load_tracks(path)
        return tracks.frames, tracks.T_upper_lower
    return read_poses(path)


@dataclass(frozen=True)
class Changes:
    """Summary of the changes made to a motion."""

    figures: dict[str, float]  # for JSON: numbers of frames, and distances [mm]
    lines: list[str]  # the changes as text; the first line is appended to the line with the file name


def emit_motion(out: Path, rate: float, motion: AuthoredMotion, changes: Changes, as_json: bool) -> None:
    """Print the file written, its frames, and the changes made to the motion."""
    first, last = float(motion.frames[0]), float(motion.frames[-1])
    head, *rest = changes.lines
    result = {"file": str(out), "fps": rate, "frames": [first, last], **changes.figures}
    emit(result, as_json, [f"{out}: frames {first:g} .. {last:g} at {rate:g} fps{head}", *rest])


def kept_inside(rig: JawRig, motion: AuthoredMotion) -> tuple[AuthoredMotion, Changes]:
    """Project a motion into the bound (see `JawRig.keep_inside`); frames without parameters are kept.

    In a smooth motion, only the keys are projected if that suffices, so that curves still connect them.
    """
    known = np.isfinite(motion.d).all(axis=1)
    lost = int((~known).sum())
    lines = ["", *_lost_line(lost)]
    if not known.any():
        return motion, Changes({"lost": lost}, lines)
    wanted = motion.d[known]
    keys = _valid_keys(rig, motion)
    if keys is None:
        keys = motion.keys
        inside = rig.keep_inside(motion.frames[known], wanted)
    else:
        curve = curve_at(rig, keys, motion.frames)
        inside = Inside(motion.frames, curve, np.ones(len(curve), dtype=bool))
    moved_mm = np.linalg.norm(inside.d[inside.given] - wanted, axis=1)
    outside = ~rig.is_inside(wanted)
    beside = ~outside & (moved_mm > _MOVED_MM)
    clamped, largest = int(outside.sum()), float(moved_mm.max())
    mean = float(moved_mm[outside].mean()) if clamped else 0.0
    if clamped:
        moved = f"moved by {mean:.2f} mm on average, {float(moved_mm[outside].max()):.2f} mm at most"
        lines.append(f"{clamped} frames lay outside the bound, {moved}")
    if beside.any():
        moved = f"moved by {float(moved_mm[beside].max()):.2f} mm at most"
        why = "to stay inside between samples" if keys is motion.keys else "with their keys"
        lines.append(f"{int(beside.sum())} frames next to them {moved}, {why}")
    figures = {"lost": lost, "clamped": clamped, "largest_clamp_mm": largest, "mean_clamp_mm": mean}
    figures |= {"moved_beside": int(beside.sum())}
    frames = np.union1d(inside.times, motion.frames)
    d = np.full((len(frames), 3), np.nan)
    d[np.searchsorted(frames, inside.times)] = inside.d
    return AuthoredMotion(frames, d, motion.fps, keys), Changes(figures, lines)


def _valid_keys(rig: JawRig, motion: AuthoredMotion) -> Keys | None:
    """Return the keys of a smooth motion, projected into the bound; None if the curves through them leave the bound."""
    if motion.keys is None or motion.keys.interpolation != "smooth":
        return None
    frames, d = motion.keys.arrays()
    inside = rig.keep_inside(frames, d)
    d = inside.d[inside.given]
    fine = np.linspace(frames[0], frames[-1], int(_FINE * (frames[-1] - frames[0])) + 1)
    keys = tuple(
        Key(frame=key.frame, d=tuple(row), tangents=key.tangents)
        for key, row in zip(motion.keys.keys, d.tolist(), strict=True)
    )
    valid = motion.keys.model_copy(update={"keys": keys})
    return valid if rig.is_inside(curve_at(rig, valid, fine)).all() else None


class Knots(NamedTuple):
    """Knots of a spline: keys where possible, samples elsewhere."""

    frames: Array  # frame numbers, shape (K,)
    d: Array  # jaw parameters [mm], shape (K, 3)
    slopes: Array  # tangents [mm per frame], shape (K, 3)
    curved: Mask  # which segments are cubic, shape (K - 1,)


def knots_of(rig: JawRig, motion: AuthoredMotion) -> Knots:
    """Return the keys of a motion with their tangents, plus all samples of segments that the bound changed."""
    known = np.isfinite(motion.d).all(axis=1)
    frames, d = motion.frames[known], motion.d[known]
    if motion.keys is None:
        return Knots(frames, d, np.zeros_like(d), np.zeros(max(len(d) - 1, 0), dtype=bool))
    key_frames, key_d = motion.keys.arrays()
    smooth = motion.keys.interpolation == "smooth"
    slopes = smooth_tangents(key_frames, key_d, motion.keys.tangents()) if smooth else np.zeros_like(key_d)
    keep, tangents = np.isin(frames, key_frames), np.zeros_like(d)
    tangents[keep] = slopes
    own = np.abs(curve_at(rig, motion.keys, frames) - d) <= _MOVED_MM
    places = np.flatnonzero(keep)
    cubic = np.zeros(len(d), dtype=bool)
    for start, end in zip(places, places[1:]):
        between = np.linspace(frames[start], frames[end], 10 * int(frames[end] - frames[start] + 1))
        curve = curve_at(rig, motion.keys, between)
        if own[start : end + 1].all() and rig.is_inside(curve).all():
            cubic[start] = smooth
        else:
            keep[start : end + 1] = True
    return Knots(frames[keep], d[keep], tangents[keep], cubic[keep][:-1])


def follow_curves(rig: JawRig, motion: AuthoredMotion, knots: Knots) -> AuthoredMotion:
    """Return the motion, with samples added where linear interpolation deviates from the curves through its keys."""
    if motion.keys is None or not knots.curved.any():
        return motion
    frames, d = motion.frames, motion.d
    for _ in range(_MOST_HALVINGS):
        middle = 0.5 * (frames[1:] + frames[:-1])
        piece = np.clip(np.searchsorted(knots.frames, middle) - 1, 0, len(knots.curved) - 1)
        curve = curve_at(rig, motion.keys, middle)
        off = np.linalg.norm(curve - 0.5 * (d[1:] + d[:-1]), axis=1) > _OFF_CURVE_MM
        where = np.flatnonzero(off & knots.curved[piece]) + 1
        frames, d = np.insert(frames, where, middle[where - 1]), np.insert(d, where, curve[where - 1], axis=0)
    return AuthoredMotion(frames, d, motion.fps, motion.keys)


def carried_over(
    source_rig: Path, source: Path, target: JawRig, prim: str | None = None
) -> tuple[AuthoredMotion, Changes]:
    """Read a motion of one rig and retarget it to another; see `pipeline.library.retarget`, also for errors."""
    from jawusd.pipeline.library import load_any_rig, retarget

    rig = load_any_rig(source_rig)
    motion = _motion_of(rig, source, prim)
    carried = retarget(rig, target, motion.frames, motion.d)
    known = np.isfinite(carried.d).all(axis=1)
    samples, lost = int(known.size), int((~known).sum())
    valid, clamped = int(target.validate_parameters(carried.d[known]).valid.sum()), int(carried.outside.sum())
    mean, largest = float(carried.moved_mm[known].mean()), float(carried.moved_mm[known].max())
    lines = [f", {valid} of {samples - lost} samples valid", *_lost_line(lost)]
    if clamped:
        lines.append(f"{clamped} samples lay outside the bound at equal fractions of the ranges")
    if largest > 0.005:
        moved = f"{mean:.2f} mm on average, {largest:.2f} mm at most"
        lines.append(f"moved from equal fractions by {moved}, to keep the timing of the source and stay inside")
    figures = {"samples": samples, "lost": lost, "valid": valid, "clamped": clamped}
    sizes = {"mean_move_mm": mean, "largest_move_mm": largest}
    return AuthoredMotion(carried.frames, carried.d, motion.fps), Changes({**figures, **sizes}, lines)


def _lost_line(lost: int) -> list[str]:
    return [f"{lost} frames without parameters were interpolated"] if lost else []


def _motion_of(rig: JawRig, path: Path, prim: str | None) -> AuthoredMotion:
    """Return the motion of a rig in a stage, from d or, if d is missing, from transforms; or the motion in a table."""
    from jawusd.rig.motion_read import read_parameters_of_stage, read_poses_of_stage
    from jawusd.rig.read import open_stage

    if path.suffix.lower() not in options.USD_SUFFIXES:
        return read_motion(rig, path)
    sampled = read_parameters_of_stage(path, prim)
    if sampled is not None:
        return AuthoredMotion(*sampled)
    frames, poses = read_poses_of_stage(path, prim)
    rate = float(open_stage(path).GetTimeCodesPerSecond())
    return AuthoredMotion(frames.astype(np.float64), rig.encode(poses)[0], rate)


def resampled(rig: JawRig, motion: AuthoredMotion, source_fps: float, fps: float) -> AuthoredMotion:
    """Resample a motion at the whole frames of a different frame rate [1/s]; frame 0 stays frame 0.

    Samples are interpolated by cubics with finite-difference slopes; keys are shifted in time and keep their curves.
    A frame is lost if the nearest sample is lost.
    """
    ratio = fps / source_fps
    times = motion.frames * ratio
    at = np.arange(np.ceil(times[0] - 1e-6), np.floor(times[-1] + 1e-6) + 1)
    if not len(at):
        at = np.round(times[:1])
    if motion.keys is not None:
        keys = tuple(_retimed(key, ratio) for key in motion.keys.keys)
        moved = motion.keys.model_copy(update={"keys": keys, "fps": fps})
        at = np.union1d(at, [key.frame for key in keys])
        d = curve_at(rig, moved, at)
        return AuthoredMotion(at, d, fps, moved)
    known = np.asarray(np.isfinite(motion.d).all(axis=1))
    seen, values = times[known], motion.d[known]
    if len(seen) < 3:
        d = np.stack([np.interp(at, seen, column) for column in values.T], axis=1)
    else:
        d = HermiteCurve(seen, values, np.gradient(values, seen, axis=0)).value(np.clip(at, seen[0], seen[-1]))
    after = np.clip(np.searchsorted(times, at), 1, max(len(times) - 1, 1))
    nearest = np.where(at - times[after - 1] <= times[after] - at, after - 1, after) if len(times) > 1 else 0 * after
    d[~known[nearest]] = np.nan
    return AuthoredMotion(at, d, fps)
