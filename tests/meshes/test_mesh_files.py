"""PLY and STL files as scanners, editors and copying leave them: what they must be read as, or the error.

What is read is compared with the triangles of the quads that were written.
"""

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from mesh_writers import (
    ACROSS,
    AROUND,
    MIXED,
    POINTS,
    QUADS,
    TRIANGLES,
    assert_refused,
    is_the_surface,
    obj,
    ply,
    stl,
    text_stl,
)

from jawusd.base.errors import CaptureError
from jawusd.formats import mesh_reading
from jawusd.meshes.meshio import load_mesh

# ---------------------------------------------------------------------------------------------------------------- PLY


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
    assert_refused(tmp_path / "a.ply", data, words)


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
    assert_refused(tmp_path / "a.stl", data, words)


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
        (b"element vertex 96", b"element vertex 4000000000", "has 4,000,000,000 vertices; at most 30,000,000 are"),
        (b"element face 128", b"element face 20000000", "has 20,000,000 faces; at most 10,000,000 are"),
    ):
        (tmp_path / "a.ply").write_bytes(head.replace(old, new))
        with pytest.raises(CaptureError, match=words):
            load_mesh(tmp_path / "a.ply")
    monkeypatch.setattr(mesh_reading, "MOST_TRIANGLES", 191)
    for name, data in (
        ("a.ply", ply("<", MIXED)),
        ("a.stl", stl()),
        ("b.stl", text_stl().encode()),
        ("a.obj", obj().encode()),
    ):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(CaptureError, match="has 192 triangles; at most 191 are"):
            load_mesh(tmp_path / name)
    monkeypatch.setattr(mesh_reading, "MOST_BYTES", 100)
    with pytest.raises(CaptureError, match="bytes long; at most 100 bytes are"):
        load_mesh(tmp_path / "a.stl")
