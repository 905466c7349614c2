"""Read Wavefront OBJ: vertices, texture coordinates and faces ("Object Files (.obj)", Alias|Wavefront, 1995).

Negative indices count backwards from the last vertex before the face. Vertices may have a colour after their
coordinates, 0 to 1 (MeshLab, Blender) or 0 to 255. Materials, normals, groups, lines and curves are ignored.
"""

from __future__ import annotations

import re
from itertools import chain
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import CaptureError, errors_name_file
from jawusd.formats.mesh import (
    COPY_AGAIN,
    Indices,
    MeshData,
    byte_colors,
    check_count,
    cut_off,
    cut_polygons,
    read_mesh_bytes,
)

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


def _points(rows: list[list[str]]) -> tuple[Array, np.typing.NDArray[np.uint8] | None]:
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
