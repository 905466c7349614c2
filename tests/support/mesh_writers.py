"""One surface of known quads, and files of it as scanners and editors write them, byte by byte."""

import re
import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from jawusd.base.errors import CaptureError
from jawusd.meshes.meshio import load_mesh, winding

AROUND, ACROSS = 16, 6


def surface() -> tuple[np.ndarray, list[tuple[int, ...]]]:
    """Return vertices (96, 3) and 96 outward quads of a ring of a dental arch's size."""
    a, b = np.meshgrid(np.arange(AROUND), np.arange(ACROSS), indexing="ij")
    u, v = 2 * np.pi * a.ravel() / AROUND, 2 * np.pi * b.ravel() / ACROSS
    r = 30 + 6 * np.cos(v)
    points = np.round(np.column_stack([r * np.cos(u), r * np.sin(u), 6 * np.sin(v)]), 4)

    def at(i: int, j: int) -> int:
        return (i % AROUND) * ACROSS + j % ACROSS

    return points, [
        (at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)) for i in range(AROUND) for j in range(ACROSS)
    ]


POINTS, QUADS = surface()
TRIANGLES = [(q[0], q[k], q[k + 1]) for q in QUADS for k in (1, 2)]
MIXED = [q for k, q in enumerate(QUADS) if k % 3] + [
    t for q in QUADS[::3] for t in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))
]


def is_the_surface(mesh, *, count: int = 2 * len(QUADS)) -> None:
    """Check closedness, turn, volume, area and corners against sums over the quads, which no reader made."""
    corners = POINTS[np.array(TRIANGLES)]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    found = winding(mesh)
    assert found.closed and found.outward and len(mesh.faces) == count
    assert found.volume_mm3 == pytest.approx(volume, rel=0.02)  # quads that are not flat may be cut either way
    for one, other in ((POINTS, mesh.vertices), (mesh.vertices, POINTS)):
        assert cKDTree(one).query(other)[0].max() < 2e-3


def ply(order: str, faces: list[tuple[int, ...]], *, points=POINTS, extra: str = "", head_end: str = "\n") -> bytes:
    """Write a PLY with points as floats; order "" is text, "<" and ">" binary. The extra is a property of the faces."""
    kind = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    lines = ["ply", f"format {kind} 1.0", "comment by hand", f"element vertex {len(points)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    lines += [f"property {extra}"] if extra else []
    head = head_end.join([*lines, "end_header", ""]).encode()
    if not order:
        rows = [" ".join(f"{x:.4f}" for x in row) for row in points]
        rows += [" ".join(map(str, [len(face), *face, *([7] if extra else [])])) for face in faces]
        return head + "\n".join([*rows, ""]).encode()
    body = np.asarray(points, order + "f4").tobytes()
    for face in faces:
        body += struct.pack(f"{order}B{len(face)}i", len(face), *face) + (b"\7" if extra else b"")
    return head + body


def stl(header: bytes = b"made by hand", triangles=TRIANGLES, said: int | None = None) -> bytes:
    out = header.ljust(80, b" ") + struct.pack("<I", len(triangles) if said is None else said)
    for face in triangles:
        out += struct.pack("<12fH", 0, 0, 1, *POINTS[list(face)].ravel(), 0x8000)
    return out


def text_stl(name: str = "arch", triangles=TRIANGLES) -> str:
    out = [f"solid {name}"]
    for face in triangles:
        out += ["  facet normal 0 0 1", "    outer loop"]
        out += [f"      vertex {x:.4e} {y:.4e} {z:.4e}" for x, y, z in POINTS[list(face)]]
        out += ["    endloop", "  endfacet"]
    return "\n".join([*out, f"endsolid {name}", ""])


def obj(faces=QUADS, *, corner="{v}", colour: float | None = None) -> str:
    rows = [
        f"v {x:.4f} {y:.4f} {z:.4f}" + (f" {colour * k / 95:g} {colour:g} 0" if colour else "")
        for k, (x, y, z) in enumerate(POINTS)
    ]
    rows += ["vt 0.5 0.5", "vn 0 0 1"]
    rows += ["f " + " ".join(corner.format(v=v + 1) for v in face) for face in faces]
    return "\n".join(["# by hand", "o arch", *rows, ""])


def assert_refused(path: Path, data: bytes, words: str) -> None:
    """Write a file and check that it is rejected by name, with these words."""
    path.write_bytes(data)
    with pytest.raises(CaptureError, match=rf"{re.escape(path.name)}: .*{words}"):
        load_mesh(path)
