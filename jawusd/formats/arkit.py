"""Face captures of ARKit, as exported by Live Link Face.

A capture is a CSV table of blend shape weights with time codes:

    Timecode,BlendShapeCount,...,JawForward,JawRight,JawLeft,JawOpen,...
    14:03:52:28.207,61,...,0.01,0,0.02,0.31,...

A time code is HH:MM:SS:FF.fff. FF counts at the rate of the time code, which may differ from the sample rate. Devices
that record 60 samples per second with a 30 fps time code write a fraction of `.50`, or every time code twice. At 29.97
and 59.94 frames per second, time codes may skip the first two or four frame numbers of every minute that is not a
multiple of ten ("drop frame", SMPTE ST 12-1), marked by a semicolon before the frames or by the skipped numbers
themselves. Column names are case-insensitive; other columns are ignored. In a row whose BlendShapeCount is 0, no face
was detected. Frame numbers of the result are 0 in the first row, and may be fractional; weights are nominally 0 to 1.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, FormatError, errors_name_file
from jawusd.base.tables import TextTable, check_width, read_table
from jawusd.formats.face_table import FaceTable

_OTHER = re.compile(r"(head|lefteye|righteye)(yaw|pitch|roll)")  # columns of rotations, which are not blend shapes
JAW_COLUMNS = ("jawopen", "jawleft", "jawright", "jawforward")
_TIME, _COUNT = "timecode", "blendshapecount"
_TIMECODE = re.compile(r"(\d{1,2}):(\d{2}):(\d{2})[:;](\d{1,3}(?:[.,]\d+)?)")
_RATES = (24, 25, 30, 48, 50, 60, 100, 120)
_NTSC_SLACK = 0.006
_DAY_S = 86_400
_FEWEST_REPEATED = 3  # minimum number of distinct time codes from which repetition is detected
_FEWEST_ROWS, _MOST_ROWS = 0.9, 1.02  # range of the ratio of the median number of rows per second to the requested rate
_MOST_STEPS_OFF = 2.0  # maximum difference between steps across seconds and within a second [steps]
# Accepted range of weights, which a neutral face or gains can move slightly outside 0 to 1, and the weight above which
# weights are assumed to be percentages.
_LEAST_WEIGHT, _MOST_WEIGHT, _PERCENT = -0.5, 2.0, 10.0
_MAX_BYTES = 1 << 30


def shares_of(weights: Array) -> Array:
    """Convert weights (F, 4) of `JAW_COLUMNS` to opening, left and forward motion as shares of the ranges, (F, 3)."""
    opening, left, right, forward = weights.T
    return np.stack([opening, left - right, forward], axis=1)


@errors_name_file
def read_arkit(path: AnyPath, fps: float | None = None) -> FaceTable:
    """Read the weights of `JAW_COLUMNS` from a face capture (CSV) of Live Link Face; left is the subject's left.

    Args:
        fps: frame rate of the result [Hz]: the sample rate, the time code rate, or an integer multiple or fraction of
            the time code rate. None uses the time code rate; the capture must then contain a full second.

    Raises:
        FormatError: the file is not such a table, a value is not finite, a time code does not increase, or the rate
            does not fit the time codes. The message names line and column.
    """
    table, columns = _read_columns(Path(path), (_TIME, *JAW_COLUMNS))
    return _captured(table, columns, [columns.index(name) for name in JAW_COLUMNS], JAW_COLUMNS, fps)


@errors_name_file
def read_blend_shapes(path: AnyPath, fps: float | None = None) -> FaceTable:
    """Read all blend shapes of a face capture of Live Link Face (see `read_arkit`); rotations are left out.

    Raises:
        FormatError: as for `read_arkit`, or there are no blend shapes.
    """
    table, columns = _read_columns(Path(path), (_TIME,))
    shapes = [k for k, name in enumerate(columns) if name not in (_TIME, _COUNT) and not _OTHER.fullmatch(name)]
    if not shapes:
        raise FormatError("has no columns of blend shapes.")
    return _captured(table, columns, shapes, tuple(table.header[k] for k in shapes), fps)


def _captured(
    table: TextTable, columns: list[str], shapes: list[int], names: tuple[str, ...], fps: float | None
) -> FaceTable:
    frames, rate, first = _timed(table, columns.index(_TIME), fps)
    return FaceTable(frames, _weights(table, columns, shapes), names, rate, timecode=first)


def _read_columns(path: Path, needed: tuple[str, ...]) -> tuple[TextTable, list[str]]:
    """Return a table with the needed columns, and the names of all its columns in lower case."""
    table = read_table(path, _MAX_BYTES, short_rows=True)
    columns = [name.lower() for name in table.header]
    for name in needed:
        if columns.count(name) != 1:
            raise FormatError(
                f'has {columns.count(name)} columns named "{name}"; expected one.',
                hint="Live Link Face exports Timecode, JawOpen, JawLeft, JawRight and JawForward.",
            )
    if not table.rows:
        raise FormatError("has no rows below the header.")
    return table, columns


def _timed(table: TextTable, at: int, fps: float | None) -> tuple[Array, float, str]:
    """Return frame numbers (F,), the frame rate [Hz], and the first time code, given a column of time codes."""
    written = [row[at].strip() if len(row) > at else "" for row in table.rows]
    codes = np.array([_seconds_and_frame(code, table.named(i, at)) for i, code in enumerate(written)])
    seconds, inside = codes[:, 0].astype(np.int64), _spread(codes)
    # Time codes start again at midnight.
    seconds += _DAY_S * np.concatenate([[0], np.cumsum(np.diff(seconds) < -_DAY_S // 2)])
    number = _numbers_per_second(seconds, inside, fps, table, at)
    dropped = _dropped(seconds, inside, number, any(";" in code for code in written))
    rate = float(number) if fps is None else fps
    whole = math.ceil(rate - _NTSC_SLACK)
    if dropped or abs(rate - whole * 1000 / 1001) < _NTSC_SLACK:  # an NTSC rate, such as 29.97 = 30000 / 1001
        rate = whole * 1000 / 1001
    frames = _frames(seconds, inside, number, dropped, table, at) * (whole / number)
    return np.round(frames, 6), rate, written[0]


def _weights(table: TextTable, columns: list[str], shapes: list[int]) -> Array:
    """Return the weights of columns (F, K), NaN where no face was detected."""
    count = columns.index(_COUNT) if _COUNT in columns else None
    seen = [i for i, row in enumerate(table.rows) if count is None or len(row) <= count or row[count].strip() != "0"]
    for i in seen:
        check_width(table, i)
    found = table.numbers(shapes, seen)
    bad = np.argwhere(~np.isfinite(found))
    if len(bad):
        i, k = seen[bad[0, 0]], shapes[bad[0, 1]]
        raise FormatError(f"{table.named(i, k)} is {table.rows[i][k]}; all weights must be finite.")
    weights = np.full((len(table.rows), len(shapes)), np.nan)
    weights[seen] = found
    _check_weights(weights, shapes, table)
    return weights


def _check_weights(weights: Array, shapes: list[int], table: TextTable) -> None:
    """Reject weights that are not on ARKit's scale of 0 to 1."""
    away = np.abs(np.nan_to_num(weights, nan=0.5) - 0.5)
    row, column = np.unravel_index(int(np.argmax(away)), away.shape)
    worst = float(weights[row, column])
    if _LEAST_WEIGHT <= worst <= _MOST_WEIGHT or not np.isfinite(worst):
        return
    hint = "Export the weights as recorded, not normalised or scaled."
    if worst > _PERCENT:
        hint = "These look like percentages: divide all weights by 100."
    raise FormatError(
        f"{table.named(int(row), shapes[column])} is {worst:g}; ARKit weights range from 0 to 1; values "
        f"from {_LEAST_WEIGHT:g} to {_MOST_WEIGHT:g} are accepted.",
        hint=hint,
    )


def _seconds_and_frame(code: str, named: str) -> tuple[int, float]:
    found = _TIMECODE.fullmatch(code)
    if found is None:
        raise FormatError(f'{named}: "{code}" is not of the form HH:MM:SS:FF.fff.')
    hours, minutes, seconds = (int(part) for part in found.groups()[:3])
    return 3600 * hours + 60 * minutes + seconds, float(found[4].replace(",", "."))


def _spread(codes: Array) -> Array:
    """Return the frame number of each row of codes (F, 2) (seconds, frames within the second) within its second.

    Rows that repeat a time code are spread evenly, if most time codes are repeated. If a time code has fewer rows than
    usual, its last rows are assumed to be missing, or its first rows if it begins the recording.
    """
    first = np.flatnonzero(np.concatenate([[True], (np.diff(codes, axis=0) != 0).any(axis=1)]))
    counts = np.diff(np.append(first, len(codes)))
    usual = int(np.median(counts))
    if usual < 2 or len(counts) < _FEWEST_REPEATED:
        return codes[:, 1]
    sizes = np.maximum(counts, usual)
    place = np.arange(len(codes)) - np.repeat(first, counts)
    place[: counts[0]] += sizes[0] - counts[0]
    return codes[:, 1] + place / np.repeat(sizes, counts)


def _numbers_per_second(
    seconds: NDArray[np.int64], inside: Array, fps: float | None, table: TextTable, column: int
) -> int:
    """Return the rate of the time codes, which is the standard rate that fits the steps across seconds best."""
    top = int(np.argmax(inside))
    highest = math.floor(inside[top])
    given = 0 if fps is None else math.ceil(fps - _NTSC_SLACK)
    same = np.diff(seconds) == 0
    step = float(np.median(np.diff(inside)[same])) if same.any() else 1.0
    at_rate = round(given * step, 3)  # rate of the time codes if `fps` is the rate of the samples
    rates = [rate for rate in sorted({*_RATES, given, at_rate}) if rate > highest and rate % 1 == 0]
    # Minute starts are excluded, because frame numbers may be dropped there.
    turns = np.flatnonzero((np.diff(seconds) == 1) & (seconds[1:] % 60 != 0))
    # The first and last second are excluded, because they are incomplete.
    rows_of_whole = np.unique(seconds, return_counts=True)[1][1:-1]
    found = 0
    if turns.size and rates and (rows_of_whole.size or given):
        across = np.median(inside[turns + 1] - inside[turns])
        off = [abs(across + rate - step) for rate in rates]
        if min(off) <= _MOST_STEPS_OFF * step:
            found = int(rates[int(np.argmin(off))])
    if not found and given and not rows_of_whole.size:
        found = int(at_rate) if at_rate in _RATES and at_rate > highest and step < 1 else given
    if not found:
        raise FormatError(
            "the frame rate cannot be found from the time codes: there is no full second, or the rate is not one of "
            f"{', '.join(map(str, _RATES))} frames per second.",
            hint="Set the rate with --fps." if fps is None else None,
        )
    samples = float(np.median(rows_of_whole)) if rows_of_whole.size else 0.0
    fits = (
        not given or not max(given, found) % min(given, found) or _FEWEST_ROWS * given <= samples <= _MOST_ROWS * given
    )
    if highest >= found or not fits:
        counted = "" if highest >= found else f", and the codes count {found} frames per second"
        raise FormatError(
            f"{table.named(top, column)} has frame number {highest}{counted}; at {fps:g} frames per second, frame "
            f"numbers must be 0 .. {given - 1}.",
            hint="Omit --fps; --resample changes the rate of the motion." if counted else None,
        )
    return found


def _dropped(seconds: NDArray[np.int64], inside: Array, number: int, marked: bool) -> int:
    """Return the number of frame numbers that time codes skip at minute starts; 0 without drop-frame counting."""
    if number not in (30, 60):
        return 0
    count = number // 15
    if marked:
        return count
    # Drop-frame time codes without the semicolon are recognised by the numbers they skip between two minutes.
    first = (seconds % 60 == 0) & (seconds // 60 % 10 != 0)
    stepped = first[1:] & (np.floor(inside[1:]) == count) & (np.floor(inside[:-1]) == number - 1)
    stepped &= np.diff(seconds) == 1
    return count if stepped.any() and (inside[first] >= count).all() else 0


def _frames(
    seconds: NDArray[np.int64], inside: Array, number: int, dropped: int, table: TextTable, column: int
) -> Array:
    """Return the frame numbers of the time codes, counted from the first row."""
    minutes = seconds // 60
    frames = seconds * number + inside - dropped * (minutes - minutes // 10)
    steps = np.diff(frames)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0)) + 1
        raise FormatError(f"{table.named(row, column)} is not later than the row before; time codes must increase.")
    return frames - frames[0]
