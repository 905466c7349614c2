"""Jaw motion of a shot from facial skin: read the face data, check that they fit rig and shot, align the clocks."""

from __future__ import annotations

import os
from math import ceil, floor

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import FittingError, FormatError
from jawusd.evaluator import JawRig
from jawusd.evaluator.skin import SkinJaw
from jawusd.fitting.face import columns_at
from jawusd.fitting.skin import clock_offset
from jawusd.pipeline.skin import load_own_skin, own_columns, read_face
from jawusd.pipeline.solve_videos import SkinOptions

# Minimum number of frames with visible teeth for comparison with the skin; standard deviation that is added to that of
# the skin [mm], since d of the first pass is not exact either; and maximum mean squared difference of d over the
# resulting variance. See docs/explanation/constants.md.
_COMPARED, _FIRST_PASS_MM, _MOST_APART = 20, 0.5, 4.0


class SkinOfShot:
    """Jaw parameters of a shot, estimated from facial skin; a function object for the solver.

    Attributes:
        offset_s: seconds from frame 0 of the shot to frame 0 of the face data; None until it is estimated.
        unfamiliar: frames of the last call in which the face does not resemble those from which the map was learned.
    """

    def __init__(self, rig: JawRig, options: SkinOptions, fps: float) -> None:
        """Read the map and the face data; `fps` is the frame rate of the shot [1/s].

        Raises:
            FormatError: a file is invalid, the map belongs to another subject, or the face data have no frame rate or
                other columns than the map.
        """
        self._skin = load_own_skin(rig, options.skin)
        face = read_face(options.face, options.fps, options.unit, options.rigid, options.rest_frame)
        columns = own_columns(self._skin, options.skin, face, options.face)
        if not face.fps:
            raise FormatError("does not state its frame rate.", path=options.face, hint="Give it with --face-fps.")
        self._rig, self._fps, self._face = rig, fps, options.face
        self._face_s, self._columns = face.frames / face.fps, columns.reshape(len(columns), -1)
        self.offset_s, self.unfamiliar = options.offset_s, np.zeros(0, np.int64)

    def frames(self) -> range:
        """Return the frames of the shot that the face data cover.

        Raises:
            FittingError: the offset between the clocks is unknown.
        """
        first, last = (self._face_s[[0, -1]] + self._known_offset()) * self._fps
        return range(max(ceil(first), 0), max(floor(last) + 1, 0))

    def __call__(self, frames: Array, d: Array, seen: Mask, heads: Array | None = None) -> SkinJaw:
        """Return the jaw parameters estimated from skin in some frames.

        Args:
            frames: frame numbers of the shot, shape (F,).
            d: jaw parameters [mm], shape (F, 3).
            seen: frames in which d was measured, shape (F,).
            heads: not used, since the face is relative to the head.

        Raises:
            FittingError: the offset between the clocks is unknown and cannot be estimated, no frame has a familiar
                face, or skin and teeth disagree.
        """
        times = frames / self._fps
        if self.offset_s is None and seen.any():
            self.offset_s = clock_offset(self._face_s, self._skin(self._columns).d, times[seen], d[seen])
        found = self._skin(columns_at(self._face_s + self._known_offset(), self._columns, times))
        if not found.familiar.any():
            raise FittingError(
                f"{os.fspath(self._face)}: the face resembles those from which the map was learned in none of the "
                f"{len(frames)} frames.",
                hint="Check that face and map have the same unit (--length-unit), that points are relative to the same "
                "head (--rigid), and the offset of the clocks (--offset).",
            )
        self.unfamiliar = frames[np.isfinite(found.d).all(axis=1) & ~found.familiar].astype(np.int64)
        rows = seen & found.familiar
        if rows.sum() >= _COMPARED:
            check_agreement(self._face, SkinJaw(found.d[rows], found.covariance[rows], rows[rows]), d[rows])
        return found

    def _known_offset(self) -> float:
        if self.offset_s is None:
            raise FittingError(
                "the offset between face and shot is unknown: it can only be estimated if teeth are visible.",
                hint="Give the seconds from frame 0 of the shot to frame 0 of the face with --offset.",
            )
        return self.offset_s


def check_agreement(face: str | os.PathLike[str], found: SkinJaw, d: Array) -> None:
    """Check that d of the skin agrees with d of visible teeth.

    Args:
        face: the file of the face, for messages.
        found: jaw of the skin in frames with visible teeth and a familiar face.
        d: jaw parameters measured from the teeth in these frames [mm], shape (F, 3).

    Raises:
        FittingError: they differ by much more than their expected error.
    """
    away = found.d - d
    variance = np.einsum("fii->fi", found.covariance) + _FIRST_PASS_MM**2
    apart = float((away**2 / variance).mean())
    if apart > _MOST_APART:
        raise FittingError(
            f"{os.fspath(face)}: in {len(d)} frames with visible teeth, d from the skin differs "
            f"from d from the teeth by {np.sqrt((away**2).mean()):.1f} mm (root mean square), "
            f"{np.sqrt(apart):.1f} times the expected error; at most {np.sqrt(_MOST_APART):g} times is accepted.",
            hint="Check that the face is of this shot, the offset of the clocks (--offset), and that the map was "
            "learned with this rig and the same points.",
        )
