"""Read PLY, text or binary in either byte order (G. Turk, "The PLY Polygon File Format", Stanford, 1994).

The reader supports vertices with colours and texture coordinates, polygons with texture coordinates (`texcoord`,
MeshLab), and triangle strips separated by -1. Other elements, and data after the last element, are ignored.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from struct import Struct

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import CaptureError, errors_name_file
from jawusd.formats.mesh_reading import (
    Indices,
    MeshData,
    byte_colors,
    check_count,
    cut_off,
    cut_polygons,
    read_mesh_bytes,
)

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"}
_TYPES |= {"double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_TYPES |= {"int64": "i8", "uint64": "u8", "float16": "f2", "float32": "f4", "float64": "f8"}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_indices", "vertex_index")
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_PLACES = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
_END = re.compile(rb"(?:^|(?<=[\r\n]))end_header[ \t]*(\r\n|\n|\r)")
# Byte orders as in the module struct.
_LETTERS = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q"}
_LETTERS |= {"f2": "e", "f4": "f", "f8": "d"}
_PLURAL = {"vertex": "vertices", "tristrips": "triangle strips"}


@dataclass(frozen=True)
class _Property:
    name: str
    value: str  # numpy dtype of the values, from the header
    length: str = ""  # numpy dtype of the length of a list, "" for scalars


@dataclass(frozen=True)
class _Element:
    name: str
    rows: int
    properties: list[_Property]


@dataclass(frozen=True)
class _Table:
    """Values of an element: per scalar property a column (n,); per list property lengths (n,) and joined values."""

    columns: dict[str, Array]
    lists: dict[str, tuple[Indices, Array]]
    kinds: dict[str, str]  # numpy dtypes of the values, from the header

    def joined(self, choices: tuple[tuple[str, ...], ...]) -> tuple[Array | None, str]:
        """Return the first complete set of columns, shape (n, k), and its dtype; None if there is none."""
        for names in choices:
            if all(name in self.columns for name in names):
                return np.column_stack([self.columns[name] for name in names]), self.kinds[names[0]]
        return None, ""


@errors_name_file
def read_ply(path: Path) -> MeshData:
    """Read a PLY file; vertices and faces keep the file's order.

    Raises:
        CaptureError: the file is truncated, or header and data do not match.
    """
    data = read_mesh_bytes(path)
    elements, at, order = _header(data)
    for element in elements:
        if element.name in ("vertex", "face"):
            check_count(element.rows, _plural(element))
    text, wrong = b"", None
    if not order:
        text = data[at:]
        values, wrong = _numbers(text)
        data, at = values.tobytes(), 0
    tables: dict[str, _Table] = {}
    try:
        for element in elements:
            tables[element.name], at = _Reader(element, order).read(data, at)
    except CaptureError as error:
        if wrong is None:
            raise
        raise CaptureError(f'"{wrong:.60}" is not a number.', hint="Export the mesh again.") from error
    if at < len(data) and not order:
        _check_columns(text, sum(element.rows for element in elements), at // 8)
    return _mesh(tables)


def _mesh(tables: dict[str, _Table]) -> MeshData:
    none = _Table({}, {}, {})
    points, faces, strips = (tables.get(name, none) for name in ("vertex", "face", "tristrips"))
    vertices, _ = points.joined((("x", "y", "z"),))
    if vertices is None:
        raise CaptureError("its vertices do not have three coordinates each.", hint="Export it again.")
    vertices = vertices.astype(np.float64)
    name = next((name for name in (*_CORNERS, *faces.lists) if name in faces.lists), "")
    counts, corners = faces.lists.get(name, (np.zeros(0, np.int64), np.zeros(0)))
    placed, triangles = cut_polygons(vertices, counts, corners.astype(np.int64))
    uv = None
    if "texcoord" in faces.lists and np.array_equal(faces.lists["texcoord"][0], 2 * counts):
        uv = faces.lists["texcoord"][1].astype(np.float64).reshape(-1, 2)[placed]
    for _, values in strips.lists.values():
        triangles, uv = np.concatenate([triangles, _strip_triangles(values.astype(np.int64))]), None
    check_count(len(triangles), "triangles")
    places, _ = points.joined(_PLACES)
    if uv is None and places is not None and ((triangles >= 0) & (triangles < len(vertices))).all():
        uv = places.astype(np.float64)[triangles]
    shown, kind = points.joined(_COLORS)
    colors = None
    if shown is not None:
        colors = shown.astype(np.uint8) if kind == "u1" else byte_colors(shown.astype(np.float64))
    return MeshData(vertices, triangles, colors, uv if uv is not None and np.isfinite(uv).all() else None)


def _strip_triangles(values: Indices) -> Indices:
    """Convert strips to triangles (F, 3): every second one is flipped, and degenerate ones are dropped."""
    place = np.arange(len(values))
    corners = np.stack([values[:-2], values[1:-1], values[2:]], axis=1) if len(values) > 2 else np.zeros((0, 3), int)
    begin = np.maximum.accumulate(np.where(values < 0, place + 1, 0))
    turned = ((place - begin) % 2 == 1)[: len(corners)]
    corners[turned] = corners[turned][:, [1, 0, 2]]
    a, b, c = corners.T
    return corners[(corners >= 0).all(axis=1) & (a != b) & (b != c) & (c != a)]


def _header(data: bytes) -> tuple[list[_Element], int, str]:
    """Return the elements, the offset of their data, and the byte order ("" for text)."""
    found = _END.search(data)
    if data.removeprefix(b"\xef\xbb\xbf")[:3].lower() != b"ply" or found is None:
        raise CaptureError('is not a PLY file: "ply" or "end_header" is missing.', hint="Export it again.")
    elements: list[_Element] = []
    order: str | None = None
    for line in data[: found.start()].decode("utf-8", errors="replace").splitlines():
        words = line.split()
        try:
            if words[:1] == ["format"]:
                order = _ORDERS[words[1]]
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], int(words[2]), []))
            elif words[:2] == ["property", "list"]:
                elements[-1].properties.append(_Property(words[4], _TYPES[words[3]], _TYPES[words[2]]))
            elif words[:1] == ["property"]:
                elements[-1].properties.append(_Property(words[2], _TYPES[words[1]]))
        except (KeyError, ValueError, IndexError) as error:
            raise _bad_header(f'has the line "{line:.60}", which is not PLY') from error
    names = [element.name for element in elements]
    if order is None or len(set(names)) < len(names) or any(element.rows < 0 for element in elements):
        raise _bad_header('lacks "format", repeats an element, or has a negative count')
    return elements, found.end(), order


def _bad_header(what: str) -> CaptureError:
    return CaptureError(f"its header {what}.", hint="Export the mesh again.")


def _plural(element: _Element) -> str:
    return _PLURAL.get(element.name, f"{element.name}s")


def _numbers(text: bytes) -> tuple[Array, str | None]:
    """Return the numbers of a text up to the first invalid word, and this word unless it ends the text."""
    words = text.split()
    try:
        return np.fromiter(map(float, words), np.float64, len(words)), None
    except ValueError:
        whole = 0
        for word in words:
            try:
                float(word)
            except ValueError:
                break
            whole += 1
        shown = words[whole].decode("utf-8", errors="replace") if whole + 1 < len(words) else None
        return np.fromiter(map(float, words[:whole]), np.float64, whole), shown


def _check_columns(text: bytes, rows: int, used: int) -> None:
    """Raise an error if lines of a text file have more numbers than the header declares; extra lines are ignored."""
    lines = [line for line in text.splitlines() if line.strip()][:rows]
    held = sum(len(line.split()) for line in lines)
    if len(lines) == rows and held != used:
        raise _bad_header(f"declares {used} numbers in {rows} lines, but the lines contain {held}")


class _Reader:
    """Reader of one element; reads all rows at once if their lists have equal lengths."""

    def __init__(self, element: _Element, order: str) -> None:
        self._element = element
        # numbers in text files are read as doubles
        self._values = [(order + one.value if order else "<f8") for one in element.properties]
        self._lengths = [one.length and (order + one.length if order else "<f8") for one in element.properties]

    def read(self, data: bytes, at: int) -> tuple[_Table, int]:
        """Return the table at an offset, and the offset of the next table."""
        rows, listed = self._element.rows, sum(map(bool, self._lengths))
        if not rows or not self._values:
            return self._table([], np.zeros((0, listed), np.int64)), at
        first = self._walk(data, at, 1)[1]
        kind = self._row_type(first[0].tolist())
        alike = np.frombuffer(data, kind, min(rows, (len(data) - at) // kind.itemsize), at)
        lengths = [alike[f"n{k}"] for k, length in enumerate(self._lengths) if length]
        if len(alike) == rows and all((length == length[0]).all() for length in lengths):
            return self._table([(np.arange(rows), alike)], np.repeat(first, rows, axis=0)), at + rows * kind.itemsize
        if not listed:
            raise self._cut_off(len(alike))
        starts, counts = self._walk(data, at, rows)
        raw, groups = np.frombuffer(data, np.uint8), []
        for group in np.unique(counts, axis=0):
            kind = self._row_type(group.tolist())
            owner = np.flatnonzero((counts == group).all(axis=1))
            groups.append((owner, raw[starts[owner, None] + np.arange(kind.itemsize)].view(kind)[:, 0]))
        return self._table(groups, counts), int(starts[-1])

    def _cut_off(self, whole: int) -> CaptureError:
        return cut_off(whole, self._element.rows, _plural(self._element))

    def _row_type(self, counts: list[int]) -> np.dtype[np.void]:
        """Return the dtype of rows with given list lengths: fields "p0", "p1", ..., list lengths "n0", "n1", ..."""
        parts: list[tuple[str, str, tuple[int, ...]]] = []
        for k, (value, length) in enumerate(zip(self._values, self._lengths, strict=True)):
            parts += [(f"n{k}", length, ()), (f"p{k}", value, (counts.pop(0),))] if length else [(f"p{k}", value, ())]
        return np.dtype(parts)

    def _walk(self, data: bytes, at: int, rows: int) -> tuple[Indices, Indices]:
        """Return the offset of each row and the end of the last row (n + 1,), and the list lengths (n, lists)."""
        steps = [
            (np.dtype(value).itemsize, Struct(length[0] + _LETTERS[length[1:]]) if length else None)
            for value, length in zip(self._values, self._lengths, strict=True)
        ]
        starts, counts = [at], []
        for row in range(rows):
            for size, length in steps:
                if length is None:
                    at += size
                    continue
                if at + length.size > len(data):
                    raise self._cut_off(row)
                (count,) = length.unpack_from(data, at)
                if not count >= 0 or count % 1:
                    raise _bad_header(f"does not match the data: a list has {count:g} values")
                counts.append(int(count))
                at += length.size + int(count) * size
            if at > len(data):
                raise self._cut_off(row)
            starts.append(at)
        return np.array(starts, np.int64), np.array(counts, np.int64).reshape(rows, -1)

    def _table(self, groups: list[tuple[Indices, NDArray[np.void]]], counts: Indices) -> _Table:
        """Return the table assembled from groups of rows with their row indices."""
        columns: dict[str, Array] = {}
        lists: dict[str, tuple[Indices, Array]] = {}
        for k, one in enumerate(self._element.properties):
            native = np.dtype(one.value)
            if not self._lengths[k]:
                columns[one.name] = np.zeros(len(counts), native)
                for owner, rows in groups:
                    columns[one.name][owner] = rows[f"p{k}"]
                continue
            own = counts[:, len(lists)]
            begin, values = np.cumsum(own) - own, np.zeros(int(own.sum()), native)
            for owner, rows in groups:
                part = rows[f"p{k}"]
                values[begin[owner, None] + np.arange(part.shape[1])] = part
            lists[one.name] = own, values
        return _Table(columns, lists, {one.name: one.value for one in self._element.properties})
