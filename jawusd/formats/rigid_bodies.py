"""Read rigid bodies: a marker description of Northern Digital (`.rig`), or numbers or names of markers in the table."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import FormatError, errors_name_file
from jawusd.base.tables import read_text

_MAX_BYTES = 1 << 24
_RIG_COUNT = "number of markers"


@dataclass(frozen=True)
class RigidBody:
    """Rigid body: its markers and, if known, their positions on the body."""

    markers: tuple[int | str, ...]  # numbers of the markers in the table, counted from 1, or names
    #: positions in the body's coordinate frame, in the unit of the file, shape (N, 3); None if unknown
    points: Array | None


def read_body(description: str | os.PathLike[str]) -> RigidBody:
    """Read a rigid body: a marker description file (.rig), or the numbers or names of its markers (`5,6,7,8`).

    Raises:
        FormatError: the text is neither a file nor a list, or the body has fewer than three distinct markers.
    """
    text = os.fspath(description)
    numbers = [piece.strip() for piece in text.split(",")]
    if all(piece.isascii() and piece.isdigit() for piece in numbers):
        return _checked(RigidBody(tuple(int(piece) for piece in numbers), None), text)
    if len(numbers) > 1 and not Path(text).is_file():
        return _checked(RigidBody(tuple(numbers), None), text)
    return _checked(_read_rig(Path(description)), text)


@errors_name_file
def _read_rig(path: Path) -> RigidBody:
    """Read Northern Digital's marker description: a count, then `number x y z views` for each marker."""
    lines = read_text(path, _MAX_BYTES, "latin-1").splitlines()
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


def _checked(body: RigidBody, where: str) -> RigidBody:
    numbers = ", ".join(map(str, body.markers))
    if len(set(body.markers)) != len(body.markers) or 0 in body.markers or "" in body.markers:
        raise FormatError(f"markers {numbers}: each must be listed once, numbered from 1.", path=where)
    if len(body.markers) < 3:
        raise FormatError(f"lists the markers {numbers or 'none'}; at least three are needed.", path=where)
    return body
