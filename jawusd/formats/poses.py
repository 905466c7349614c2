"""Poses and parameters as tables: CSV (comma, semicolon or tab) with a header, or JSON with the same columns.

Poses:      frame, m00, m01, ... m33   (row-major T_skull_mandible [mm])
        or  frame, tx, ty, tz, qw, qx, qy, qz   (scalar-first quaternion)
Parameters: frame, d1, d2, d3   [mm]
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jawusd.errors import FormatError
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.text import parse_json, read_text
from jawusd.geometry import make_transform, matrix_from_wxyz, rigidity_defect
from jawusd.geometry.arrays import Array

MATRIX_COLUMNS = tuple(f"m{row}{column}" for row in range(4) for column in range(4))
QUATERNION_COLUMNS = ("tx", "ty", "tz", "qw", "qx", "qy", "qz")
PARAMETER_COLUMNS = ("d1", "d2", "d3")
_MAX_BYTES = 1 << 30
# A matrix written with 5 decimals is rigid to about this.
_RIGID_TOLERANCE = 1e-3
_ZERO_QUATERNION = 1e-6


def _read_table(path: Path) -> dict[str, list[str]]:
    """Return the columns of a CSV or JSON table as text."""
    text = read_text(path, _MAX_BYTES, "utf-8-sig")
    if path.suffix.lower() == ".json":
        return _json_columns(text, path)
    try:
        rows = list(csv.reader(io.StringIO(text), strict=True, delimiter=_delimiter(text)))
    except csv.Error as error:
        raise FormatError(f"is not a CSV table ({error}).", path=path) from error
    rows = [row for row in rows if row and not row[0].lstrip().startswith("#")]
    if not rows:
        raise FormatError("is empty; the first line must name the columns.", path=path)
    header = [name.strip() for name in rows[0]]
    if len(set(header)) != len(header):
        raise FormatError(f"names a column twice: {', '.join(header)}.", path=path)
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(header):
            raise FormatError(f"line {number} has {len(row)} values, the header names {len(header)}.", path=path)
    return {name: [row[i] for row in rows[1:]] for i, name in enumerate(header)}


def _delimiter(text: str) -> str:
    """Return what separates the column names: comma, semicolon or tab, whichever is most frequent among them."""
    header = next((line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), "")
    return max(",;\t", key=header.count)


def _json_columns(text: str, path: Path) -> dict[str, list[str]]:
    records = parse_json(text, path)
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        raise FormatError("must be a JSON list of objects, one per frame.", path=path)
    if not records:
        raise FormatError("is empty.", path=path)
    names = list(records[0])
    for index, record in enumerate(records):
        if set(record) != set(names):
            raise FormatError(f"record {index} has other keys than the first one.", path=path)
    return {name: [str(record[name]) for record in records] for name in names}


def _numbers(columns: dict[str, list[str]], names: tuple[str, ...], path: Path) -> Array:
    """Return the named columns as finite numbers, shape (F, len(names))."""
    out = np.empty((len(columns[names[0]]), len(names)))
    for j, name in enumerate(names):
        for i, text in enumerate(columns[name]):
            try:
                out[i, j] = float(text)
            except ValueError as error:
                raise FormatError(f'row {i + 1}, column "{name}": "{text}" is not a number.', path=path) from error
    bad = np.argwhere(~np.isfinite(out))
    if len(bad):
        i, j = bad[0]
        raise FormatError(
            f'row {i + 1}, column "{names[j]}" is {columns[names[j]][i]}; all values must be finite.',
            path=path,
            hint="Leave out frames without a pose.",
        )
    return out


def _frames(columns: dict[str, list[str]], name: str, path: Path) -> NDArray[np.int64]:
    if name not in columns:
        raise FormatError(f'has no column "{name}"; it has {", ".join(columns) or "none"}.', path=path)
    values = _numbers(columns, (name,), path)[:, 0]
    uneven = np.flatnonzero((values != np.round(values)) | (np.abs(values) > 2**53))
    if uneven.size:
        row = int(uneven[0])
        raise FormatError(
            f'row {row + 1}, column "{name}" is {columns[name][row]}; frames must be whole numbers.', path=path
        )
    return values.astype(np.int64)


def read_poses(
    path: str | os.PathLike[str], columns: Mapping[str, str] | None = None
) -> tuple[NDArray[np.int64], Array]:
    """Read jaw poses from CSV or JSON: frame numbers (F,) and T_skull_mandible (F, 4, 4).

    Args:
        path: table with matrix or quaternion columns, see the module; the last matrix row may be left out.
        columns: names in the file of columns that are not named as in the module, e.g. {"tx": "X"}; without a frame
            column its rows are then numbered from 0.

    Raises:
        FormatError: columns missing, a value that is not a finite number, or a matrix that is not rigid.
    """
    path = Path(path)
    table = _read_table(path)
    called = {name: name for name in ("frame", *MATRIX_COLUMNS, *QUATERNION_COLUMNS)} | dict(columns or {})
    for name, theirs in (columns or {}).items():
        if theirs not in table:
            raise FormatError(f'has no column "{theirs}" to be read as "{name}"; it has {", ".join(table)}.', path=path)
    if columns and called["frame"] not in table:
        frames = np.arange(len(next(iter(table.values()))))
    else:
        frames = _frames(table, called["frame"], path)
    matrix, quaternion = (tuple(called[name] for name in names) for names in (MATRIX_COLUMNS, QUATERNION_COLUMNS))
    if all(name in table for name in matrix[:12]):
        T = np.tile(np.eye(4), (len(frames), 1, 1))
        rows = 4 if all(name in table for name in matrix) else 3
        T[:, :rows] = _numbers(table, matrix[: 4 * rows], path).reshape(-1, rows, 4)
    elif all(name in table for name in quaternion):
        values = _numbers(table, quaternion, path)
        norm = np.linalg.norm(values[:, 3:], axis=1)
        if (norm < _ZERO_QUATERNION).any():
            raise FormatError(f"row {int(norm.argmin()) + 1}: the quaternion is zero.", path=path)
        T = make_transform(matrix_from_wxyz(values[:, 3:]), values[:, :3])
    else:
        raise FormatError(
            f"has neither the columns {matrix[0]} ... {matrix[11]} nor {', '.join(quaternion)}; "
            f"it has {', '.join(table)}.",
            path=path,
            hint=None if columns else "`jawusd fit` takes other names with --columns, e.g. tx=X,ty=Y,...",
        )
    return frames, _checked_rigid(T, path)


def _checked_rigid(T: Array, path: Path) -> Array:
    defect = rigidity_defect(T) if len(T) else np.zeros(0)
    if defect.size and defect.max() > _RIGID_TOLERANCE:
        raise FormatError(
            f"row {int(defect.argmax()) + 1}: the matrix is not rigid (off by {defect.max():.2g}, "
            f"allowed {_RIGID_TOLERANCE:g}).",
            path=path,
            hint="Matrices are row-major with the translation [mm] in the last column.",
        )
    return T


def read_parameters(path: str | os.PathLike[str]) -> tuple[NDArray[np.int64], Array]:
    """Read frame numbers (F,) and parameters d [mm] (F, 3) from CSV or JSON.

    Raises:
        FormatError: columns missing, or a value that is not a finite number.
    """
    path = Path(path)
    columns = _read_table(path)
    frames = _frames(columns, "frame", path)
    missing = [name for name in PARAMETER_COLUMNS if name not in columns]
    if missing:
        raise FormatError(f'has no column "{missing[0]}"; it has {", ".join(columns)}.', path=path)
    return frames, _numbers(columns, PARAMETER_COLUMNS, path)


def table_columns(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Return the column names of a CSV or JSON table.

    Raises:
        FormatError: the file is not such a table.
    """
    return tuple(_read_table(Path(path)))


def write_poses(path: str | os.PathLike[str], frames: NDArray[np.int64], T: Array) -> None:
    """Write T_skull_mandible (F, 4, 4) of frames (F,) as CSV with matrix columns, atomically and with all digits.

    Raises:
        OutputError: the file cannot be written.
    """
    write_table(path, ("frame", *MATRIX_COLUMNS), frames, np.asarray(T).reshape(len(frames), 16))


def write_parameters(path: str | os.PathLike[str], frames: NDArray[np.int64], d: Array) -> None:
    """Write parameters d [mm] (F, 3) as CSV, atomically and with all digits.

    Raises:
        OutputError: the file cannot be written.
    """
    write_table(path, ("frame", *PARAMETER_COLUMNS), frames, d)


def write_table(
    path: str | os.PathLike[str], header: tuple[str, ...], frames: NDArray[np.int64], values: Array
) -> None:
    """Write frames (F,) and values (F, len(header) - 1) as CSV, atomically; the header's first column is the frame.

    Raises:
        OutputError: the file cannot be written.
    """
    lines = [",".join(header)]
    for frame, row in zip(frames, values, strict=True):
        lines.append(",".join([str(int(frame)), *(repr(float(value)) for value in row)]))
    write_text_atomic(path, "\n".join([*lines, ""]))
