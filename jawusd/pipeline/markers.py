"""Convert marker trajectories on head and jaw to poses of the jaw."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, FormatError, errors_name_file, explain_missing_packages, naming_file
from jawusd.base.inputs import check_input
from jawusd.formats.markers import MarkerTable, RigidBody, length_unit, mark_hidden, read_body, read_markers
from jawusd.geometry import rigid_fits, se3_inverse, transform_points

BODIES = ("head", "jaw")
LENGTH_UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
_MOST_C3D_FRAMES = 65_535  # maximum value of C3D's 16-bit frame counter
_BLOCK, _C3D_KEY = 512, 0x50
#: Byte order, and header offset of the byte that holds the scale's sign, for Intel, DEC and MIPS processors.
_BYTE_ORDERS = {b"T": ("<", 15), b"U": ("<", 13), b"V": (">", 12)}
_LABELS = ("LABELS", *(f"LABELS{k}" for k in range(2, 9)))  # C3D parameters that contain up to 255 labels each

# Maximum RMS residual of a rigid body [mm]; a larger residual means that a marker jumped or was mislabelled, and the
# frame gets no pose. The largest residual of 6,400 fits to recorded speech and clenching is 0.18 mm. Four markers with
# 0.3 mm of noise per axis exceed the limit once in 10 million frames (chi squared with six degrees of freedom).
_FARTHEST_MM = 1.0


def marker_poses(
    path: AnyPath, rigid: Mapping[str, str], rest_frame: int | None = None, unit: str = "mm"
) -> tuple[Array, float | None]:
    """Return T_head_jaw (F, 4, 4) [mm] from a table of markers, NaN where a rigid body is occluded, and the frame rate.

    Args:
        path: the table (see `formats.markers.read_markers`) or a C3D file.
        rigid: descriptions of the rigid bodies "head" and "jaw" (see `formats.markers.read_body`); without "head",
            the table is in head coordinates.
        rest_frame: frame that defines the marker positions of rigid bodies for which only marker names are given.
        unit: unit of the rigid bodies, and of tables that do not state a unit; a key of `LENGTH_UNITS_MM`.

    Raises:
        FormatError: a rigid body does not fit the markers, or the rest frame lacks one of them.
    """
    path = Path(path)
    with naming_file(path):
        if set(rigid) - set(BODIES) or "jaw" not in rigid:
            named = ", ".join(rigid) or "none"
            raise FormatError(f"rigid bodies given: {named}; jaw is required, head is optional.")
        table = read_c3d(path) if path.suffix.lower() == ".c3d" else read_markers(path)
        if table.unit not in (None, unit) and unit != "mm":
            raise FormatError(f"is in {table.unit}, but --length-unit is {unit}.")
        points = table.points * LENGTH_UNITS_MM[table.unit or unit]
        moved = {name: _moved(name, body, points, table.names, rest_frame, unit) for name, body in rigid.items()}
    return se3_inverse(moved["head"]) @ moved["jaw"] if "head" in moved else moved["jaw"], table.fps


def in_head(
    points: Array, names: tuple[str, ...], rigid: Mapping[str, str], rest_frame: int | None, unit: str
) -> Array:
    """Return points (F, N, 3) [mm] relative to the rigid body "head", NaN where it is occluded; see `marker_poses`.

    Raises FormatError if another rigid body is given, or if the head does not fit the markers.
    """
    if set(rigid) != {"head"}:
        raise FormatError(f'rigid bodies given: {", ".join(rigid)}; only "head" is allowed.')
    T = _moved("head", rigid["head"], points, names, rest_frame, unit)
    return transform_points(se3_inverse(T), points)


@explain_missing_packages()
@errors_name_file
def read_c3d(path: AnyPath) -> MarkerTable:
    """Read the points of a C3D file; points with a negative residual are occluded (https://www.c3d.org).

    Raises FormatError if the file is not C3D, UnitsError if its unit is not one of length, and MissingDependencyError.
    """
    import ezc3d

    path = Path(path)
    check_input(path)
    if not path.is_file():
        raise FormatError("there is no such file.")
    _check_length(path)
    try:
        file = ezc3d.c3d(str(path))
        data, given = file["data"], file["parameters"]["POINT"]
        points = np.array(data["points"][:3], dtype=np.float64).transpose(2, 1, 0)
        hidden = np.asarray(data["meta_points"]["residuals"])[0].T < 0
        names = [name for key in _LABELS if key in given for name in given[key]["value"]]
        unit, rate = (given[key]["value"] for key in ("UNITS", "RATE"))
    # exceptions that ezc3d raises for invalid, corrupt or truncated files
    except (OSError, RuntimeError, LookupError, ValueError, MemoryError) as error:
        raise FormatError(f"is not a readable C3D file ({error!s:.200}).") from error
    if not points.size:
        raise FormatError("has no points or no frames.")
    if len(points) >= _MOST_C3D_FRAMES:
        raise FormatError(
            f"has {_MOST_C3D_FRAMES} frames or more; C3D files cannot store that number.",
            hint="Export the take as TRC or CSV, or in parts.",
        )
    points[hidden] = np.nan
    points = mark_hidden(points)
    fps = float(rate[0]) if len(rate) and rate[0] > 0 else None
    named = tuple(name.strip() for name in names[: points.shape[1]])
    return MarkerTable(points, named, length_unit("".join(unit[:1])), fps)


def _check_length(path: Path) -> None:
    """Raise FormatError if a C3D file is truncated; ezc3d would return arbitrary frames, or hang."""
    with open(path, "rb") as file:
        head = file.read(_BLOCK)
        file.seek((max(head[0], 1) - 1) * _BLOCK + 3 if head else 0)
        order = _BYTE_ORDERS.get(file.read(1))
    if len(head) < _BLOCK or head[1] != _C3D_KEY or order is None:
        raise FormatError("is not a readable C3D file (invalid header).", path=path)
    points, analog, first, last = struct.unpack(f"{order[0]}4H", head[2:10])
    start = struct.unpack(f"{order[0]}H", head[16:18])[0]
    size = 4 if head[order[1]] & 0x80 else 2  # bytes per coordinate; a negative scale indicates floating point
    needed = (start - 1) * _BLOCK + (last - first + 1) * (4 * points + analog) * size
    found = path.stat().st_size
    if found < needed:
        raise FormatError(f"is truncated: {found} of {needed} bytes.", path=path, hint="Copy it again.")


def _columns(body: RigidBody, names: tuple[str, ...], count: int, called: str) -> list[int]:
    """Return the columns of a rigid body's markers; names may omit the prefix "SUBJECT:" of the table's names."""
    own = [name.rpartition(":")[2] for name in names]
    found = []
    for marker in body.markers:
        number = own.index(str(marker)) + 1 if str(marker) in own else None
        if isinstance(marker, int) and body.points is None and number not in (None, marker):
            raise FormatError(f'"{marker}" is ambiguous: the name of marker {number} and the number of another marker.')
        places = [marker - 1] if isinstance(marker, int) else [k for k, name in enumerate(names) if name == marker]
        if not places:
            places = [k for k, name in enumerate(own) if name == marker]
        if len(places) != 1 or not 0 <= places[0] < count:
            listed = f": {', '.join(names)}" if names else ", without names" if isinstance(marker, str) else ""
            times = f" {len(places)} times" if len(places) > 1 else ""
            raise FormatError(
                f"has {count} markers{listed}; the rigid body of the {called} uses marker {marker}{times}."
            )
        found.append(places[0])
    return found


def _moved(
    name: str, described: str, points: Array, names: tuple[str, ...], rest_frame: int | None, unit: str
) -> Array:
    """Return the poses (F, 4, 4) of a rigid body in the coordinate frame of the table."""
    body = read_body(described)
    seen = points[:, _columns(body, names, points.shape[1], name)]
    given = None if body.points is None else body.points * LENGTH_UNITS_MM[unit]
    shape = _shape_at(rest_frame, seen, body, name) if given is None else given
    T, off_mm = rigid_fits(shape, seen)
    if not np.isfinite(off_mm).any():
        raise FormatError(f"no frame shows three markers of the {name} that are not collinear.")
    if np.nanmedian(off_mm) > _FARTHEST_MM:
        raise FormatError(
            f"its markers {', '.join(map(str, body.markers))} are {np.nanmedian(off_mm):.3g} mm from their positions "
            f"on the rigid body of the {name}; at most {_FARTHEST_MM:g} mm is allowed.",
            hint="Check --rigid: the numbers of the markers, their order, and the units of table and rigid body.",
        )
    T[off_mm > _FARTHEST_MM] = np.nan
    return T


def _shape_at(rest_frame: int | None, seen: Array, body: RigidBody, name: str) -> Array:
    """Return the positions of the markers of a rigid body in the rest frame."""
    hint = "Give a frame (counted from 0) with the teeth in occlusion and all markers visible with --rest-frame."
    if rest_frame is None:
        raise FormatError(f"the positions of the markers on the rigid body of the {name} are unknown.", hint=hint)
    if not 0 <= rest_frame < len(seen):
        raise FormatError(f"has no frame {rest_frame}; it has frames 0 to {len(seen) - 1}.")
    hidden = [str(marker) for marker, point in zip(body.markers, seen[rest_frame]) if not np.isfinite(point).all()]
    if hidden:
        message = f"frame {rest_frame} does not show all markers of the {name}; occluded: {', '.join(hidden)}."
        raise FormatError(message, hint=hint)
    return seen[rest_frame]
