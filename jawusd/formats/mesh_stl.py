"""Read binary and text STL (3D Systems, "StereoLithography Interface Specification", 1989).

Triangles do not share vertices. A binary file has an 80-byte header, the number of triangles, and 50 bytes per
triangle: normal, corners, and two bytes that are often used for colours.
"""

from __future__ import annotations

import re
from itertools import chain
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import CaptureError, errors_name_file
from jawusd.formats.mesh import COPY_AGAIN, MOST_TRIANGLES, MeshData, check_count, cut_off, read_mesh_bytes

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


def _are_triangles(corners: Array) -> np.typing.NDArray[np.bool_]:
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
