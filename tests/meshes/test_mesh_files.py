"""Meshes as scanners, editors and copying leave them: a table of files, what they must be read as, or the error.

The files are written here, byte by byte, from one surface of known quads; what is read is compared with its triangles.
"""

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from jawusd.base.errors import CaptureError
from jawusd.formats import mesh_data
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


# ---------------------------------------------------------------------------------------------------------------- PLY


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


def strips(order: str) -> bytes:
    """Write the surface as a strip per ring of quads in one list with -1 between, some corners repeated."""
    values: list[int] = []
    for i in range(AROUND):
        ring = [QUADS[i * ACROSS + j] for j in range(ACROSS)]
        # across the quad: (0, 1), (3, 2), next; the first triangle is 0, 1, 3
        values += [ring[0][0], ring[0][1]] + [corner for quad in ring for corner in (quad[3], quad[2])] + [-1]
    text = [
        "ply",
        f"format {'ascii' if not order else 'binary_little_endian' if order == '<' else 'binary_big_endian'} 1.0",
    ]
    text += [f"element vertex {len(POINTS)}", *(f"property float {a}" for a in "xyz")]
    text += ["element tristrips 1", "property list int int vertex_indices", "end_header", ""]
    head = "\n".join(text).encode()
    if not order:
        rows = [" ".join(f"{x:.4f}" for x in row) for row in POINTS]
        return head + "\n".join([*rows, " ".join(map(str, [len(values), *values])), ""]).encode()
    return head + np.asarray(POINTS, order + "f4").tobytes() + np.array([len(values), *values], order + "i4").tobytes()


def with_element(order: str) -> bytes:
    """Put edges and a list of another element before and behind the faces."""
    data = ply(order, MIXED)
    head, body = data.split(b"end_header\n", 1)
    edges = b"element edge 2\nproperty int a\nproperty list uchar float w\n"
    head = head.replace(b"element face", edges + b"element face")
    points = len(POINTS) * 12
    middle = struct.pack(f"{order}iBf", 1, 1, 0.5) + struct.pack(f"{order}iBff", 2, 2, 0.5, 0.25)
    return head + b"end_header\n" + body[:points] + middle + body[points:]


READ_PLY = {
    "text": ply("", QUADS),
    "text, triangles": ply("", TRIANGLES),
    "text, mixed": ply("", MIXED),
    "text, CRLF": ply("", MIXED).replace(b"\n", b"\r\n"),
    "text, old line ends": ply("", MIXED).replace(b"\n", b"\r"),
    "text, byte order mark": b"\xef\xbb\xbf" + ply("", MIXED),
    "text, tabs and blank lines": ply("", MIXED).replace(b".0000 ", b".0000\t").replace(b"\n4 ", b"\n\n4 "),
    "text, remark behind": ply("", MIXED) + b"end of file\n",
    "text, numbers behind": ply("", MIXED) + b"0 0\n",
    "text, face flags": ply("", MIXED, extra="uchar flags"),
    "text, strips": strips(""),
    "little": ply("<", TRIANGLES),
    "little, mixed": ply("<", MIXED),
    "little, bytes behind": ply("<", MIXED) + b"\0\1\2",
    "little, triangles, bytes behind": ply("<", TRIANGLES) + b"signed 2024-01-01" * 9,
    "little, face flags": ply("<", MIXED, extra="uchar flags"),
    "little, CRLF header": ply("<", MIXED, head_end="\r\n"),
    "little, strips": strips("<"),
    "little, other elements": with_element("<"),
    "big": ply(">", TRIANGLES),
    "big, mixed": ply(">", MIXED),
    "big, bytes behind": ply(">", MIXED) + b"\0",
    "big, strips": strips(">"),
    "big, other elements": with_element(">"),
    "big, old line ends": ply(">", MIXED, head_end="\r"),
}


@pytest.mark.parametrize("name", READ_PLY)
def test_ply_is_read(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.ply").write_bytes(READ_PLY[name])
    mesh = load_mesh(tmp_path / "a.ply")
    is_the_surface(mesh)
    np.testing.assert_allclose(mesh.vertices, POINTS, atol=1e-4)  # in the order of the file


def test_a_long_word_in_a_text_takes_no_memory_for_every_other_word(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(ply("", QUADS) + b"x" * 40_000_000 + b" end\n")
    tracemalloc.start()
    is_the_surface(load_mesh(tmp_path / "a.ply"))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 400e6  # as many copies of the word as there are numbers would be 30 GB


def lines(data: bytes, count: int) -> bytes:
    head, body = data.split(b"end_header\n", 1)
    return head + b"end_header\n" + b"".join(body.splitlines(keepends=True)[:count])


_HEAD = len(ply("<", MIXED).split(b"end_header\n")[0]) + 11
REFUSED_PLY = {
    "text, half the faces": (lines(ply("", QUADS), 96 + 42), "is truncated: it has 42 of 96 faces"),
    "text, within a face": (lines(ply("", QUADS), 96 + 42) + b"4 1 2", "is truncated: it has 42 of 96 faces"),
    "text, within a number": (ply("", QUADS)[:1800], "is truncated: it has .* of 96 vertices"),
    "text, vertices only": (lines(ply("", QUADS), 96), "is truncated: it has 0 of 96 faces"),
    "text, half the vertices": (lines(ply("", QUADS), 50), "is truncated: it has 50 of 96 vertices"),
    "text, CRLF, cut": (lines(ply("", QUADS), 120).replace(b"\n", b"\r\n"), "is truncated: it has 24 of 96 faces"),
    "text, strip": (strips("")[:-30], "is truncated: it has 0 of 1 triangle strips"),
    "little, cut": (ply("<", TRIANGLES)[: _HEAD - 0 + 96 * 12 + 13 * 41 + 5], "is truncated: it has 41 of 192 faces"),
    "little, mixed, cut": (ply("<", MIXED)[: _HEAD + 96 * 12 + 17 * 41 + 1], "is truncated: it has 41 of 128 faces"),
    "big, mixed, cut": (ply(">", MIXED)[:-1], "is truncated: it has 127 of 128 faces"),
    "big, strips, cut": (strips(">")[:-4], "is truncated: it has 0 of 1 triangle strips"),
    "little, vertices cut": (ply("<", MIXED)[: _HEAD + 12 * 60], "is truncated: it has 60 of 96 vertices"),
    "header alone": (ply("<", MIXED)[:_HEAD], "is truncated: it has 0 of 96 vertices"),
    "no end of the header": (ply("<", MIXED)[: _HEAD - 12], "end_header"),
    "more columns": (ply("", QUADS).replace(b"0 4", b"0 4 4").replace(b".0000\n", b".0000 1 1 1\n"), "header"),
    "decimal commas": (ply("", QUADS).replace(b".", b",").replace(b"1,0\n", b"1.0\n"), '"36,0000" is not a number'),
    "a type that is none": (ply("<", MIXED).replace(b"float x", b"real x"), 'line "property real x"'),
    "points alone": (ply("<", []), "no triangles"),
    "an index too large": (ply("", [*QUADS[1:], (0, 1, 500)]), "refers to a vertex that does not exist"),
}


@pytest.mark.parametrize("name", REFUSED_PLY)
def test_ply_is_refused(tmp_path: Path, name: str) -> None:
    data, words = REFUSED_PLY[name]
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(CaptureError, match=rf"a\.ply: .*{words}"):
        load_mesh(tmp_path / "a.ply")


@pytest.mark.parametrize(("kind", "scale"), [("uchar", 1), ("float", 1 / 255), ("ushort", 257)])
@pytest.mark.parametrize("order", ["", ">"])
def test_colours_of_a_ply_are_scaled_by_their_type(tmp_path: Path, kind: str, scale: float, order: str) -> None:
    colors = np.random.default_rng(0).integers(0, 256, (len(POINTS), 3))
    head, body = ply(order, MIXED).split(b"element face", 1)
    names = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    rest, body = body.split(b"end_header\n", 1)
    values = colors * scale
    if order:
        code = {"uchar": "u1", "float": ">f4", "ushort": ">u2"}[kind]
        rows = np.frombuffer(body[: 12 * len(POINTS)], np.uint8).reshape(-1, 12)
        body = (
            np.hstack([rows, values.astype(code).view(np.uint8).reshape(len(POINTS), -1)]).tobytes()
            + body[12 * len(POINTS) :]
        )
    else:
        rows = body.decode().splitlines()
        rows[: len(POINTS)] = [f"{row} {' '.join(f'{v:.9g}' for v in own)}" for row, own in zip(rows, values)]
        body = "\n".join([*rows, ""]).encode()
    (tmp_path / "a.ply").write_bytes(head + names.encode() + b"element face" + rest + b"end_header\n" + body)
    mesh = load_mesh(tmp_path / "a.ply")
    is_the_surface(mesh)
    np.testing.assert_array_equal(mesh.colors, colors)


# ---------------------------------------------------------------------------------------------------------------- STL


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


READ_STL = {
    "binary": stl(),
    "ten bytes behind": stl() + bytes(10),
    "three sectors behind": stl() + bytes(1536),
    "text behind": stl() + b"COLOR=\xff\x00\x00 scanned 2024 by hand" * 5,
    "begins with solid": stl(b"solid made by a modeller"),
    "begins with solid, bytes behind": stl(b"solid facet normal vertex") + b"\r\n",
    "text": text_stl().encode(),
    "text, CRLF": text_stl().replace("\n", "\r\n").encode(),
    "text, capitals": text_stl().upper().encode(),
    "text, byte order mark": b"\xef\xbb\xbf" + text_stl().encode(),
    "text, a name of its words": text_stl("vertex facet 1 2 3 solid").encode(),
    "text, no name": text_stl("").encode(),
    "text, two solids": (text_stl("a", TRIANGLES[:50]) + text_stl("b", TRIANGLES[50:])).encode(),
}


@pytest.mark.parametrize("name", READ_STL)
def test_stl_is_read(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.stl").write_bytes(READ_STL[name])
    mesh = load_mesh(tmp_path / "a.stl")
    is_the_surface(mesh)
    np.testing.assert_allclose(mesh.vertices[mesh.faces], POINTS[np.array(TRIANGLES)], atol=1e-3)


REFUSED_STL = {
    "binary, cut": (stl()[:-30], "is truncated: it has 191 of 192 triangles"),
    "binary, half": (stl()[: 84 + 50 * 96], "is truncated: it has 96 of 192 triangles"),
    "binary, begins with solid, cut": (stl(b"solid x")[:-60], "is truncated: it has 190 of 192 triangles"),
    "count too large": (stl(said=4_000), "is truncated: it has 192 of 4000 triangles"),
    "count too small": (stl(said=100), "declares 100 triangles, but 92 more follow"),
    "count unknown": (stl(said=0xFFFFFFFF), "declares 4,294,967,295 triangles, but has room for 192"),
    "text of another kind": (b"hello, this is no STL file\n" * 20, "has room for 9"),
    "count zero": (stl(said=0), "declares 0 triangles, but 192 more follow"),
    "text, cut in a number": (text_stl()[:9000].encode(), "is truncated after .* triangles"),
    "text, cut between triangles": (text_stl().split("endfacet\n")[0].encode() + b"endfacet\n", "truncated after 1"),
    "text, second solid cut": (text_stl().encode() + text_stl("b")[:700].encode(), "is truncated after"),
    "text, no end": (text_stl().replace("endsolid arch\n", "").encode(), "truncated after 192 triangles"),
    "text, a word for a number": (text_stl().replace("vertex 3.6000e+01", "vertex wide", 1).encode(), "cannot be read"),
    "text, a corner missing": (text_stl().replace("      vertex 3.6000e+01 0.0000e+00 0.0000e+00\n", "", 1).encode(),
                               "has 575 vertices in 192 facets"),
    "nothing": (b"solid a\nendsolid a\n", "no triangles"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED_STL)
def test_stl_is_refused(tmp_path: Path, name: str) -> None:
    data, words = REFUSED_STL[name]
    (tmp_path / "a.stl").write_bytes(data)
    with pytest.raises(CaptureError, match=rf"a\.stl: .*{words}"):
        load_mesh(tmp_path / "a.stl")


# ---------------------------------------------------------------------------------------------------------------- OBJ


def obj(faces=QUADS, *, corner="{v}", colour: float | None = None) -> str:
    rows = [
        f"v {x:.4f} {y:.4f} {z:.4f}" + (f" {colour * k / 95:g} {colour:g} 0" if colour else "")
        for k, (x, y, z) in enumerate(POINTS)
    ]
    rows += ["vt 0.5 0.5", "vn 0 0 1"]
    rows += ["f " + " ".join(corner.format(v=v + 1) for v in face) for face in faces]
    return "\n".join(["# by hand", "o arch", *rows, ""])


def relative(blocks: int, *, corner: str = "{v}") -> str:
    """Write the points in blocks, each quad as soon as its corners are there, with indices that count back."""
    out, written, pending = [], 0, list(QUADS)
    for block in np.array_split(np.arange(len(POINTS)), blocks):
        out += [f"o part{len(out)}", *(f"v {' '.join(f'{x:.4f}' for x in POINTS[k])}" for k in block), "vt 0 0"]
        written += len(block)
        ready = [quad for quad in pending if max(quad) < written]
        out += ["f " + " ".join(corner.format(v=v - written) for v in quad) for quad in ready]
        pending = [quad for quad in pending if quad not in ready]
    return "\n".join([*out, ""])


READ_OBJ = {
    "quads": obj(),
    "triangles": obj(TRIANGLES),
    "mixed": obj(MIXED),
    "v/vt": obj(MIXED, corner="{v}/1"),
    "v/vt/vn": obj(MIXED, corner="{v}/1/1"),
    "v//vn": obj(MIXED, corner="{v}//1"),
    "v/": obj(MIXED, corner="{v}/"),
    "relative, one block": relative(1),
    "relative, two blocks": relative(2),
    "relative, many blocks, v/vt/vn": relative(30, corner="{v}/-1/-1"),
    "relative, v//vn": relative(7, corner="{v}//-1"),
    "tabs": obj(MIXED).replace(" ", "\t"),
    "blanks before and behind": "\n".join(f"  {line}  " for line in obj(MIXED).splitlines()) + "\n",
    "CRLF": obj(MIXED).replace("\n", "\r\n"),
    "old line ends": obj(MIXED).replace("\n", "\r"),
    "byte order mark": "\ufeff" + obj(MIXED).removeprefix("# by hand\no arch\n"),
    "continued lines": obj().replace(" ", " \\\n").replace("v \\\n", "v ").replace("# \\\n", "# "),
    "remarks behind values": obj(MIXED).replace("\nf ", " # here\nf "),
    "no line end": obj(MIXED).rstrip(),
    "several materials": "\n".join(
        f"usemtl m{k % 3}\n{line}" if line[:2] == "f " and k % 5 == 0 else line
        for k, line in enumerate(obj().splitlines())
    ) + "\n",
    "faces first": "\n".join(sorted(obj().splitlines(), key=lambda line: not line.startswith("f "))) + "\n",
    "weights": "\n".join(f"{line} 1.0" if line.startswith("v ") else line for line in obj().splitlines()) + "\n",
    "counted by MeshLab": "# Vertices: 96\n# Faces: 96\n" + obj(),
}  # fmt: skip


@pytest.mark.parametrize("name", READ_OBJ)
def test_obj_is_read(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.obj").write_bytes(READ_OBJ[name].encode())
    mesh = load_mesh(tmp_path / "a.obj")
    is_the_surface(mesh)
    np.testing.assert_allclose(mesh.vertices, POINTS, atol=1e-4)


def test_obj_of_two_bytes_a_letter_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(obj(MIXED).encode("utf-16"))
    is_the_surface(load_mesh(tmp_path / "a.obj"))


def test_a_polygon_with_a_dent_keeps_its_area(tmp_path: Path) -> None:
    """An L of six corners, listed from each of them: fans from five of them leave it."""
    corners = np.array([(0, 0), (60, 0), (60, 20), (20, 20), (20, 60), (0, 60)], float)
    for first in range(6):
        turned = np.roll(np.arange(6), first) + 1
        rows = [f"v {x} {y} 0" for x, y in corners] + ["f " + " ".join(map(str, turned))]
        (tmp_path / "a.obj").write_text("\n".join([*rows, ""]))
        mesh = load_mesh(tmp_path / "a.obj")
        a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
        areas = np.cross(b - a, c - a)[:, 2] / 2
        assert len(mesh.faces) == 4 and (areas >= 0).all() and areas.sum() == pytest.approx(60 * 20 + 20 * 40)


@pytest.mark.parametrize(("top", "unit"), [(1.0, 255.0), (255.0, 1.0), (200.0, 1.0), (65535.0, 1 / 257)])
def test_colours_of_an_obj(tmp_path: Path, top: float, unit: float) -> None:
    (tmp_path / "a.obj").write_text(obj(MIXED, colour=top))
    mesh = load_mesh(tmp_path / "a.obj")
    is_the_surface(mesh)
    wanted = np.column_stack([top * np.arange(96) / 95, np.full(96, top), np.zeros(96)]) * unit
    assert np.abs(mesh.colors - wanted).max() <= 0.51


def test_vertices_without_a_colour_among_coloured_ones_are_gray(tmp_path: Path) -> None:
    rows = obj(MIXED, colour=1.0).splitlines()
    rows[5] = " ".join(rows[5].split()[:4])
    (tmp_path / "a.obj").write_text("\n".join([*rows, ""]))
    mesh = load_mesh(tmp_path / "a.obj")
    assert mesh.colors[3].tolist() == [128, 128, 128] and mesh.colors[4].tolist() == [11, 255, 0]


REFUSED_OBJ = {
    "half the faces": (obj()[: int(0.8 * len(obj()))], "is truncated after .* faces: it ends within a line"),
    "half the vertices": (obj()[:1500], "must have 3 numbers|no triangles"),
    "fewer faces than MeshLab counted": ("# Faces: 188\n" + obj(), "is truncated: it has 96 of 188 faces"),
    "index zero": (obj().replace("f 1 ", "f 0 ", 1), "indices other than 0"),
    "an index too far back": (relative(3).replace("f -", "f -9", 1), "refers to a vertex that does not exist"),
    "an index too large": (obj().replace("f 1 ", "f 97 ", 1), "refers to a vertex that does not exist; there are 96"),
    "a word for an index": (obj().replace("f 1 ", "f a ", 1), '"f ... a" must have indices'),
    "two coordinates": (obj().replace("v 36.0000 0.0000 ", "v 36.0000 ", 1), "must have 3 numbers"),
    "decimal commas": (obj().replace(".", ","), '"v 36,0000 0,0000 0,0000" must have'),
    "lines only": (obj().replace("\nf ", "\nl "), "no triangles"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED_OBJ)
def test_obj_is_refused(tmp_path: Path, name: str) -> None:
    text, words = REFUSED_OBJ[name]
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(CaptureError, match=rf"a\.obj: .*{words}"):
        load_mesh(tmp_path / "a.obj")


# ------------------------------------------------------------------------------------------------------ loose vertices


def loose(kind: str, extra) -> bytes:
    points = np.vstack([POINTS[:40], extra, POINTS[40:]])
    moved = [tuple(v + len(extra) * (v >= 40) for v in face) for face in MIXED]
    if kind == "obj":
        rows = [f"v {' '.join(f'{x:.4f}' for x in row)}" for row in points]
        return "\n".join([*rows, *("f " + " ".join(str(v + 1) for v in face) for face in moved), ""]).encode()
    return ply(kind, moved, points=points)


@pytest.mark.parametrize("kind", ["", "<", ">", "obj"])
@pytest.mark.parametrize(
    "extra", [[(500, 0, 0), (0, -9e3, 1)], [(np.nan,) * 3], [(np.inf, 0, 0)] * 60, [(0, 0, 3)] * 300]
)
def test_vertices_that_no_face_uses_count_nowhere_and_keep_their_numbers(tmp_path: Path, kind: str, extra) -> None:
    name = f"a.{'obj' if kind == 'obj' else 'ply'}"
    (tmp_path / name).write_bytes(loose(kind, np.array(extra, float)))
    mesh = load_mesh(tmp_path / name)
    is_the_surface(mesh)
    np.testing.assert_allclose(mesh.vertices[[0, 39, 40 + len(extra), -1]], POINTS[[0, 39, 40, -1]], atol=1e-4)
    np.testing.assert_allclose(mesh.vertices.mean(axis=0), POINTS.mean(axis=0), atol=0.5)


def test_a_used_vertex_that_is_not_finite_is_named(tmp_path: Path) -> None:
    points = POINTS.copy()
    points[7] = np.nan
    (tmp_path / "a.ply").write_bytes(ply("", MIXED, points=points))
    with pytest.raises(CaptureError, match=r"vertex 7 has a coordinate that is not finite \(1 such"):
        load_mesh(tmp_path / "a.ply")


# ---------------------------------------------------------------------------------------------------------------- caps


def test_counts_are_capped_before_anything_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    head = ply("<", MIXED).split(b"end_header\n")[0] + b"end_header\n"
    for old, new, words in (
        (b"element vertex 96", b"element vertex 4000000000", "has 4,000,000,000 vertices, at most 30,000,000 are allowed"),
        (b"element face 128", b"element face 20000000", "has 20,000,000 faces, at most 10,000,000 are read"),
    ):
        (tmp_path / "a.ply").write_bytes(head.replace(old, new))
        with pytest.raises(CaptureError, match=words):
            load_mesh(tmp_path / "a.ply")
    monkeypatch.setattr(mesh_data, "MOST_TRIANGLES", 191)
    for name, data in (
        ("a.ply", ply("<", MIXED)),
        ("a.stl", stl()),
        ("b.stl", text_stl().encode()),
        ("a.obj", obj().encode()),
    ):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(CaptureError, match="has 192 triangles, at most 191 are read"):
            load_mesh(tmp_path / name)
    monkeypatch.setattr(mesh_data, "MOST_BYTES", 100)
    with pytest.raises(CaptureError, match="bytes, at most 100 are read"):
        load_mesh(tmp_path / "a.stl")
