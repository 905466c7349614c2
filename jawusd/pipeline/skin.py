"""Learn jaw motion from facial skin: read the face and jaw recordings of one performance, and align their clocks."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import AnyPath, FormatError, errors_name_file, naming_file
from jawusd.base.tables import read_table
from jawusd.evaluator import JawRig
from jawusd.evaluator.skin import Skin, load_skin
from jawusd.fitting.face import check_jaw_weights, columns_at
from jawusd.fitting.skin import HEAD_ERROR, clock_offset, fit_skin
from jawusd.formats.arkit import read_blend_shapes
from jawusd.formats.face_table import FaceTable, header_of, is_face_table, read_face_table
from jawusd.formats.markers import read_markers
from jawusd.formats.performance import SolveState
from jawusd.formats.poses import read_poses_or_parameters
from jawusd.formats.tracks import Tracks, load_tracks
from jawusd.pipeline.markers import LENGTH_UNITS_MM, in_head, read_c3d

SIGMA_MM = 0.15  # standard deviation of d, if the file does not state it
_LISTED = 8  # number of missing columns that a message names
_LARGEST_SIGMA_MM = 1.0  # standard deviation at the incisal point above which a pose does not count as seen


@dataclass(frozen=True)
class SkinOptions:
    """Facial-skin inputs of `solve`."""

    skin: AnyPath  # the map from skin to d, written by `jawusd skin-fit`
    face: AnyPath  # facial motion during the shot; it has the columns from which the map was learned
    fps: float | None = None  # frame rate of the face data [1/s], if the file does not state it
    offset_s: float | None = None  # seconds from frame 0 of the shot to frame 0 of the face data; None: estimated
    unit: str = "mm"  # see `read_face`
    rigid: Mapping[str, str] | None = None  # see `read_face`
    rest_frame: int | None = None  # see `read_face`
    only: bool = False  # whether to ignore the images of the shot


@dataclass(frozen=True, eq=False)
class JawTake:
    """The jaw motion of a take, and the frames in which the teeth were visible."""

    frames: Array  # frame numbers, increasing, shape (F,)
    d: Array  # jaw parameters [mm], shape (F, 3)
    seen: Mask  # whether d was measured rather than interpolated, shape (F,)
    sigma_mm: Array  # standard deviation of d [mm], shape (F, 3)
    fps: float | None  # frame rate [1/s]; None if unknown

    def with_bite(self, first: int, last: int) -> JawTake:
        """Return the take with d = 0 in the frames `first` to `last`, in which the teeth are in occlusion."""
        bite = np.arange(first, last + 1, dtype=np.float64)
        kept = (self.frames < first) | (self.frames > last)
        frames = np.concatenate([self.frames[kept], bite])
        order = np.argsort(frames)
        zero = np.zeros((len(bite), 3))
        return JawTake(
            frames[order],
            np.concatenate([self.d[kept], zero])[order],
            np.concatenate([self.seen[kept], np.ones(len(bite), bool)])[order],
            np.concatenate([self.sigma_mm[kept], zero + SIGMA_MM])[order],
            self.fps,
        )


def read_jaw(rig: JawRig, path: AnyPath) -> JawTake:
    """Read the jaw motion of a take from tracks.npz, the CSV of a solved performance, or a table of d or poses.

    In tracks, frames count as seen if both arches were tracked without a prior; in a performance, if they are solved;
    in a table, always. Raises FormatError if the file is none of these.
    """
    path = Path(path)
    if path.suffix == ".npz":
        return _of_tracks(rig, load_tracks(path))
    frames, d = read_poses_or_parameters(path)
    if d.ndim > 2:
        d = rig.encode(d).d
    seen = np.asarray(np.isfinite(d).all(axis=1))
    sigma = np.full(d.shape, SIGMA_MM)
    if path.suffix.lower() != ".json" and "state" in header_of(path):
        solved, sigma = _states_of(path)
        seen &= solved
    return JawTake(frames.astype(np.float64), d, seen, sigma, None)


@errors_name_file
def _states_of(path: Path) -> tuple[Mask, Array]:
    """Return which frames in the CSV of a performance are solved (F,), and the standard deviations of d [mm] (F, 3)."""
    table = read_table(path, os.stat(path).st_size)
    column = table.header.index("state")
    solved = np.array([row[column].strip() == str(SolveState.SOLVED) for row in table.rows])
    return solved, table.numbers([table.header.index(f"sigma{i}") for i in (1, 2, 3)])


def _of_tracks(rig: JawRig, tracks: Tracks) -> JawTake:
    frames, fps = tracks.frames.astype(np.float64), tracks.meta.get("fps")
    if tracks.solved is not None:
        solved = tracks.solved
        return JawTake(frames, solved.d, solved.state == SolveState.SOLVED, solved.sigma_mm, fps)
    d, sigma = np.full((len(frames), 3), np.nan), np.full((len(frames), 3), np.nan)
    known = tracks.tracked() & np.isfinite(tracks.covariance_relative).all(axis=(1, 2)) & ~tracks.prior_aided
    found = rig.encode(tracks.T_upper_lower[known], covariance=tracks.covariance_relative[known])
    d[known], sigma[known] = found.d, np.sqrt(np.einsum("fii->fi", found.covariance))
    seen = known & (tracks.sigma_mm[:, 0] < _LARGEST_SIGMA_MM)
    return JawTake(frames, d, seen, sigma, fps)


def load_own_skin(rig: JawRig, path: AnyPath) -> Skin:
    """Read a map from skin to d; raises FormatError if it is invalid or was not learned with this rig."""
    skin = load_skin(path)
    if skin.actor != rig.actor:
        raise FormatError(
            f'was learned from the skin of "{skin.actor}", but the rig is of "{rig.actor}"; parameters differ between '
            "subjects.",
            path=path,
            hint="Use that subject's rig, or learn a map with this rig: `jawusd skin-fit`.",
        )
    return skin


def own_columns(skin: Skin, map_path: AnyPath, face: FaceTable, path: AnyPath) -> Array:
    """Return the columns (F, K) or points (F, N, 3) from which a map was learned, found in face data by name.

    The data may have more columns or points; the files of both are named in messages. Raises FormatError if a column or
    point is missing, or if the data have points and the map columns, or conversely.
    """
    place = {name.lower(): k for k, name in enumerate(face.names)}
    names = [name.lower() for name in skin.names or face.names]
    missing = [name for name in skin.names if name.lower() not in place]
    if not missing and (face.X.ndim == 3) == skin.points:
        found = face.X[:, [place[name] for name in names]] if names else face.X
        if found[:1].size == len(found[:1]) * skin.columns:
            return found
    kinds = ["columns", "coordinates of points"]
    lacking = f"; missing: {', '.join(missing[:_LISTED])}" if missing else ""
    raise FormatError(
        f"has {face.X[:1].size} {kinds[face.X.ndim == 3]}; {os.fspath(map_path)} was learned from {skin.columns} "
        f"{kinds[skin.points]}, which are needed under the same names{lacking}.",
        path=path,
        hint="Learn the map again from the points of this file with `jawusd skin-fit`.",
    )


def read_face(
    path: AnyPath,
    fps: float | None = None,
    unit: str = "mm",
    rigid: Mapping[str, str] | None = None,
    rest_frame: int | None = None,
) -> FaceTable:
    """Read facial motion from C3D, a marker table, a CSV of Live Link Face, or a face table; points are in mm.

    Args:
        path: see `formats.markers`, `formats.arkit` and `formats.face_table`.
        fps, unit: frame rate [1/s] and unit of the points, if the file does not state them.
        rigid: the rigid body "head", formed by markers on the head (see `formats.markers`); points are then
            returned relative to it. Default: the head does not move, or the points are stabilised.
        rest_frame: frame that defines the marker positions on the head, if only the names of its markers are given.

    Raises:
        FormatError: the file is none of these, or the head cannot be found.
    """
    path = Path(path)
    marked = path.suffix.lower() in (".c3d", ".trc") or not path.is_file()
    header = [] if marked else header_of(path)
    if "timecode" in header:
        face = read_blend_shapes(path, fps)
    elif is_face_table(header):
        face = read_face_table(path)
        face = replace(face, fps=face.fps or fps)
    else:
        table = read_c3d(path) if path.suffix.lower() == ".c3d" else read_markers(path)
        frames = np.arange(len(table.points), dtype=np.float64)
        face = FaceTable(frames, table.points, table.names, table.fps or fps, table.unit)
    if face.X.ndim == 2:
        if rigid:
            raise FormatError("has no points; --rigid applies to points only.", path=path)
        return face
    points = face.X * LENGTH_UNITS_MM[face.unit or unit]
    if rigid:
        with naming_file(path):
            points = in_head(points, face.names, rigid, rest_frame, unit)
    return FaceTable(face.frames, points, face.names, face.fps, "mm")


def read_shot_face(skin: Skin, options: SkinOptions) -> tuple[Array, Array]:
    """Return the times (F,) [s] of the face data of a shot, and the columns (F, K) from which a map was learned.

    Raises FormatError if the file is invalid, or lacks a frame rate or columns of the map.
    """
    face = read_face(options.face, options.fps, options.unit, options.rigid, options.rest_frame)
    columns = own_columns(skin, options.skin, face, options.face)
    if not face.fps:
        raise FormatError("does not state its frame rate.", path=options.face, hint="Give it with --face-fps.")
    return face.frames / face.fps, columns.reshape(len(columns), -1)


def learn_skin(
    rig: JawRig,
    jaw: JawTake,
    face: FaceTable,
    offset_s: float | None = None,
    head_error: tuple[float, float] = HEAD_ERROR,
    *,
    jaw_weights: bool = False,
) -> tuple[Skin, float]:
    """Return a map from facial motion to d and the offset of the clocks [s], learned from one performance.

    Args:
        jaw, face: recordings of the performance, with frame rates.
        offset_s: seconds to add to times of `face` to obtain times of `jaw`; default: estimated.
        jaw_weights: whether the face has only the four ARKit jaw weights, which are then checked to suffice.

    Raises:
        FittingError: see `fitting.skin.clock_offset`, `fitting.skin.fit_skin` and `fitting.face.check_jaw_weights`.
        ValueError: a frame rate is missing.
    """
    if not jaw.fps or not face.fps:
        raise ValueError("jaw and face need a frame rate")
    face_s, times_s, flat = face.frames / face.fps, jaw.frames / jaw.fps, face.X.reshape(len(face.X), -1)
    if offset_s is None:
        offset_s = clock_offset(face_s, flat, times_s[jaw.seen], jaw.d[jaw.seen])
    X = columns_at(face_s + offset_s, flat, times_s).reshape(len(times_s), *face.X.shape[1:])
    skin = fit_skin(rig, X, jaw.d, jaw.seen, jaw.sigma_mm, head_error=head_error, names=face.names)
    if jaw_weights:
        check_jaw_weights(rig, X[jaw.seen], jaw.d[jaw.seen], skin.errors_mm["skin"])
    return skin, offset_s
