"""Pose of the jaw in live frames, from teeth and facial skin; rows of a face tracker are matched to images by time."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import FormatError, JawusdError
from jawusd.evaluator import JawRig
from jawusd.evaluator.skin import Skin, SkinJaw
from jawusd.formats.face_table import FaceTable, read_face_row
from jawusd.formats.performance import SolveState
from jawusd.media import live_source
from jawusd.pipeline.markers import LENGTH_UNITS_MM
from jawusd.pipeline.skin import SkinOptions, load_own_skin, own_columns, read_shot_face
from jawusd.pipeline.solve_skin import check_agreement
from jawusd.tracking.performance.skin import SkinFilter


@dataclass(frozen=True, eq=False)
class LiveJaw:
    """The jaw in one frame."""

    d: Array  # jaw parameters [mm], shape (3,)
    covariance: Array  # their covariance [mm^2], shape (3, 3)
    state: SolveState  # solved, skin or carried
    familiar: bool | None = None  # as in `LiveFrame`


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """Result of one frame, which consists of the images of all sources at one time."""

    time_s: float  # capture time of the images [s] since the start of the sources; for files, since their first images
    d: Array  # jaw parameters [mm], shape (3,)
    sigma: Array  # their standard deviations [mm], shape (3,)
    margin_mm: float  # signed distance to the rig's bound [mm], positive inside
    verdict: str  # the rig's verdict on the pose
    state: str  # name of the `SolveState`: solved, skin or carried
    latency_ms: float  # time from the capture of the images to this result [ms]
    dropped: int  # number of frames dropped since the last result
    #: whether the face resembles those from which the map was learned; None without skin or a row near this time
    familiar: bool | None = None

    def as_json(self) -> dict[str, object]:
        """Return the result as JSON-serialisable values, rounded to significant digits."""
        return {
            "time_s": round(self.time_s, 4),
            "d": [round(value, 3) for value in self.d.tolist()],
            "sigma": [round(value, 3) for value in self.sigma.tolist()],
            "margin_mm": round(self.margin_mm, 3),
            "verdict": self.verdict,
            "state": self.state,
            "latency_ms": round(self.latency_ms, 1),
            "dropped": self.dropped,
            "familiar": self.familiar,
        }


#: Name of the standard input.
STANDARD_INPUT = "-"
_COMPARED = 240  # number of recent frames with visible teeth in which skin and teeth are compared
_LATE_S = 0.1  # maximum time from an image to the arrival of the next row of face data [s]
_APART_S = 0.2  # maximum time between two rows of face data for interpolation between them [s]
_KEPT = 1_000  # number of recent rows that are kept
_POLL_S = 0.005  # time between attempts to read more of a growing file [s]


class LiveSkin:
    """The jaw in live frames, estimated from facial skin; `face` is played and stopped like the sources of images.

    The face data are a recording, in any format of `read_face`, if all cameras are files; its times begin with the
    images. Otherwise, they are a face table (see `formats.face_table`) that is read while it is written: a growing
    file, a pipe or the standard input. Its clock is aligned by the arrival times of the rows.
    """

    def __init__(self, rig: JawRig, options: SkinOptions, *, recorded: bool) -> None:
        """Read the map, and the face data if all cameras are files (`recorded`); raises like `read_shot_face`."""
        self._skin, self._options = load_own_skin(rig, options.skin), options
        self._filter, self._agreed = SkinFilter(), deque[tuple[SkinJaw, Array]](maxlen=_COMPARED)
        whole = recorded and Path(options.face).is_file()
        self.face: RecordedFace | FaceStream = (RecordedFace if whole else FaceStream)(self._skin, options)

    def fuse(self, at_s: float, jaw: LiveJaw, seconds: float) -> LiveJaw:
        """Return the jaw of a frame, corrected with skin; the state is `SKIN` if an arch is hidden and skin was used.

        `at_s` is the time of the images on the live clock [s], `seconds` the time since the previous frame [s]. Raises
        FormatError if a row of the face data is invalid, and FittingError if skin and visible teeth disagree.
        """
        columns = self.face.at(at_s)
        found, seen = self._skin(columns), jaw.state == SolveState.SOLVED
        if seen and found.familiar:
            self._agreed.append((found, jaw.d))
            if len(self._agreed) == _COMPARED:
                parts = [np.stack(part) for part in zip(*(skin for skin, _ in self._agreed), strict=True)]
                check_agreement(self._options.face, SkinJaw(*parts), np.stack([d for _, d in self._agreed]))
        d, covariance, used = self._filter.fuse(found, jaw.d, jaw.covariance, seen=seen, seconds=seconds)
        known = bool(found.familiar) if np.isfinite(columns).all() else None
        return LiveJaw(d, covariance, SolveState.SKIN if used and not seen else jaw.state, known)


class RecordedFace:
    """The rows of a recorded face, played with recorded images."""

    def __init__(self, skin: Skin, options: SkinOptions) -> None:
        """Read the recording; raises like `read_shot_face`."""
        times_s, self._rows = read_shot_face(skin, options)
        self._times_s, self._begin_s = times_s + (options.offset_s or 0.0), 0.0

    def play(self, begin_s: float, silence_s: float) -> None:
        """Start at a time on the live clock [s]."""
        self._begin_s = begin_s

    def stop(self) -> None:
        """Do nothing: the file is closed."""

    def at(self, time_s: float) -> Array:
        """Return the columns (K,) at a time on the live clock [s]; NaN where unknown."""
        return columns_between(self._times_s + self._begin_s, self._rows, time_s)


class FaceStream:
    """The rows of a face table that is being written, read in a thread."""

    def __init__(self, skin: Skin, options: SkinOptions) -> None:
        """Prepare to read from the file, pipe or standard input named by `options.face`.

        Raises FormatError if there is none, or for `options.rigid`: a live face must already be relative to the head.
        """
        if options.rigid:
            raise FormatError(
                "is read while it is being written; --rigid applies only to recorded faces.", path=options.face
            )
        if os.fspath(options.face) != STANDARD_INPUT and not Path(options.face).exists():
            raise FormatError(
                "there is no such file.", path=options.face, hint="Give a file, a pipe, or - for standard input."
            )
        self._skin, self._options = skin, options
        self._rows, self._ahead_s = deque[tuple[float, Array]](maxlen=_KEPT), deque[float](maxlen=_KEPT)
        self._changed, self._stopped = threading.Condition(), threading.Event()
        self._error: JawusdError | None = None

    def play(self, begin_s: float, silence_s: float) -> None:
        """Read in a thread; raises FormatError if no row arrives within `silence_s` [s], or if the row is invalid."""
        threading.Thread(target=self._read, daemon=True).start()
        with self._changed:
            self._changed.wait_for(lambda: self._rows or self._error, silence_s)
        if self._error is not None:
            raise self._error
        if not self._rows:
            raise FormatError(
                f"has no row of face data after {silence_s:g} s.",
                path=self._options.face,
                hint="Check that the face tracker is running and writes a header and rows without buffering. "
                "--silence sets the time limit.",
            )

    def stop(self) -> None:
        """Stop reading."""
        self._stopped.set()

    def at(self, time_s: float) -> Array:
        """Return the columns (K,) at a time of the live clock [s], waiting for the row after it; NaN where unknown.

        Raises FormatError if a row is invalid, or has other columns than the map.
        """
        with self._changed:
            left_s = max(0.0, time_s + _LATE_S - live_source.now_s())
            self._changed.wait_for(lambda: self._error or self._rows[-1][0] + self._offset_s() > time_s, left_s)
            if self._error is not None:
                raise self._error
            times_s = np.array([row[0] for row in self._rows]) + self._offset_s()
            k = int(np.searchsorted(times_s, time_s, side="right"))
            near = list(self._rows)[max(k - 1, 0) : k + 1]
        return columns_between(times_s[max(k - 1, 0) : k + 1], np.stack([row for _, row in near]), time_s)

    def _offset_s(self) -> float:
        """Return the live clock minus the table's clock [s], from the row that arrived with the least delay."""
        return min(self._ahead_s) + (self._options.offset_s or 0.0)

    def _read(self) -> None:
        path, header = self._options.face, ""
        try:
            for number, line in enumerate(self._lines(), 1):
                if not line.strip() or line.lstrip().startswith("#"):
                    continue
                if not header:
                    header = line
                else:
                    self._take(read_face_row(header, line, number, path), number)
        except JawusdError as error:
            self._fail(error)
        except (OSError, UnicodeDecodeError) as error:
            self._fail(FormatError(f"cannot be read ({error}).", path=path))

    def _fail(self, error: JawusdError) -> None:
        with self._changed:
            self._error = error
            self._changed.notify_all()

    def _take(self, face: FaceTable, number: int) -> None:
        """Keep a row."""
        arrived_s, options = live_source.now_s(), self._options
        found = own_columns(self._skin, options.skin, face, options.face)
        fps = face.fps or options.fps
        if not fps:
            raise FormatError("has no column time_s.", path=options.face, hint="Give its frame rate with --face-fps.")
        row_s, columns = float(face.frames[0]) / fps, found.reshape(-1)
        if self._skin.points:
            columns = columns * LENGTH_UNITS_MM[options.unit]
        if self._rows and row_s <= self._rows[-1][0]:
            raise FormatError(f"line {number} is not later than the row before.", path=options.face)
        with self._changed:
            self._rows.append((row_s, columns))
            self._ahead_s.append(arrived_s - row_s)
            self._changed.notify_all()

    def _lines(self) -> Iterator[str]:
        """Yield complete lines; at the end of a growing file, wait for more."""
        where = os.fspath(self._options.face)
        if where == STANDARD_INPUT:
            yield from sys.stdin
            return
        grows, begun = Path(where).is_file(), ""
        with open(where, encoding="utf-8-sig") as file:
            while not self._stopped.is_set():
                begun += file.readline()
                if begun.endswith("\n"):
                    yield begun
                    begun = ""
                elif grows:
                    time.sleep(_POLL_S)
                else:
                    return


def columns_between(times_s: Array, rows: Array, time_s: float) -> Array:
    """Return columns (K,) at a time, interpolated between rows (F, K) at increasing times (F,).

    They are NaN before the first and after the last row, and between rows that are far apart.
    """
    k = int(np.searchsorted(times_s, time_s, side="right"))
    if not 0 < k < len(times_s) or times_s[k] - times_s[k - 1] > _APART_S:
        return np.full(rows.shape[1], np.nan)
    share = (time_s - times_s[k - 1]) / (times_s[k] - times_s[k - 1])
    return np.asarray((1 - share) * rows[k - 1] + share * rows[k])
