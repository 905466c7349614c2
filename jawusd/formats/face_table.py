"""Tables with one pose of a face per row (any columns, or points), in CSV of any locale (see `jawusd.base.tables`).

    frame,brow_left,jaw_open,...                 any columns in one unit, such as curves of a rig or weights
    time_s,chin_x,chin_y,chin_z,lip_x,...        points, if all columns come in threes NAME_x, NAME_y, NAME_z

The first row names the columns; one of them is `frame` or `time_s`. Blank cells and nan mean hidden.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, FormatError, errors_name_file, naming_file
from jawusd.base.tables import TextTable, check_width, read_table, read_text, split_rows

_MAX_BYTES = 1 << 30
_CLOCKS = ("frame", "time_s")
_AXIS = re.compile(r"(.+)[_.:]([xyz])", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class FaceTable:
    """Columns or points of a face over time."""

    frames: Array  # frame numbers or times of the rows, increasing, shape (F,)
    X: Array  # columns (F, K), or points (F, N, 3) in the table's unit; NaN where hidden
    names: tuple[str, ...]  # names of the columns or points; may be empty
    fps: float | None  # frame rate [Hz]; 1 if `frames` are times [s], None if unknown
    unit: str | None = None  # length unit of points, None if unknown
    timecode: str = ""  # time code of the first row, as written; "" if there is none


@errors_name_file
def header_of(path: AnyPath) -> list[str]:
    """Return the cells of the first row of a text table, in lower case.

    Raises:
        FormatError: the file is not text, or empty.
    """
    rows, _ = split_rows(read_text(Path(path), _MAX_BYTES))
    if not rows:
        raise FormatError("is empty.")
    return [cell.strip().lower() for cell in rows[0][1]]


def is_face_table(header: list[str]) -> bool:
    """Return whether a first row, in lower case, is the header of a face table."""
    return any(clock in header for clock in _CLOCKS)


@errors_name_file
def read_face_table(path: AnyPath) -> FaceTable:
    """Read a face table.

    Raises:
        FormatError: there is not exactly one column `frame` or `time_s`, there are no other columns, a cell is not a
            number, or frames or times do not increase.
    """
    return _face_of(read_table(Path(path), _MAX_BYTES))


def read_face_row(header: str, row: str, number: int, path: AnyPath) -> FaceTable:
    """Read one row, the line of a given number, of a face table that is read while it is written.

    Raises:
        FormatError: as for `read_face_table`.
    """
    with naming_file(path):
        rows, _ = split_rows(f"{header}\n{row}")
        table = TextTable([name.strip() for name in rows[0][1]], [rows[-1][1]], [f"line {number}"])
        check_width(table, 0)
        return _face_of(table)


def _face_of(table: TextTable) -> FaceTable:
    """Return the columns or points of a table; see `read_face_table`."""
    lower = [name.lower() for name in table.header]
    clocks = [k for k, name in enumerate(lower) if name in _CLOCKS]
    others = [k for k in range(len(lower)) if k not in clocks]
    if len({lower[k] for k in clocks}) != len(clocks) or not clocks or not others or not table.rows:
        raise FormatError(
            f"has the columns {', '.join(table.header[:8])} and {len(table.rows)} rows; expected one column frame "
            "or time_s, other columns, and at least one row."
        )
    clock = lower.index("time_s") if "time_s" in lower else clocks[0]
    frames = table.numbers([clock])[:, 0]
    wrong = ~np.isfinite(frames)
    wrong[1:] |= ~(np.diff(frames) > 0)
    if wrong.any():
        raise FormatError(
            f"{table.named(int(np.argmax(wrong)), clock)} must be a finite number above that of the row before."
        )
    filled = [[cell if cell.strip() else "nan" for cell in row] for row in table.rows]
    X = replace(table, rows=filled).numbers(others)
    X[~np.isfinite(X)] = np.nan
    names = tuple(table.header[k] for k in others)
    fps = 1.0 if lower[clock] == "time_s" else None
    points = _points_of(names)
    if not points:
        return FaceTable(frames, X, names, fps)
    return FaceTable(frames, X.reshape(len(X), -1, 3), points, fps)


def _points_of(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the points if the columns are x, y, z of points; otherwise return an empty tuple."""
    found = [_AXIS.fullmatch(name) for name in names]
    labels = [(match[1], match[2].lower()) for match in found if match]
    named = tuple(labels[k][0] for k in range(0, len(labels), 3))
    return named if labels == [(name, axis) for name in named for axis in "xyz"] and len(labels) == len(names) else ()
