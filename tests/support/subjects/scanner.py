"""Scanner model: file format, vertex colours, number of faces, noise and mesh defects of scans."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.formats.mesh import GUM, Mesh, tooth_labels
from jawusd.meshes.remeshing import decimated
from jawusd.meshes.surfaces import Faces, merged, vertex_normals
from jawusd.synthetic.dental_arch import GREY, RED

Paint = Literal["painted", "natural", "none"]
_ENAMEL, _PINK = np.array([214.0, 204.0, 180.0]), np.array([196.0, 116.0, 112.0])
FORMATS = ("ply", "ply-ascii", "stl", "stl-ascii", "obj")


@dataclass(frozen=True)
class Scanner:
    """Properties of a scanner's files."""

    format: str  # one of `FORMATS`
    paint: Paint
    faces: int  # approximate number per arch
    noise_mm: float  # standard deviation along the normals
    dirt: bool  # add loose pieces, degenerate and duplicate faces

    @property
    def suffix(self) -> str:
        """Return the file suffix."""
        return "." + self.format.partition("-")[0]


def draw_scanner(seed: int, unpainted: float = 0.0) -> Scanner:
    """Draw a random scanner; `unpainted` is the probability of scans without vertex colours."""
    rng = np.random.default_rng([seed, 0x5CA2])
    bare = rng.random() < unpainted
    paint: Paint = ("natural" if rng.random() < 0.5 else "none") if bare else "painted"
    formats = FORMATS if paint == "none" else ("ply", "ply-ascii", "obj")
    size = rng.random()
    faces = 10 ** rng.uniform(3.5, 4.0) if size < 0.12 else 10 ** rng.uniform(4.1, 4.8)
    if size > 0.95:
        faces = 10 ** rng.uniform(5.0, 5.7)
    format_ = formats[int(rng.integers(len(formats)))]
    return Scanner(format_, paint, int(faces), rng.uniform(0.0, 0.015), bool(rng.random() < 0.4))


def scanned(mesh: Mesh, scanner: Scanner, rng: np.random.Generator) -> Mesh:
    """Return a coloured arch as delivered by a scanner, with vertices numbered as by a reader of the file.

    Raises:
        ValueError: the arch has no vertex colours.
    """
    vertices, faces, colors = mesh.vertices, mesh.faces, mesh.colors
    if colors is None:
        raise ValueError("the arch has no vertex colours")
    while len(faces) * 4 <= scanner.faces:
        vertices, faces, colors = _subdivided(vertices, faces, colors)
    if len(faces) > scanner.faces:
        vertices, faces, colors = _thinned(Mesh(vertices, faces, colors), scanner.faces)
    vertices, faces, colors = _welded(vertices, faces, colors)
    normals = vertex_normals(vertices, faces)
    vertices = vertices + scanner.noise_mm * rng.normal(size=(len(vertices), 1)) * normals
    if scanner.dirt:
        vertices, faces, colors = _dirty(vertices, faces, colors, rng)
    if scanner.paint == "natural":
        crown = tooth_labels(Mesh(vertices, faces, colors)) != GUM
        shade = rng.normal(1.0, 0.03, (len(vertices), 1))
        colors = np.clip(np.where(crown[:, None], _ENAMEL, _PINK) * shade, 0, 255).astype(np.uint8)
    if scanner.suffix == ".stl":  # three vertices per triangle
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces), dtype=np.int32).reshape(-1, 3)
    return Mesh(vertices, faces, None if scanner.paint == "none" else colors)


def encoded(mesh: Mesh, scanner: Scanner) -> bytes:
    """Return the bytes of a scan file [mm]."""
    if scanner.format == "ply":
        return _ply(mesh)
    if scanner.format == "ply-ascii":
        return _ply_ascii(mesh)
    if scanner.format == "obj":
        rows = mesh.vertices if mesh.colors is None else np.hstack([mesh.vertices, mesh.colors / 255.0])
        lines = ["v " + " ".join(f"{value:.5f}" for value in row) for row in rows.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
        return ("\n".join(lines) + "\n").encode()
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    if scanner.format == "stl":
        numbers = np.concatenate([normals, corners.reshape(-1, 9)], axis=1).astype("<f4").view(np.uint8)
        attribute = np.zeros((len(corners), 2), np.uint8)
        body = np.concatenate([numbers.reshape(-1, 48), attribute], axis=1).tobytes()
        return b"scan".ljust(80) + np.uint32(len(corners)).tobytes() + body
    lines = ["solid scan"]
    for normal, triangle in zip(normals.tolist(), corners.tolist(), strict=True):
        lines += ["facet normal {:.6f} {:.6f} {:.6f}".format(*normal), "outer loop"]
        lines += ["vertex {:.5f} {:.5f} {:.5f}".format(*corner) for corner in triangle]
        lines += ["endloop", "endfacet"]
    return ("\n".join([*lines, "endsolid scan"]) + "\n").encode()


def _header(mesh: Mesh, kind: str) -> list[str]:
    colors = [] if mesh.colors is None else [f"property uchar {name}" for name in ("red", "green", "blue")]
    return [
        "ply", f"format {kind} 1.0", f"element vertex {len(mesh.vertices)}",
        *(f"property float {axis}" for axis in "xyz"), *colors,
        f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip


def _ply(mesh: Mesh) -> bytes:
    """Encode as binary PLY."""
    rows = [mesh.vertices.astype("<f4").view(np.uint8).reshape(-1, 12)]
    if mesh.colors is not None:
        rows.append(mesh.colors)
    vertices = np.concatenate(rows, axis=1)
    faces = np.zeros(len(mesh.faces), [("n", "u1"), ("index", "<i4", 3)])
    faces["n"], faces["index"] = 3, mesh.faces
    header = "\n".join(_header(mesh, "binary_little_endian")) + "\n"
    return header.encode() + vertices.tobytes() + faces.tobytes()


def _ply_ascii(mesh: Mesh) -> bytes:
    lines = _header(mesh, "ascii")
    places = [f"{x:.5f} {y:.5f} {z:.5f}" for x, y, z in mesh.vertices.tolist()]
    if mesh.colors is not None:
        places = [f"{place} {r} {g} {b}" for place, (r, g, b) in zip(places, mesh.colors.tolist(), strict=True)]
    lines += places
    lines += [f"3 {a} {b} {c}" for a, b, c in mesh.faces.tolist()]
    return ("\n".join(lines) + "\n").encode()


def _welded(vertices: Array, faces: Faces, colors: NDArray[np.uint8]) -> tuple[Array, Faces, NDArray[np.uint8]]:
    """Merge coincident vertices of adjacent parts; they take the colour of the first part, the crown."""
    _, first, index = np.unique(vertices.round(6), axis=0, return_index=True, return_inverse=True)
    joined = index.reshape(-1)[faces].astype(np.int32)
    a, b, c = joined.T
    return vertices[first], joined[(a != b) & (b != c) & (c != a)], colors[first]


def _subdivided(vertices: Array, faces: Faces, colors: NDArray[np.uint8]) -> tuple[Array, Faces, NDArray[np.uint8]]:
    """Split every face into four; a new vertex takes its colour from the edge's corner with the lower index."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, index = np.unique(edges, axis=0, return_inverse=True)
    middle = (index.reshape(-1, 3) + len(vertices)).astype(np.int32)
    a, b, c = faces.T
    ab, bc, ca = middle.T
    quarters = [np.stack(t, 1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]
    points = np.concatenate([vertices, vertices[unique].mean(1)])
    return points, np.concatenate(quarters).astype(np.int32), np.concatenate([colors, colors[unique[:, 0]]])


def _thinned(mesh: Mesh, count: int) -> tuple[Array, Faces, NDArray[np.uint8]]:
    """Decimate each colour separately, so that the lines between colours are preserved."""
    if mesh.colors is None:
        raise ValueError("the arch has no vertex colours")
    label = tooth_labels(mesh) != GUM
    crown = label[mesh.faces].sum(1) >= 2
    parts, colors = [], []
    for own, color in ((crown, RED), (~crown, GREY)):
        faces = mesh.faces[own]
        if not len(faces):
            continue
        vertices, kept = decimated(mesh.vertices, faces, int(count * own.mean()))
        parts.append((vertices, kept))
        colors.append(np.tile(np.array(color, np.uint8), (len(vertices), 1)))
    vertices, faces = merged(parts)
    return vertices, faces, np.concatenate(colors)


def _dirty(
    vertices: Array, faces: Faces, colors: NDArray[np.uint8], rng: np.random.Generator
) -> tuple[Array, Faces, NDArray[np.uint8]]:
    """Add duplicate and degenerate faces, and loose grey fragments near the gum."""
    pick = faces[rng.integers(len(faces), size=40)]
    degenerate = pick.copy()
    degenerate[:, 2] = degenerate[:, 1]
    around = vertices[(colors == colors[-1]).all(1)] if (colors != colors[0]).any() else vertices
    crumbs, crumb_faces = [], []
    tetrahedron = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], np.int32)
    middle = vertices.mean(0)
    for k in range(4):
        place = around[rng.integers(len(around))]
        away = (place - middle) / np.linalg.norm(place - middle)
        crumbs.append(place - 2.0 * away + 0.2 * rng.normal(size=(4, 3)))
        crumb_faces.append(tetrahedron + len(vertices) + 4 * k)
    points = np.concatenate([vertices, *crumbs])
    everything = np.concatenate([faces, pick[:20], degenerate, *crumb_faces]).astype(np.int32)
    return points, everything, np.concatenate([colors, np.tile(np.array(GREY, np.uint8), (16, 1))])
