"""Common parts of the mesh readers: raw mesh data, size limits, triangulation of polygons, colours as bytes."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import CaptureError

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
            f"is {size:,} bytes long; at most {MOST_BYTES:,} bytes are allowed.", path=path, hint="Decimate the mesh."
        )
    return path.read_bytes()


def check_count(path: Path, count: int, what: str) -> None:
    """Check the number of "vertices", "triangles" or "faces" of a file before reading them.

    Raises:
        CaptureError: the number is too large.
    """
    most = MOST_VERTICES if what == "vertices" else MOST_TRIANGLES
    if count > most:
        raise CaptureError(f"has {count:,} {what}; at most {most:,} are allowed.", path=path, hint="Decimate the mesh.")


def cut_off(path: Path, found: int, said: int, what: str) -> CaptureError:
    """Return the error for a truncated file."""
    return CaptureError(f"is truncated: it has {found} of {said} {what}.", path=path, hint=COPY_AGAIN)


def byte_colors(values: Array) -> NDArray[np.uint8] | None:
    """Convert colours (n, 3) of 0 to 1, 0 to 255 or 0 to 65535 to bytes, NaN to gray; None for negative values."""
    top = np.nanmax(values, initial=0.0)
    if np.nanmin(values, initial=0.0) < 0 or top > 65535:
        return None  # negative values are not colours but, for example, normals
    scale = 255.0 if top <= 1 else 1.0 if top <= 255 else 1 / 257
    return np.where(np.isfinite(values), np.round(values * scale), NO_COLOUR).astype(np.uint8)


def cut_polygons(vertices: Array, counts: Indices, corners: Indices) -> tuple[Indices, Indices]:
    """Triangulate polygons as fans.

    A fan starts at the first corner from which all triangles face the same way as the polygon, so that concave quads
    are correct; polygons with fewer than three corners are dropped.

    Args:
        vertices: shape (V, 3).
        counts: number of corners of each polygon, shape (P,).
        corners: concatenated vertex indices of all polygons, shape (C,).

    Returns:
        The positions (F, 3) of each triangle's corners in `corners`, and its vertices (F, 3), in polygon order.
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
