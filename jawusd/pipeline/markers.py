"""Turn tables of markers on head and jaw into poses of the jaw."""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import FormatError, explain_missing_packages
from jawusd.base.inputs import check_input
from jawusd.formats.markers import MarkerTable, length_unit, mark_hidden, read_markers
from jawusd.formats.rigid_bodies import RigidBody, read_body
from jawusd.geometry import rigid_fits, se3_inverse

BODIES = ("head", "jaw")
LENGTH_UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
_MOST_C3D_FRAMES = 65_535  # of 16 bits
_BLOCK, _C3D_KEY = 512, 0x50
#: Byte order, and place of the scale's sign in the header, by the processor that wrote the file: Intel, DEC, MIPS.
_BYTE_ORDERS = {b"T": ("<", 15), b"U": ("<", 13), b"V": (">", 12)}
_LABELS = ("LABELS", *(f"LABELS{k}" for k in range(2, 9)))  # of 255 points each

# Root mean square distance of a rigid body's markers from their places on it, beyond which a frame has no pose: a
# marker jumped or was taken for another. Of 6,400 fits to recorded speech and clench the largest is 0.18 mm; chance
# passes it once in 10 million where four markers have 0.3 mm of noise per axis (chi squared of six degrees of freedom).
_FARTHEST_MM = 1.0


def marker_poses(
    path: str | os.PathLike[str], rigid: Mapping[str, str], rest_frame: int | None = None, unit: str = "mm"
) -> tuple[Array, float | None]:
    """Return T_head_jaw (F, 4, 4) [mm] of a table of markers, NaN where a rigid body is out of sight, and its rate.

    Args:
        path: the table, see `formats.markers.read_markers`, or C3D.
        rigid: descriptions of the rigid bodies "head" and "jaw", see `formats.rigid_bodies.read_body`; without a head
            the table is in coordinates of the head.
        rest_frame: where rigid bodies of which only the markers are known have their shape and frame from.
        unit: of the rigid bodies, and of a table that does not say its own; a key of `LENGTH_UNITS_MM`.

    Raises:
        FormatError: a rigid body that is none of these, that is missing, or that the markers do not fit; no rest frame
            where one is needed, or one in which a marker is missing.
    """
    path = Path(path)
    unknown = sorted(set(rigid) - set(BODIES))
    if unknown or "jaw" not in rigid:
        named = ", ".join(rigid) or "none"
        raise FormatError(f"rigid bodies named: {named}; jaw is needed, head may be added.", path=path)
    table = read_c3d(path) if path.suffix.lower() == ".c3d" else read_markers(path)
    if table.unit not in (None, unit) and unit != "mm":
        raise FormatError(f"says that its lengths are in {table.unit}, --length-unit says {unit}.", path=path)
    points = table.points * LENGTH_UNITS_MM[table.unit or unit]
    bodies = {name: read_body(description) for name, description in rigid.items()}
    moved = {
        name: _moved(name, body, points, table.names, rest_frame, LENGTH_UNITS_MM[unit], path)
        for name, body in bodies.items()
    }
    return se3_inverse(moved["head"]) @ moved["jaw"] if "head" in moved else moved["jaw"], table.fps


@explain_missing_packages()
def read_c3d(path: str | os.PathLike[str]) -> MarkerTable:
    """Read the points of a C3D file; points of a residual below 0 are out of sight (https://www.c3d.org).

    Raises:
        FormatError: not such a file.
        UnitsError: a unit that is none of length.
        MissingDependencyError: ezc3d is not installed.
    """
    import ezc3d

    path = Path(path)
    check_input(path)
    if not path.is_file():
        raise FormatError("there is no such file.", path=path)
    _check_length(path)
    try:
        file = ezc3d.c3d(str(path))
        data, given = file["data"], file["parameters"]["POINT"]
        points = np.array(data["points"][:3], dtype=np.float64).transpose(2, 1, 0)
        hidden = np.asarray(data["meta_points"]["residuals"])[0].T < 0
        names = [name for key in _LABELS if key in given for name in given[key]["value"]]
        unit, rate = (given[key]["value"] for key in ("UNITS", "RATE"))
    # ezc3d raises these for files that are none, damaged or cut off
    except (OSError, RuntimeError, LookupError, ValueError, MemoryError) as error:
        raise FormatError(f"is not a C3D file that can be read ({error!s:.200}).", path=path) from error
    if not points.size:
        raise FormatError("holds no points, or no frames.", path=path)
    if len(points) >= _MOST_C3D_FRAMES:
        raise FormatError(
            f"holds {_MOST_C3D_FRAMES} frames or more, which C3D cannot count.",
            path=path,
            hint="Export the take as TRC or CSV, or in parts.",
        )
    points[hidden] = np.nan
    points = mark_hidden(points)
    fps = float(rate[0]) if len(rate) and rate[0] > 0 else None
    return MarkerTable(
        points, tuple(name.strip() for name in names[: points.shape[1]]), length_unit("".join(unit[:1]), path), fps
    )


def _check_length(path: Path) -> None:
    """Check that a C3D file holds all its frames: ezc3d reads the rest of them, or for ever."""
    with open(path, "rb") as file:
        head = file.read(_BLOCK)
        file.seek((max(head[0], 1) - 1) * _BLOCK + 3 if head else 0)
        order = _BYTE_ORDERS.get(file.read(1))
    if len(head) < _BLOCK or head[1] != _C3D_KEY or order is None:
        raise FormatError("is not a C3D file that can be read (its header is not one).", path=path)
    points, analog, first, last = struct.unpack(f"{order[0]}4H", head[2:10])
    start = struct.unpack(f"{order[0]}H", head[16:18])[0]
    size = 4 if head[order[1]] & 0x80 else 2  # the sign of the scale: floating point, or integers
    needed = (start - 1) * _BLOCK + (last - first + 1) * (4 * points + analog) * size
    found = path.stat().st_size
    if found < needed:
        raise FormatError(f"is cut off: {found} of {needed} bytes.", path=path, hint="Copy it again.")


def _columns(body: RigidBody, names: tuple[str, ...], count: int, called: str, path: Path) -> list[int]:
    """Return where the markers of a rigid body stand in the table; names may leave out the subject before a colon."""
    own = [name.rpartition(":")[2] for name in names]
    found = []
    for marker in body.markers:
        if (
            isinstance(marker, int)
            and str(marker) in own
            and body.points is None
            and own.index(str(marker)) != marker - 1
        ):
            raise FormatError(
                f'"{marker}" is the name of marker {own.index(str(marker)) + 1} and the number of another.', path=path
            )
        places = [marker - 1] if isinstance(marker, int) else [k for k, name in enumerate(names) if name == marker]
        if not places:
            places = [k for k, name in enumerate(own) if name == marker]
        if len(places) != 1 or not 0 <= places[0] < count:
            listed = f": {', '.join(names)}" if names else ", without names" if isinstance(marker, str) else ""
            times = f" {len(places)} times" if len(places) > 1 else ""
            raise FormatError(
                f"has {count} markers{listed}; the rigid body of the {called} names marker {marker}{times}.", path=path
            )
        found.append(places[0])
    return found


def _moved(
    name: str,
    body: RigidBody,
    points: Array,
    names: tuple[str, ...],
    rest_frame: int | None,
    unit_mm: float,
    path: Path,
) -> Array:
    """Return how a rigid body lies in the table's frame, (F, 4, 4)."""
    seen = points[:, _columns(body, names, points.shape[1], name, path)]
    shape = _shape_at(rest_frame, seen, body, name, path) if body.points is None else body.points * unit_mm
    T, off_mm = rigid_fits(shape, seen)
    if not np.isfinite(off_mm).any():
        raise FormatError(f"no frame shows three markers of the {name} that do not lie on one line.", path=path)
    if np.nanmedian(off_mm) > _FARTHEST_MM:
        raise FormatError(
            f"its markers {', '.join(map(str, body.markers))} lie {np.nanmedian(off_mm):.3g} mm from their places on "
            f"the rigid body of the {name}, at most {_FARTHEST_MM:g} mm are allowed.",
            path=path,
            hint="Check --rigid: the numbers of the markers, their order, and the units of table and rigid body.",
        )
    T[off_mm > _FARTHEST_MM] = np.nan
    return T


def _shape_at(rest_frame: int | None, seen: Array, body: RigidBody, name: str, path: Path) -> Array:
    """Return where the markers of a rigid body are at the rest frame."""
    hint = "Name a frame (counted from 0) with the teeth in occlusion and all markers in sight with --rest-frame."
    if rest_frame is None:
        raise FormatError(f"the places of the markers of the {name} on their body are unknown.", path=path, hint=hint)
    if not 0 <= rest_frame < len(seen):
        raise FormatError(f"has no frame {rest_frame}; it has 0 to {len(seen) - 1}.", path=path)
    hidden = [str(marker) for marker, point in zip(body.markers, seen[rest_frame]) if not np.isfinite(point).all()]
    if hidden:
        raise FormatError(
            f"frame {rest_frame} does not show all markers of the {name}: {', '.join(hidden)} is out of sight.",
            path=path,
            hint=hint,
        )
    return seen[rest_frame]
