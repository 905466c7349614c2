"""Poses and jaw parameters as tables: CSV of any locale (see `jawusd.base.tables`) with a header, or JSON.

Poses:      frame, m00, m01, ... m33   (row-major T_skull_mandible [mm])
        or  frame, tx, ty, tz, qw, qx, qy, qz   (scalar-first quaternion)
Parameters: frame, d1, d2, d3   [mm]

The joint table contains the transform of the mandible joint for each ARKit shape, for rigs that sum joint deltas:

    shape,weight,d1,d2,d3,tx,ty,tz,rx_deg,ry_deg,rz_deg,qw,qx,qy,qz,clamped_mm
    JawOpen,0.5,...

Translations [mm] and rotations are relative to the neutral face, about the joint, in the axes of the skull frame (those
of `actor_skel.usdc`). Rotations are given twice: as angles about fixed x, then y, then z, and as a quaternion.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, FormatError, errors_name_file
from jawusd.base.tables import TextTable, is_number, read_table
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.text import read_json
from jawusd.geometry import make_transform, matrix_from_wxyz, rigidity_defect
from jawusd.geometry.so3 import wxyz_from_matrix

MATRIX_COLUMNS = tuple(f"m{row}{column}" for row in range(4) for column in range(4))
QUATERNION_COLUMNS = ("tx", "ty", "tz", "qw", "qx", "qy", "qz")
PARAMETER_COLUMNS = ("d1", "d2", "d3")
#: A file of animation keys, for messages.
KEYS_EXAMPLE = '{"fps": 24, "keys": [{"frame": 1, "d": [0, 0, 0]}]}'
_MAX_BYTES = 1 << 30
# Maximum deviation of a matrix from a rigid transform; matrices written with 5 decimals stay below it.
_RIGID_TOLERANCE = 1e-3
_ZERO_QUATERNION = 1e-6
_SHOWN = 60  # maximum length of a quoted line in messages [characters]
_JOINT_COLUMNS = "shape,weight,d1,d2,d3,tx,ty,tz,rx_deg,ry_deg,rz_deg,qw,qx,qy,qz,clamped_mm"


def _read_table(path: Path) -> TextTable:
    table = _json_table(path) if path.suffix.lower() == ".json" else read_table(path, _MAX_BYTES)
    named = [name for name in table.header if name]
    if named and all(map(is_number, named)):
        raise FormatError(
            f"has numbers in its first line: {', '.join(named):.{_SHOWN}}.",
            hint="The first line must name the columns, such as frame, d1, d2, d3.",
        )
    if len(set(named)) != len(named):
        raise FormatError(f"has a duplicate column: {', '.join(named)}.")
    return table


def _header_hint(table: TextTable) -> str:
    """Return a hint for a table that has no columns of parameters or poses."""
    lower = {name.lower() for name in table.header}
    if {"frame", *PARAMETER_COLUMNS} <= lower:
        return "Write the column names in lower case."
    if "jawopen" in lower:
        return "ARKit face captures are read by `jawusd animate RIG --arkit`."
    if len(table.header) == 1 and len(table.header[0].split()) > 1:
        return "Separate the columns by commas."
    if "d" in lower:
        return f"Write keys as {KEYS_EXAMPLE}."
    if {"tx", "rx"} <= lower:
        return "Write rotations as quaternions qw, qx, qy, qz, or poses as matrices m00 ... m33."
    return "Name the columns frame, d1, d2, d3: opening, laterotrusion and protrusion in mm."


def _json_table(path: Path) -> TextTable:
    records = read_json(path, _MAX_BYTES)
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        what = 'a list with an object for each frame, such as [{"frame": 1, "d1": 20, "d2": 2, "d3": 1}]'
        raise FormatError(f"must be {what}, or keys: {KEYS_EXAMPLE}.")
    if not records:
        raise FormatError("is empty.")
    names = list(records[0])
    for index, record in enumerate(records, start=1):
        if set(record) != set(names):
            raise FormatError(f"record {index} has different keys from the first one.")
    rows = [[str(record[name]) for name in names] for record in records]
    return TextTable(names, rows, [f"record {index}" for index in range(1, len(rows) + 1)])


def _numbers(table: TextTable, names: tuple[str, ...]) -> Array:
    """Return the named columns as finite numbers, shape (F, len(names))."""
    columns = [table.header.index(name) for name in names]
    out = table.numbers(columns)
    bad = np.argwhere(~np.isfinite(out))
    if len(bad):
        i, j = bad[0]
        raise FormatError(
            f"{table.named(i, columns[j])} is {table.rows[i][columns[j]]}; all values must be finite.",
            hint="Omit frames without a pose.",
        )
    return out


def _frames(table: TextTable, name: str) -> NDArray[np.int64]:
    if name not in table.header:
        timed = {"time", "timecode", "seconds"} & {column.lower() for column in table.header}
        hint = "Number the rows in a column frame, instead of giving times." if timed else None
        raise FormatError(f'has no column "{name}"; it has {_listed(table)}.', hint=hint)
    values = _numbers(table, (name,))[:, 0]
    uneven = np.flatnonzero((values != np.round(values)) | (np.abs(values) > 2**53))
    if uneven.size:
        row, column = int(uneven[0]), table.header.index(name)
        raise FormatError(f"{table.named(row, column)} is {table.rows[row][column]}; frames must be whole numbers.")
    return values.astype(np.int64)


def _listed(table: TextTable) -> str:
    return ", ".join(name for name in table.header if name) or "none"


@errors_name_file
def read_poses(path: AnyPath, columns: Mapping[str, str] | None = None) -> tuple[NDArray[np.int64], Array]:
    """Read frame numbers (F,) and T_skull_mandible (F, 4, 4) from CSV or JSON; the last matrix row may be omitted.

    `columns` are the file's names of columns that differ from the module's, e.g. {"tx": "X"}; rows are then numbered
    from 0 if there is no frame column.

    Raises:
        FormatError: a column is missing, a value is not a finite number, or a matrix is not rigid.
    """
    return _poses_of(_read_table(Path(path)), columns)


@errors_name_file
def read_poses_or_parameters(path: AnyPath) -> tuple[NDArray[np.int64], Array]:
    """Read frame numbers (F,), and parameters d [mm] (F, 3) or T_skull_mandible (F, 4, 4), from CSV or JSON.

    Raises:
        FormatError: a column is missing, a value is not a finite number, or a matrix is not rigid.
    """
    table = _read_table(Path(path))
    if PARAMETER_COLUMNS[0] in table.header:
        return _parameters_of(table)
    if not any({*names} <= {*table.header} for names in (MATRIX_COLUMNS[:12], QUATERNION_COLUMNS)):
        raise FormatError(
            f"has neither the columns {', '.join(PARAMETER_COLUMNS)} nor those of poses, "
            f"{MATRIX_COLUMNS[0]} ... {MATRIX_COLUMNS[11]} or {', '.join(QUATERNION_COLUMNS)}; "
            f"it has {_listed(table)}.",
            hint=_header_hint(table),
        )
    return _poses_of(table, None)


def _poses_of(table: TextTable, columns: Mapping[str, str] | None) -> tuple[NDArray[np.int64], Array]:
    called = {name: name for name in ("frame", *MATRIX_COLUMNS, *QUATERNION_COLUMNS)} | dict(columns or {})
    for name, theirs in (columns or {}).items():
        if theirs not in table.header:
            raise FormatError(f'has no column "{theirs}" to read as "{name}"; it has {_listed(table)}.')
    if columns and called["frame"] not in table.header:
        frames = np.arange(len(table.rows))
    else:
        frames = _frames(table, called["frame"])
    matrix, quaternion = (tuple(called[name] for name in names) for names in (MATRIX_COLUMNS, QUATERNION_COLUMNS))
    if {*matrix[:12]} <= {*table.header}:
        T = np.tile(np.eye(4), (len(frames), 1, 1))
        rows = 4 if {*matrix} <= {*table.header} else 3
        T[:, :rows] = _numbers(table, matrix[: 4 * rows]).reshape(-1, rows, 4)
    elif {*quaternion} <= {*table.header}:
        values = _numbers(table, quaternion)
        norm = np.linalg.norm(values[:, 3:], axis=1)
        if (norm < _ZERO_QUATERNION).any():
            raise FormatError(f"{table.places[int(norm.argmin())]}: the quaternion is zero.")
        T = make_transform(matrix_from_wxyz(values[:, 3:]), values[:, :3])
    else:
        raise FormatError(
            f"has neither the columns {matrix[0]} ... {matrix[11]} nor {', '.join(quaternion)}; "
            f"it has {_listed(table)}.",
            hint=None if columns else "Map other names with `jawusd fit --columns`, e.g. tx=X,ty=Y,...",
        )
    return frames, _checked_rigid(T, table)


def _checked_rigid(T: Array, table: TextTable) -> Array:
    defect = rigidity_defect(T) if len(T) else np.zeros(0)
    if defect.size and defect.max() > _RIGID_TOLERANCE:
        raise FormatError(
            f"{table.places[int(defect.argmax())]}: the matrix is not rigid (deviation "
            f"{defect.max():.2g}; at most {_RIGID_TOLERANCE:g} is allowed).",
            hint="Matrices are row-major with the translation [mm] in the last column.",
        )
    return T


@errors_name_file
def read_parameters(path: AnyPath) -> tuple[NDArray[np.int64], Array]:
    """Read frame numbers (F,) and parameters d [mm] (F, 3) from CSV or JSON.

    Raises:
        FormatError: a column is missing, or a value is not a finite number.
    """
    return _parameters_of(_read_table(Path(path)))


def _parameters_of(table: TextTable) -> tuple[NDArray[np.int64], Array]:
    frames = _frames(table, "frame")
    missing = [name for name in PARAMETER_COLUMNS if name not in table.header]
    if missing:
        raise FormatError(f'has no column "{missing[0]}"; it has {_listed(table)}.')
    return frames, _numbers(table, PARAMETER_COLUMNS)


def write_poses(path: AnyPath, frames: NDArray[np.int64], T: Array) -> None:
    """Write T_skull_mandible (F, 4, 4) of frames (F,) as CSV with matrix columns, atomically, in full precision.

    Raises:
        OutputError: the file cannot be written.
    """
    write_table(path, ("frame", *MATRIX_COLUMNS), frames, np.asarray(T).reshape(len(frames), 16))


def write_parameters(path: AnyPath, frames: NDArray[np.int64], d: Array) -> None:
    """Write parameters d [mm] (F, 3) as CSV, atomically, in full precision.

    Raises:
        OutputError: the file cannot be written.
    """
    write_table(path, ("frame", *PARAMETER_COLUMNS), frames, d)


def write_table(path: AnyPath, header: tuple[str, ...], frames: NDArray[np.int64], values: Array) -> None:
    """Write frames (F,) and values (F, len(header) - 1) as CSV, atomically; the first column is the frame.

    Raises:
        OutputError: the file cannot be written.
    """
    lines = [",".join(header)]
    for frame, row in zip(frames, values, strict=True):
        lines.append(",".join([str(int(frame)), *(repr(float(value)) for value in row)]))
    write_text_atomic(path, "\n".join([*lines, ""]))


@dataclass(frozen=True, eq=False)
class JointDelta:
    """Joint transform of one ARKit shape."""

    shape: str  # ARKit's name for the blend shape
    weight: float  # weight of the blend shape, 0 to 1
    d: Array  # jaw parameters of the pose [mm], shape (3,)
    translation_mm: Array  # translation of the joint in skull axes, shape (3,)
    rotation: Array  # rotation of the joint in skull axes, shape (3, 3)
    clamped_mm: float  # distance by which the jaw parameters were clamped to the bound


def save_joint_table(path: AnyPath, rows: Iterable[JointDelta]) -> None:
    """Write a joint table atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    lines = [_JOINT_COLUMNS]
    for row in rows:
        sizes = [*row.d, *row.translation_mm, *np.rad2deg(fixed_angles(row.rotation))]
        places = [(size, 6) for size in sizes] + [(part, 9) for part in wxyz_from_matrix(row.rotation)]
        numbers = [f"{round(float(value), digits) + 0.0:.9g}" for value, digits in [*places, (row.clamped_mm, 6)]]
        lines.append(",".join([row.shape, f"{row.weight:g}", *numbers]))
    write_text_atomic(path, "\n".join(lines) + "\n")


def fixed_angles(R: Array) -> Array:
    """Return angles [rad] (3,) about fixed axes x, y, z of R = Rz Ry Rx (3, 3), |y| < 90 degrees (Craig, eq. 2.66)."""
    about_y = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    return np.array([np.arctan2(R[2, 1], R[2, 2]), about_y, np.arctan2(R[1, 0], R[0, 0])])
