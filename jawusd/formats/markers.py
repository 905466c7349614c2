"""Tables of marker positions, as optical systems write them, and the rigid bodies that carry the markers.

Tables, one row of x, y, z of every marker per frame, frames numbered from 0:

* numbers alone, separated by spaces, as Northern Digital's `opto2ascii` writes them; a marker out of sight is a huge
  number there (-3.697314e28), or nan;
* a probe of ArtiSynth (Modelling Guide, "Numeric probes", text format): `start stop scale`, then `interpolation size
  step`, then the rows. A marker per file is common: a pattern of numbered files is read as one table.

Rigid bodies: a marker description file of Northern Digital (`.rig`), which names its markers by their numbers in the
table, or these numbers alone.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jawusd.errors import FormatError
from jawusd.formats.numbered import is_pattern, numbered_files
from jawusd.formats.text import read_text
from jawusd.geometry.arrays import Array

_MAX_BYTES = 1 << 28
_OUT_OF_SIGHT = 1e20  # and beyond: no length
_INTERPOLATIONS = ("step", "linear", "parabolic", "cubic", "cubicstep", "quadraticstep", "sphericallinear")
_RIG_COUNT = "number of markers"


@dataclass(frozen=True)
class RigidBody:
    """Hold what is known of a rigid body: its markers' numbers, counted from 1, and their positions on it.

    Attributes:
        markers: numbers in the table.
        points: positions in the body's own frame, shape (N, 3), in the unit of its file; None where only the numbers
            are known.
    """

    markers: tuple[int, ...]
    points: Array | None


def read_markers(path: str | os.PathLike[str]) -> Array:
    """Read marker positions (F, N, 3) in the unit of the file, NaN where a marker was not seen.

    Args:
        path: a table, or a pattern (`Marker%d_Traj.txt`) of numbered tables of the same length, whose markers are put
            side by side in the order of the numbers.

    Raises:
        FormatError: not such a table, a value that is not a number, or tables of different lengths.
        CaptureError: a pattern without files.
    """
    path = Path(path)
    if not is_pattern(path):
        return _read_table(path)
    tables = {file: _read_table(file) for file in numbered_files(path).values()}
    counts = {file.name: len(table) for file, table in tables.items()}
    if len(set(counts.values())) > 1:
        lengths = ", ".join(f"{name} has {count}" for name, count in counts.items())
        raise FormatError(f"the tables have different numbers of frames: {lengths}.", path=path)
    return np.concatenate(list(tables.values()), axis=1)


def _read_table(path: Path) -> Array:
    lines = [line for line in read_text(path, _MAX_BYTES).splitlines() if line.strip()]
    rows = [line.split() for line in lines]
    size = None
    if len(rows) > 1 and rows[1][0].lower() in _INTERPOLATIONS:
        size, rows = _probe_size(rows, path), rows[2:]
    if not rows:
        raise FormatError("holds no frames.", path=path)
    first = len(lines) - len(rows) + 1
    width = len(rows[0]) if size is None else size
    if width % 3:
        raise FormatError(f"has {width} numbers per frame; three per marker are expected.", path=path)
    for number, row in enumerate(rows, start=first):
        if len(row) != width:
            raise FormatError(f"line {number} has {len(row)} numbers, {width} are expected.", path=path)
    try:
        values = np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise FormatError(
            f"is not a table of marker positions ({error}).", path=path, hint="Rows of numbers alone are read."
        ) from error
    points = values.reshape(len(rows), -1, 3)
    with np.errstate(invalid="ignore"):
        seen = (np.abs(points) < _OUT_OF_SIGHT).all(axis=-1)
    points[~seen] = np.nan
    return points


def _probe_size(rows: list[list[str]], path: Path) -> int:
    """Return how many numbers a frame of an ArtiSynth probe has."""
    try:
        return int(rows[1][1])
    except (IndexError, ValueError) as error:
        raise FormatError(
            'line 2 is not that of an ArtiSynth probe, as "Linear 9 0.02" (interpolation, numbers per frame, step).',
            path=path,
        ) from error


def read_body(description: str | os.PathLike[str]) -> RigidBody:
    """Read a rigid body: a marker description file (.rig), or the numbers of its markers (`5,6,7,8`).

    Raises:
        FormatError: neither of them, fewer than three markers, or a marker named twice.
    """
    text = os.fspath(description)
    numbers = [piece.strip() for piece in text.split(",")]
    if all(piece.isascii() and piece.isdigit() for piece in numbers):
        return _checked(RigidBody(tuple(int(piece) for piece in numbers), None), text)
    return _checked(_read_rig(Path(description)), text)


def _read_rig(path: Path) -> RigidBody:
    """Read Northern Digital's marker description: a count, then `number x y z views` per marker."""
    lines = read_text(path, _MAX_BYTES, "latin-1").splitlines()
    counts = [line.partition(";")[0].strip() for line in lines if _RIG_COUNT in line.lower()]
    if len(counts) != 1 or not counts[0].isdigit():
        raise FormatError(
            f'is not a marker description: no line tells the "{_RIG_COUNT}".',
            path=path,
            hint="Name a .rig file, or the numbers of the rigid body's markers, as 5,6,7,8.",
        )
    header = next((k for k, line in enumerate(lines) if line.split()[:4] == ["Marker", "X", "Y", "Z"]), len(lines))
    rows = [line.split() for line in lines[header + 1 :] if line.strip()]
    try:
        markers = tuple(int(row[0]) for row in rows)
        points = np.array([[float(value) for value in row[1:4]] for row in rows]).reshape(-1, 3)
    except (IndexError, ValueError) as error:
        raise FormatError(f'a marker is not written as "number x y z views" ({error}).', path=path) from error
    if len(markers) != int(counts[0]):
        raise FormatError(f"says that it has {counts[0]} markers and lists {len(markers)}.", path=path)
    if not np.isfinite(points).all():
        raise FormatError("holds a position that is not a finite number.", path=path)
    return RigidBody(markers, points)


def _checked(body: RigidBody, where: str) -> RigidBody:
    numbers = ", ".join(map(str, body.markers))
    if len(set(body.markers)) != len(body.markers) or min(body.markers, default=1) < 1:
        raise FormatError(f"markers {numbers}: each must be named once, counted from 1.", path=where)
    if len(body.markers) < 3:
        raise FormatError(f"names the markers {numbers or 'none'}; three or more are needed.", path=where)
    return body
