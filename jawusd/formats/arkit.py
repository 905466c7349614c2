"""Face captures of ARKit as Live Link Face exports them: a CSV table of blend shape weights with time codes.

    Timecode,BlendShapeCount,...,JawForward,JawRight,JawLeft,JawOpen,...
    14:03:52:28.207,61,...,0.01,0,0.02,0.31,...

A time code is HH:MM:SS:FF.fff, FF counted at the rate of the take. At 29.97 and 59.94 frames per second, it may leave
out the first two or four numbers of every minute that is no tenth ("drop frame", SMPTE ST 12-1), to keep to the clock:
a semicolon before the frames says so, and so do numbers left out. Column names count without regard to case, any other
column is ignored. A row whose count is 0 is a moment without a face.
"""

from __future__ import annotations

import csv
import io
import math
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jawusd.errors import FormatError
from jawusd.formats.text import read_text
from jawusd.geometry.arrays import Array

JAW_COLUMNS = ("jawopen", "jawleft", "jawright", "jawforward")
_TIME, _COUNT = "timecode", "blendshapecount"
_TIMECODE = re.compile(r"(\d{1,2}):(\d{2}):(\d{2})[:;](\d{1,3}(?:\.\d+)?)")
_RATES = (24, 25, 30, 48, 50, 60, 100, 120)
_NTSC_SLACK = 0.006
_DAY_S = 86_400
# ARKit gives 0 to 1. Captures with a personal neutral face or gains go a little beyond; percent, and weights normalised
# to mean and deviation, go far beyond.
_LEAST_WEIGHT, _MOST_WEIGHT, _PERCENT = -0.5, 2.0, 10.0
_MAX_BYTES = 1 << 30


@dataclass(frozen=True, eq=False)
class FaceCapture:
    """Hold the jaw's weights of a face capture."""

    frames: Array  # frames after the first row, increasing, fractions kept, shape (F,)
    # JawOpen, JawLeft, JawRight, JawForward, nominally 0 .. 1, NaN without a face, shape (F, 4). Left is the subject's
    # left.
    weights: Array
    fps: float  # frames per second
    timecode: str  # that of the first row, as written


def shares_of(weights: Array) -> Array:
    """Return weights (F, 4) as shares of opening, reach to the left and reach forward, shape (F, 3)."""
    opening, left, right, forward = weights.T
    return np.stack([opening, left - right, forward], axis=1)


def read_arkit(path: str | os.PathLike[str], fps: float | None = None) -> FaceCapture:
    """Read a face capture of Live Link Face.

    Without `fps`, the rate at which the time codes count is found from them; the capture must pass a full second then.

    Raises:
        FormatError: not such a table; a value that is no finite number, a time code that does not follow the one
            before, or a rate that does not fit. The message names line and column.
    """
    path = Path(path)
    rows = _rows(path)
    columns = [name.strip().lower() for name in rows[0][1]]
    for name in (_TIME, *JAW_COLUMNS):
        if columns.count(name) != 1:
            raise FormatError(
                f'names the column "{name}" {columns.count(name)} times, expected once.',
                path=path,
                hint="Live Link Face exports Timecode, JawOpen, JawLeft, JawRight and JawForward.",
            )
    at = [columns.index(name) for name in (_TIME, *JAW_COLUMNS)]
    count = columns.index(_COUNT) if _COUNT in columns else None
    codes, weights, lines = [], [], []
    for line, row in rows[1:]:
        face = count is None or len(row) <= count or row[count].strip() != "0"
        if face and len(row) != len(columns):
            raise FormatError(f"line {line} has {len(row)} values, the header names {len(columns)}.", path=path)
        codes.append(_seconds_and_frames(row[at[0]] if len(row) > at[0] else "", line, path))
        weights.append([_number(row[i], line, rows[0][1][i], path) if face else math.nan for i in at[1:]])
        lines.append(line)
    if not codes:
        raise FormatError("has no rows below the header.", path=path)
    _check_weights(np.array(weights), lines, path)
    seconds = np.array([second for second, _ in codes])
    # Past midnight the time codes start over.
    seconds += _DAY_S * np.concatenate([[0], np.cumsum(np.diff(seconds) < -_DAY_S // 2)])
    inside = np.array([frame for _, frame in codes])
    rate = _rate(seconds, inside, lines, fps, path)
    dropped = _dropped(seconds, inside, rate, fps is None, any(";" in row[at[0]] for _, row in rows[1:]))
    if dropped or _is_of_ntsc(rate):
        rate = math.ceil(rate) * 1000 / 1001
    return FaceCapture(
        _frames(seconds, inside, lines, rate, dropped, path), np.array(weights), rate, rows[1][1][at[0]].strip()
    )


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Return the rows that are not empty with their line numbers, the header first."""
    reader = csv.reader(io.StringIO(read_text(path, _MAX_BYTES, "utf-8-sig"), newline=""), strict=True)
    try:
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise FormatError(f"is not a CSV table ({error}).", path=path) from error
    if not rows:
        raise FormatError("is empty; the first line must name the columns.", path=path)
    return rows


def _number(text: str, line: int, column: str, path: Path) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise FormatError(f'line {line}, column "{column}": "{text}" is not a number.', path=path) from error
    if not math.isfinite(value):
        raise FormatError(f'line {line}, column "{column}" is {text}; all weights must be finite.', path=path)
    return value


def _check_weights(weights: Array, lines: list[int], path: Path) -> None:
    """Refuse weights on another scale than ARKit's 0 to 1."""
    away = np.abs(np.nan_to_num(weights, nan=0.5) - 0.5)
    row, column = np.unravel_index(int(np.argmax(away)), away.shape)
    worst = float(weights[row, column])
    if _LEAST_WEIGHT <= worst <= _MOST_WEIGHT or not np.isfinite(worst):
        return
    hint = (
        "These look like percent: divide all weights by 100."
        if worst > _PERCENT
        else ("Export the weights as the device gives them, not normalised or scaled.")
    )
    raise FormatError(
        f'line {lines[row]}, column "{JAW_COLUMNS[column]}" is {worst:g}; weights of ARKit go from 0 to 1, allowed are '
        f"{_LEAST_WEIGHT:g} to {_MOST_WEIGHT:g}.",
        path=path,
        hint=hint,
    )


def _seconds_and_frames(text: str, line: int, path: Path) -> tuple[int, float]:
    found = _TIMECODE.fullmatch(text.strip())
    if found is None:
        raise FormatError(f'line {line}, column "Timecode": "{text}" is not HH:MM:SS:FF.fff.', path=path)
    hours, minutes, seconds = (int(part) for part in found.groups()[:3])
    return 3600 * hours + 60 * minutes + seconds, float(found[4])


def _rate(seconds: NDArray[np.int64], inside: Array, lines: list[int], fps: float | None, path: Path) -> float:
    """Return the given rate, or the lowest usual one above every frame number once a full second was counted."""
    top = int(np.argmax(inside))
    highest = math.floor(inside[top])
    if fps is None:
        # The first and the last second are incomplete: only those between them show where counting starts over.
        whole = (seconds > seconds[0]) & (seconds < seconds[-1])
        rates = [rate for rate in _RATES if rate > highest]
        if not whole.any() or not rates:
            raise FormatError(
                "the time codes do not tell the frame rate: they pass no full second, or count above "
                f"{_RATES[-1]} frames per second.",
                path=path,
                hint="Give the rate with --fps.",
            )
        return float(rates[0])
    if highest >= math.ceil(fps):
        raise FormatError(
            f'line {lines[top]}, column "Timecode" counts frame {highest} of a second, at {fps:g} frames per second '
            f"allowed are 0 .. {math.ceil(fps) - 1}.",
            path=path,
        )
    return float(fps)


def _is_of_ntsc(rate: float) -> bool:
    """Tell whether a rate is one like 29.97, short for 30000 / 1001."""
    return abs(rate - math.ceil(rate) * 1000 / 1001) < _NTSC_SLACK


def _dropped(seconds: NDArray[np.int64], inside: Array, rate: float, found: bool, marked: bool) -> int:
    """Return how many numbers the time codes leave out at the start of a minute, 0 where they count them all."""
    number = math.ceil(rate)
    if number not in (30, 60) or not (found or _is_of_ntsc(rate)):
        return 0
    count = number // 15
    if marked:
        return count
    # unmarked: none of these numbers, and a step from the last one of a minute to the one after those left out
    first = (seconds % 60 == 0) & (seconds // 60 % 10 != 0)
    stepped = first[1:] & (np.floor(inside[1:]) == count) & (np.floor(inside[:-1]) == number - 1)
    stepped &= np.diff(seconds) == 1
    return count if stepped.any() and (inside[first] >= count).all() else 0


def _frames(
    seconds: NDArray[np.int64], inside: Array, lines: list[int], rate: float, dropped: int, path: Path
) -> Array:
    # A rate like 29.97 counts whole frames: 30 numbers per second of time code.
    minutes = seconds // 60
    frames = seconds * math.ceil(rate) + inside - dropped * (minutes - minutes // 10)
    steps = np.diff(frames)
    if (steps <= 0).any():
        line = lines[int(np.argmax(steps <= 0)) + 1]
        raise FormatError(f'line {line}, column "Timecode" does not come after the row before.', path=path)
    return np.round(frames - frames[0], 6)
