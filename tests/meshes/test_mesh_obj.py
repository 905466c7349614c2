"""OBJ files as editors and copying leave them: what they must be read as, or the error."""

from pathlib import Path

import numpy as np
import pytest
from mesh_writers import MIXED, POINTS, QUADS, TRIANGLES, assert_refused, is_the_surface, obj

from jawusd.meshes.meshio import load_mesh


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
    "an index too large": (obj().replace("f 1 ", "f 97 ", 1), "refers to a vertex that does not exist; .* has 96"),
    "a word for an index": (obj().replace("f 1 ", "f a ", 1), '"f ... a" must have indices'),
    "two coordinates": (obj().replace("v 36.0000 0.0000 ", "v 36.0000 ", 1), "must have 3 numbers"),
    "decimal commas": (obj().replace(".", ","), '"v 36,0000 0,0000 0,0000" must have'),
    "lines only": (obj().replace("\nf ", "\nl "), "no triangles"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED_OBJ)
def test_obj_is_refused(tmp_path: Path, name: str) -> None:
    text, words = REFUSED_OBJ[name]
    assert_refused(tmp_path / "a.obj", text.encode(), words)
