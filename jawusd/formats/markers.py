"""Read tables of marker positions from optical tracking systems, and rigid bodies of markers.

Supported tables have one row per frame with x, y, z of every marker, in any locale (see `jawusd.base.tables`); frames
are numbered from 0:

* plain numbers, as written by Northern Digital's `opto2ascii`;
* ArtiSynth probes (Modelling Guide, "Numeric probes", text format): `start stop scale`, then `interpolation size step`,
  then the rows. Often there is one file per marker: a pattern of numbered files is read as one table;
* 3D data of Qualisys Track Manager (TSV export) in mm: lines of `KEY value`, of which `MARKER_NAMES` is required;
* TRC of Motion Analysis and OpenSim: `DataRate`, `NumMarkers`, `Units` above their values, then `Frame#`, `Time`;
* CSV of Vicon Nexus, section `Trajectories`; model outputs and devices are ignored.

A marker is hidden where a coordinate is blank, nan or huge (-3.697314e28), or all three are exactly 0 (except in
probes, which are simulated). Frames that a numbered table omits have no markers.

A rigid body is given by a marker description of Northern Digital (`.rig`), or by numbers or names of markers in the
table.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import AnyPath, FormatError, UnitsError, errors_name_file
from jawusd.base.tables import read_text, split_rows, to_numbers
from jawusd.formats.file_names import is_pattern, numbered_files

READ = (
    "Supported are C3D, TSV of Qualisys Track Manager (3D), TRC, CSV of Vicon Nexus (Trajectories), ArtiSynth probes, "
    "and plain rows of numbers."
)
#: Suffixes of unsupported marker and motion files, with their types.
_NOT_READ = {
    ".mat": "a MATLAB file",
    ".qtm": "a project file of Qualisys Track Manager",
    ".mot": "a motion file of OpenSim",
    ".sto": "a storage file of OpenSim",
    ".bvh": "a skeleton",
    ".fbx": "an FBX scene",
    ".xlsx": "a workbook",
    ".xls": "a workbook",
    ".json": "JSON",
}
_LENGTHS = ("mm", "cm", "m")
_MAX_BYTES = 1 << 28
_MOST_FRAMES = 10_000_000
_OUT_OF_SIGHT = 1e20  # minimum magnitude of a coordinate for a marker to count as hidden
_MAX_RIG_BYTES = 1 << 24
_RIG_COUNT = "number of markers"  # text in the line of a marker description that states their number
_INTERPOLATIONS = ("step", "linear", "parabolic", "cubic", "cubicstep", "quadraticstep", "sphericallinear")
_LEADING_ZERO = re.compile(r"[+-]?0\d+")

_Rows = list[tuple[int, list[str]]]


@dataclass(frozen=True, eq=False)
class MarkerTable:
    """Marker positions over a take."""

    points: Array  # positions in the file's unit, shape (F, N, 3), NaN where a marker is hidden
    names: tuple[str, ...] = ()  # marker names, empty if the file has none
    unit: str | None = None  # unit of the positions, "mm", "cm" or "m"; None if the file states none
    fps: float | None = None  # frame rate [Hz]; None if the file states none


def mark_hidden(points: Array, zeros: bool = True) -> Array:
    """Return positions (F, N, 3) with NaN where a marker is hidden; `zeros`: also where it is at exactly 0 0 0."""
    with np.errstate(invalid="ignore"):
        seen: Mask = np.all(np.abs(points) < _OUT_OF_SIGHT, axis=-1)
    if zeros:
        seen = seen & (points != 0).any(axis=-1)
    return np.where(seen[..., None], points, np.nan)


@errors_name_file
def read_markers(path: AnyPath) -> MarkerTable:
    """Read marker positions from a table, or from a pattern (`Marker%d_Traj.txt`) of numbered tables of equal length.

    Raises:
        FormatError: a file is not a marker table or is truncated, a value is not a number, or tables differ in length.
        CaptureError: no file matches the pattern.
    """
    path = Path(path)
    if not is_pattern(path):
        return _read_table(path)
    tables = {file: _read_table(file) for file in numbered_files(path).values()}
    counts = {file.name: len(table.points) for file, table in tables.items()}
    if len(set(counts.values())) > 1:
        lengths = ", ".join(f"{name} has {count}" for name, count in counts.items())
        raise FormatError(f"the tables have different numbers of frames: {lengths}.")
    first, *_ = tables.values()
    if len({(table.unit, table.fps) for table in tables.values()}) > 1:
        raise FormatError("the tables have different units or rates.")
    points = np.concatenate([table.points for table in tables.values()], axis=1)
    return MarkerTable(points, sum((table.names for table in tables.values()), ()), first.unit, first.fps)


@errors_name_file
def _read_table(path: Path) -> MarkerTable:
    kind = _NOT_READ.get(path.suffix.lower())
    if kind is not None:
        raise FormatError(f"is {kind}, not a supported marker table.", hint=READ)
    rows, separator = split_rows(read_text(path, _MAX_BYTES), blank_rows=True)
    if not rows:
        raise FormatError("has no frames.")
    if max(len(row) for _, row in rows) == 1:  # a table whose columns are separated only by spaces
        rows = [(line, row[0].split()) for line, row in rows]
    keys = [row[0].strip().lower() for _, row in rows]
    if "marker_names" in keys or "data_included" in keys:
        return _read_qtm(rows)
    if "frame#" in keys:
        return _read_trc(rows, keys.index("frame#"))
    if "trajectories" in keys:
        return _read_vicon(rows[keys.index("trajectories") :])
    sections = [row[0].strip() for _, row in rows if row[0].strip().lower() in ("model outputs", "devices", "joints")]
    if sections or keys[0] == "format version":
        what = f"has the sections {', '.join(sections)} of Vicon Nexus" if sections else "is a CSV of OptiTrack Motive"
        raise FormatError(f"{what}, not a supported marker table.", hint=READ)
    return MarkerTable(_plain(rows, separator))


def _plain(rows: _Rows, separator: str) -> Array:
    """Return the marker positions in a table of plain numbers or an ArtiSynth probe, shape (F, N, 3)."""
    if any(len(cell.split()) > 1 for _, row in rows for cell in row):  # columns may also be separated by spaces
        rows = [(line, separator.join(row).split()) for line, row in rows]
    probe = len(rows) > 1 and rows[1][1][0].strip().lower() in _INTERPOLATIONS
    if probe:
        width, rows = _probe_size(rows[1][1]), rows[2:]
    else:
        width = len(rows[0][1])
    if not rows:
        raise FormatError("has no frames.")
    if any(re.match(r"[^\W\d_]", cell.strip()) and cell.strip().lower() != "nan" for cell in rows[0][1]):
        shown = " ".join(rows[0][1])[:60]
        raise FormatError(f'is not a table of marker positions: line {rows[0][0]} is "{shown}".', hint=READ)
    cells = [cell.strip() for _, row in rows for cell in row] if separator == "," else []
    if any(map(_LEADING_ZERO.fullmatch, cells)) and not any("." in cell for cell in cells):
        raise FormatError("uses commas both as decimal and as column separators.", hint="Write decimals with points.")
    for line, row in rows:
        if len(row) != width:
            raise FormatError(f"line {line} has {len(row)} numbers; expected {width}.")
    while width % 3 and not any(row[width - 1].strip() for _, row in rows):  # remove blank columns at the end
        width -= 1
    if width % 3:
        raise FormatError(f"has {width} numbers per frame; expected three per marker.", hint=READ)
    return _positions(rows, 0, width, zeros=not probe)


def _positions(rows: _Rows, first: int, width: int, zeros: bool = True) -> Array:
    """Convert cells to positions (F, N, 3), NaN where a marker is hidden; trailing blank cells may be missing."""
    if not rows or not width:
        raise FormatError("has no frames or no markers.")
    cells = []
    for line, row in rows:
        found = [cell if cell.strip() else "nan" for cell in row[first : first + width]]
        if len(found) % 3 or any(cell.strip() for cell in row[first + width :]):
            end = len(row) - first
            raise FormatError(f"line {line} has {end} numbers; expected {width}.")
        cells.append(found + ["nan"] * (width - len(found)))

    def named(i: int, j: int) -> str:
        return f"line {rows[i][0]}, marker {j // 3 + 1}, {'xyz'[j % 3]}"

    return mark_hidden(to_numbers(cells, named).reshape(len(rows), -1, 3), zeros)


def _read_qtm(rows: _Rows) -> MarkerTable:
    """Read 3D data in TSV of Qualisys Track Manager."""
    keys = {row[0].strip().lower(): [cell.strip() for cell in row[1:] if cell.strip()] for _, row in rows[:40]}
    included = "".join(keys.get("data_included", ["3D"])[:1])
    if included != "3D" or "marker_names" not in keys:
        raise FormatError(f"contains {included} data from Qualisys Track Manager, not markers.", hint=READ)
    names = tuple(keys["marker_names"])
    data = [(line, row) for line, row in rows if not re.match(r"(?!nan$)[^\W\d]", row[0].strip(), re.IGNORECASE)]
    header = next((row for _, row in rows if row[0].strip().lower() == "frame"), [])
    first = [cell.strip().lower() in ("frame", "time") for cell in header[:2]].count(True)
    if not header:  # skip extra columns at the beginning, which are frame and time
        filled = max((k + 1 for _, row in data for k, cell in enumerate(row) if cell.strip()), default=0)
        first = max(filled - 3 * len(names), 0)
    points = _declared(data, first, names, keys, "NO_OF_MARKERS", "NO_OF_FRAMES")
    return MarkerTable(points, names, "mm", _rate(keys.get("frequency"), "FREQUENCY"))


def _read_trc(rows: _Rows, at: int) -> MarkerTable:
    """Read a TRC file; `at` is the index of the row that names the markers."""
    keys: dict[str, list[str]] = {}
    for (_, above), (_, below) in zip(rows[:at], rows[1:at]):
        if above[0].strip().lower() == "datarate":
            keys = {key.strip().lower(): [value.strip()] for key, value in zip(above, below)}
    names = tuple(cell.strip() for cell in rows[at][1][2:] if cell.strip())
    data = [(line, row) for line, row in rows[at + 1 :] if row[0].strip() and row[0].strip().lower() != "x1"]
    points = _declared(data, 2, names, keys, "NumMarkers", "NumFrames")
    unit = length_unit("".join(keys.get("units", [])))
    return MarkerTable(_with_gaps(data, points), names, unit, _rate(keys.get("datarate")))


def _declared(
    data: _Rows, first: int, names: tuple[str, ...], keys: dict[str, list[str]], markers: str, frames: str
) -> Array:
    """Return positions (F, N, 3) after checking the numbers that a header has under the keys `markers`, `frames`."""
    count = _whole(keys.get(markers.lower()), len(names), markers)
    if count != len(names):
        raise FormatError(f"declares {count} markers but names {len(names)}.")
    points = _positions(data, first, 3 * count)
    said = _whole(keys.get(frames.lower()), len(data), frames)
    if said != len(data):
        raise FormatError(
            f"is truncated or was edited: its header declares {said} frames, but it has {len(data)}.",
            hint="Export it again, or correct the number in its header.",
        )
    return points


def _read_vicon(rows: _Rows) -> MarkerTable:
    """Read the section Trajectories of a Vicon Nexus CSV: title, rate, names, columns, units, then frames."""
    if len(rows) < 5:
        raise FormatError("its section Trajectories has no frames.")
    named, columns, units = ([cell.strip() for cell in row] for _, row in rows[2:5])
    data = []
    for line, row in rows[5:]:
        if not row[0].strip().isdigit():
            break
        data.append((line, row))
    places = [
        k for k, name in enumerate(named) if name and [cell.upper() for cell in columns[k : k + 3]] == ["X", "Y", "Z"]
    ]
    if not places or not data:
        raise FormatError("its section Trajectories has no markers or no frames.")
    found = {units[k].lower() for k in places if k < len(units)}
    if len(found) != 1:
        raise FormatError(f"its markers have the units {', '.join(sorted(found))}; expected one unit.")
    points = np.concatenate([_positions([(line, row[k : k + 3]) for line, row in data], 0, 3) for k in places], axis=1)
    names = tuple(named[k] for k in places)
    return MarkerTable(_with_gaps(data, points), names, length_unit(found.pop()), _rate(rows[1][1]))


def _with_gaps(data: _Rows, points: Array) -> Array:
    """Return positions with rows of NaN for frame numbers missing in the first column."""
    numbers = to_numbers([row[:1] for _, row in data], lambda i, _: f"line {data[i][0]}, frame")[:, 0]
    steps = np.diff(numbers)
    if (steps < 1).any() or (numbers % 1 != 0).any():
        line = data[int(np.argmax(steps < 1)) + 1][0]
        raise FormatError(f"line {line}: frames must be increasing whole numbers.")
    rows = (numbers - numbers[:1]).astype(np.int64)
    if rows.size and rows[-1] >= _MOST_FRAMES:
        raise FormatError(f"spans {rows[-1] + 1} frames; at most {_MOST_FRAMES} are allowed.")
    whole = np.full((int(rows.max(initial=-1)) + 1, *points.shape[1:]), np.nan)
    whole[rows] = points
    return whole


def _whole(cells: list[str] | None, default: int, key: str) -> int:
    if not cells:
        return default
    value = to_numbers([cells[:1]], lambda *_: key)[0, 0]
    if value % 1 != 0 or not 0 <= value <= _MOST_FRAMES:
        raise FormatError(f"{key} is {cells[0]}; expected a whole number from 0 to {_MOST_FRAMES}.")
    return int(value)


def _rate(cells: list[str] | None, key: str = "the rate") -> float | None:
    if not cells:
        return None
    value = float(to_numbers([cells[:1]], lambda *_: key)[0, 0])
    if not 0 < value < np.inf:
        raise FormatError(f"{key} is {cells[0]}; it must be greater than 0 per second.")
    return value


def length_unit(unit: str) -> str | None:
    """Return a length unit in lower case, or None if it is empty.

    Raises:
        UnitsError: the unit is not supported.
    """
    unit = unit.strip()
    if unit and unit.lower() not in _LENGTHS:
        raise UnitsError(f'lengths are in "{unit}"; the unit must be one of {", ".join(_LENGTHS)}.')
    return unit.lower() or None


def _probe_size(row: list[str]) -> int:
    """Return the number of values per frame of an ArtiSynth probe."""
    try:
        return int(row[1])
    except (IndexError, ValueError) as error:
        raise FormatError(
            'line 2 must be like "Linear 9 0.02" in an ArtiSynth probe (interpolation, numbers per frame, step).'
        ) from error


@dataclass(frozen=True)
class RigidBody:
    """Rigid body: its markers and, if known, their positions on the body."""

    markers: tuple[int | str, ...]  # numbers of the markers in the table, counted from 1, or names
    #: positions in the body's coordinate frame, in the unit of the file, shape (N, 3); None if unknown
    points: Array | None


@errors_name_file
def read_body(description: AnyPath) -> RigidBody:
    """Read a rigid body: a marker description file (.rig), or the numbers or names of its markers (`5,6,7,8`).

    Raises:
        FormatError: the text is neither a file nor a list, or the body has fewer than three distinct markers.
    """
    pieces = [piece.strip() for piece in os.fspath(description).split(",")]
    if all(piece.isascii() and piece.isdigit() for piece in pieces):
        body = RigidBody(tuple(map(int, pieces)), None)
    elif len(pieces) > 1 and not Path(description).is_file():
        body = RigidBody(tuple(pieces), None)
    else:
        body = _read_rig(Path(description))
    listed = ", ".join(map(str, body.markers))
    if len(set(body.markers)) != len(body.markers) or 0 in body.markers or "" in body.markers:
        raise FormatError(f"markers {listed}: each must be listed once, numbered from 1.")
    if len(body.markers) < 3:
        raise FormatError(f"lists the markers {listed or 'none'}; at least three are needed.")
    return body


def _read_rig(path: Path) -> RigidBody:
    """Read Northern Digital's marker description: a count, then `number x y z views` for each marker."""
    lines = read_text(path, _MAX_RIG_BYTES, "latin-1").splitlines()
    counts = [line.partition(";")[0].strip() for line in lines if _RIG_COUNT in line.lower()]
    if len(counts) != 1 or not counts[0].isdigit():
        raise FormatError(
            f'is not a marker description: there is no line "{_RIG_COUNT}".',
            hint="Give a .rig file, or the numbers or names of the body's markers, such as 5,6,7,8 or HL,HR,HF.",
        )
    header = next((k for k, line in enumerate(lines) if line.split()[:4] == ["Marker", "X", "Y", "Z"]), len(lines))
    rows = [line.split() for line in lines[header + 1 :] if line.strip()]
    try:
        markers = tuple(int(row[0]) for row in rows)
        points = np.array([[float(value) for value in row[1:4]] for row in rows]).reshape(-1, 3)
    except (IndexError, ValueError) as error:
        raise FormatError(f'a marker is not written as "number x y z views" ({error}).') from error
    if len(markers) != int(counts[0]):
        raise FormatError(f"declares {counts[0]} markers but lists {len(markers)}.")
    if not np.isfinite(points).all():
        raise FormatError("has a position that is not a finite number.")
    return RigidBody(markers, points)
