"""Read STL and OBJ, and the common parts of all mesh readers.

STL (3D Systems, "StereoLithography Interface Specification", 1989): triangles do not share vertices. A binary file has
an 80-byte header, the number of triangles, and 50 bytes per triangle: normal, corners, and two bytes that are often
used for colours.

Wavefront OBJ ("Object Files (.obj)", Alias|Wavefront, 1995): vertices, texture coordinates and faces. Negative indices
count backwards from the last vertex before the face. Vertices may have a colour after their coordinates, 0 to 1
(MeshLab, Blender) or 0 to 255. Materials, normals, groups, lines and curves are ignored.
"""

from __future__ import annotations

import re
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import CaptureError, errors_name_file

Indices = NDArray[np.int64]

MOST_BYTES = 4 << 30
MOST_TRIANGLES, MOST_VERTICES = 10_000_000, 30_000_000
NO_COLOUR = 128  # gray, the colour of vertices without a colour

COPY_AGAIN = "Copy the file again from its source, or export it again."


class MeshData(NamedTuple):
    """Mesh as read from a file."""

    vertices: Array  # vertex positions, shape (V, 3)
    faces: Indices  # vertex indices of triangles, shape (F, 3); they may exceed the number of vertices
    colors: NDArray[np.uint8] | None = None  # red, green and blue of each vertex, shape (V, 3)
    uv: Array | None = None  # texture coordinates of the triangle corners, shape (F, 3, 2)


def read_mesh_bytes(path: Path) -> bytes:
    """Return the content of a mesh file.

    Raises:
        CaptureError: the file is larger than MOST_BYTES.
        OSError: the file cannot be read.
    """
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise CaptureError(
            f"is {size:,} bytes long; at most {MOST_BYTES:,} bytes are allowed.", hint="Decimate the mesh."
        )
    return path.read_bytes()


def check_count(count: int, what: str) -> None:
    """Check the number of "vertices", "triangles" or "faces" of a file before reading them.

    Raises:
        CaptureError: the number is too large.
    """
    most = MOST_VERTICES if what == "vertices" else MOST_TRIANGLES
    if count > most:
        raise CaptureError(f"has {count:,} {what}; at most {most:,} are allowed.", hint="Decimate the mesh.")


def cut_off(found: int, said: int, what: str) -> CaptureError:
    """Return the error for a truncated file."""
    return CaptureError(f"is truncated: it has {found} of {said} {what}.", hint=COPY_AGAIN)


def byte_colors(values: Array) -> NDArray[np.uint8] | None:
    """Convert colours (n, 3) of 0 to 1, 0 to 255 or 0 to 65535 to bytes, NaN to gray; None for negative values."""
    top = np.nanmax(values, initial=0.0)
    if np.nanmin(values, initial=0.0) < 0 or top > 65535:
        return None  # negative values are not colours but, for example, normals
    scale = 255.0 if top <= 1 else 1.0 if top <= 255 else 1 / 257
    return np.where(np.isfinite(values), np.round(values * scale), NO_COLOUR).astype(np.uint8)


def cut_polygons(vertices: Array, counts: Indices, corners: Indices) -> tuple[Indices, Indices]:
    """Triangulate polygons as fans: return the positions (F, 3) of corners in `corners`, and vertices (F, 3).

    A fan starts at the first corner from which all triangles face the same way as the polygon, so that concave quads
    are correct; polygons with fewer than three corners are dropped. `counts` (P,) are the numbers of corners of each
    polygon, `corners` (C,) the vertex indices of all.
    """
    starts = np.cumsum(counts) - counts
    triangles, owners = [], []
    for n in np.unique(counts[counts >= 3]):
        owner = np.flatnonzero(counts == n)
        places = starts[owner, None] + np.arange(n)
        if n > 3:
            places = np.take_along_axis(places, _fan_starts(vertices, corners[places]), axis=1)
        fan = np.stack([np.zeros(n - 2, np.int64), np.arange(1, n - 1), np.arange(2, n)], axis=1)
        triangles.append(places[:, fan].reshape(-1, 3))
        owners.append(np.repeat(owner, n - 2))
    if not triangles:
        return np.zeros((0, 3), np.int64), np.zeros((0, 3), np.int64)
    order = np.argsort(np.concatenate(owners), kind="stable")
    found = np.concatenate(triangles)[order]
    return found, corners[found]


def _fan_starts(vertices: Array, polygons: Indices) -> Indices:
    """Return the corner order of each polygon (m, n), rotated to start at a valid fan apex, shape (m, n)."""
    m, n = polygons.shape
    turns = (np.arange(n)[:, None] + np.arange(n)) % n  # row k has all corners, beginning with corner k
    chosen = np.zeros(m, np.int64)
    points = vertices[np.clip(polygons, 0, len(vertices) - 1)]
    open_ones = np.ones(m, bool)
    with np.errstate(invalid="ignore", over="ignore"):
        normal = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)
        for k in range(n):
            around = points[:, turns[k]]
            sides = around[:, 1:] - around[:, :1]
            facing = np.einsum("mti,mi->mt", np.cross(sides[:, :-1], sides[:, 1:]), normal)
            fits = open_ones & (facing >= 0).all(axis=1)
            chosen[fits], open_ones = k, open_ones & ~fits
            if not open_ones.any():
                break
    return turns[chosen]


_HEADER = 84
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_LENGTHS = (1e-6, 1e5)  # range of plausible coordinates, to detect triangles beyond the declared count
_SOLID = re.compile(rb"\n[ \t]*(end)?solid\b[^\n]*")
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)")


@errors_name_file
def read_stl(path: Path) -> MeshData:
    """Read an STL file, with three vertices per triangle.

    Raises:
        CaptureError: the file is truncated, the count is wrong, or a number is invalid.
    """
    data = read_mesh_bytes(path)
    begins_as_text = data[:512].removeprefix(b"\xef\xbb\xbf").lstrip()[:5].lower() == b"solid"
    # A binary header may also start with "solid", but its triangle count contains a zero byte, which text does not.
    corners = _text(data) if begins_as_text and 0 not in data[80:_HEADER] else _binary(data)
    return MeshData(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def _binary(data: bytes) -> Array:
    if len(data) < _HEADER:
        raise CaptureError("is neither a text nor a binary STL file.", hint="Export it again.")
    said = int.from_bytes(data[_HEADER - 4 : _HEADER], "little")
    whole = (len(data) - _HEADER) // _TRIANGLE.itemsize
    # The program that wrote the file did not know the count, or the file is not STL.
    if said > max(whole, MOST_TRIANGLES):
        raise CaptureError(
            f"declares {said:,} triangles, but has room for {whole:,}.",
            hint="Export it again, with the suffix of its format.",
        )
    if said > whole:
        raise cut_off(whole, said, "triangles")
    check_count(said, "triangles")
    rows = np.frombuffer(data, _TRIANGLE, whole, _HEADER)["corners"].astype(np.float64)
    more = int(_are_triangles(rows[said:]).sum())
    if more:
        raise CaptureError(f"declares {said} triangles, but {more} more follow.", hint="Export it again.")
    return rows[:said]


def _are_triangles(corners: Array) -> Mask:
    size = np.abs(corners)
    with np.errstate(invalid="ignore", over="ignore"):
        lengths = ((size == 0) | ((size > _LENGTHS[0]) & (size < _LENGTHS[1]))).all(axis=(1, 2))
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(lengths & (np.abs(area) > 0).any(axis=1))


def _text(data: bytes) -> Array:
    data = (b"\n" + data.removeprefix(b"\xef\xbb\xbf")).lower().replace(b"\r", b"\n")
    ends = [bool(word) for word in _SOLID.findall(data)]
    body = _SOLID.sub(b"", data)  # remove names of solids, which may contain keywords
    whole = body.count(b"endfacet")
    facets = body.count(b"facet") - whole
    check_count(facets, "triangles")
    if facets != whole or ends.count(True) != ends.count(False):
        raise CaptureError(f'is truncated after {whole} triangles: "endsolid" is missing.', hint=COPY_AGAIN)
    rows = _VERTEX.findall(body)
    if len(rows) != 3 * facets:
        raise CaptureError(
            f"has {len(rows)} vertices in {facets} facets; each facet needs three.", hint="Export it again."
        )
    return np.fromiter(map(float, chain.from_iterable(rows)), np.float64).reshape(-1, 3, 3)


_MARKS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|[-+]?(?:nan|inf(?:inity)?)", re.IGNORECASE)
# Comment with the face count that MeshLab writes above the faces.
_COUNTED = re.compile(r"^#\s*Faces:\s*(\d+)\s*$", re.MULTILINE | re.IGNORECASE)
# Minimum fraction of unused vertices for a file without a final line break to count as truncated: no count is declared.
_LEAST_LOOSE = 0.1


@errors_name_file
def read_obj(path: Path) -> MeshData:
    """Read an OBJ file; vertices and faces keep the file's order.

    Raises:
        CaptureError: the file is truncated, or a number or an index is invalid.
    """
    data = read_mesh_bytes(path)
    text = data.decode(_MARKS.get(data[:2], "utf-8-sig"), errors="replace")
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    points: list[list[str]] = []
    places: list[list[str]] = []
    counts: list[int] = []
    corners: list[str] = []
    # Per face with negative indices: numbers of corners, vertices and texture coordinates before the face.
    relative: list[tuple[int, int, int]] = []
    for line in text.replace("\\\n", " ").split("\n"):
        words = (line.partition("#")[0] if "#" in line else line).split()
        kind = words[0] if words else ""
        if kind == "v":
            points.append(words[1:])
        elif kind == "vt":
            places.append(words[1:3])
        elif kind in ("f", "fo"):
            if "-" in line:
                relative.append((len(corners), len(points), len(places)))
            counts.append(len(words) - 1)
            corners += words[1:]
    check_count(len(points), "vertices")
    check_count(sum(counts) - 2 * len(counts), "triangles")
    vertices, colors = _points(points)
    at, texture = _indices(corners, counts, relative)
    placed, faces = cut_polygons(vertices, np.array(counts, np.int64), at)
    _check_whole(text, len(counts), vertices, faces)
    return MeshData(vertices, faces, colors, _uv(places, texture, placed))


def _points(rows: list[list[str]]) -> tuple[Array, NDArray[np.uint8] | None]:
    """Return vertices (V, 3) and, if there are any, vertex colours; vertices without a colour are gray."""
    vertices = _numbers([row[:3] for row in rows], 3)
    coloured = [k for k, row in enumerate(rows) if len(row) >= 6]
    if not coloured:
        return vertices, None
    colors = np.full((len(rows), 3), np.nan)
    colors[coloured] = _numbers([rows[k][3:6] for k in coloured], 3)
    return vertices, byte_colors(colors)


def _numbers(rows: list[list[str]], columns: int) -> Array:
    try:
        values = np.fromiter(map(float, chain.from_iterable(rows)), np.float64)
        if len(values) == columns * len(rows):
            return values.reshape(-1, columns)
    except ValueError:
        pass
    for row in rows:
        if len(row) < columns or not all(_NUMBER.fullmatch(word) for word in row):
            raise _wrong(f"v {' '.join(row)}", f"{columns} numbers")
    raise ValueError("a number cannot be read")


def _indices(
    corners: list[str], counts: list[int], relative: list[tuple[int, int, int]]
) -> tuple[Indices, Indices | None]:
    """Return the vertex index and, if all corners have one, the texture index of each corner (C,), from 0."""
    texture = None
    try:
        if any("/" in corner for corner in corners):
            parts = [corner.split("/", 2) for corner in corners]
            at = np.fromiter((int(part[0]) for part in parts), np.int64, len(parts))
            if all(len(part) > 1 and part[1] for part in parts):
                texture = np.fromiter((int(part[1]) for part in parts), np.int64, len(parts))
        else:
            at = np.fromiter(map(int, corners), np.int64, len(corners))
    except ValueError as error:
        bad = next(corner for corner in corners if not re.fullmatch(r"-?\d+(?:/(?:-?\d+)?){0,2}", corner))
        raise _wrong(f"f ... {bad}", "indices such as 12, 12/7, 12/7/9 or 12//9") from error
    length = np.array(counts, np.int64)
    owner = np.repeat(np.arange(len(counts)), length)
    before = np.zeros((2, len(counts)), np.int64)
    if relative:
        first = np.cumsum(length) - length
        rows = np.array(relative, np.int64)
        before[:, np.searchsorted(first, rows[:, 0], side="right") - 1] = rows[:, 1:].T
    out = []
    for values, counted in zip((at, texture), before, strict=True):
        if values is not None and (values == 0).any():
            raise _wrong(f"f ... {corners[int(np.flatnonzero(values == 0)[0])]}", "indices other than 0")
        out.append(None if values is None else np.where(values > 0, values - 1, counted[owner] + values))
    return np.asarray(out[0], np.int64), out[1]


def _uv(rows: list[list[str]], texture: Indices | None, placed: Indices) -> Array | None:
    if texture is None or not rows or not all(len(row) == 2 for row in rows):
        return None
    if ((texture < 0) | (texture >= len(rows))).any():
        return None
    uv = _numbers(rows, 2)[texture[placed]]
    return uv if np.isfinite(uv).all() else None


def _check_whole(text: str, polygons: int, vertices: Array, faces: Indices) -> None:
    """Raise an error if a file is truncated within the faces."""
    declared = _COUNTED.findall(text)
    if len(declared) == 1 and int(declared[0]) > polygons:
        raise cut_off(polygons, int(declared[0]), "faces")
    used = len(np.unique(faces[(faces >= 0) & (faces < len(vertices))]))
    if not text.endswith("\n") and used < (1 - _LEAST_LOOSE) * len(vertices) and polygons:
        raise CaptureError(
            f"is truncated after {polygons} faces: it ends within a line, and {len(vertices) - used} of "
            f"{len(vertices)} vertices have no face.",
            hint=COPY_AGAIN,
        )


def _wrong(found: str, allowed: str) -> CaptureError:
    return CaptureError(f'the line "{found:.60}" must have {allowed}.', hint="Export the mesh again.")
