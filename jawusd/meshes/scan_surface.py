"""Clean surface of a teeth scan: merged points, no degenerate or duplicate faces; its components and creases."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array, Indices
from jawusd.formats.mesh import Mesh

# Length [mm] over which normals are averaged before curvature is computed. Scanners round creases by a few tenths of a
# millimetre and cause ripples of a few hundredths.
_SCALE_MM = 0.35
_MOST_ROUNDS = 12
# Mean edge length at a vertex up to which creases are found from normals; above twice this length, from face angles.
_FINE_MM = 0.4
_SEEN_MM = 0.75  # cell size of the test for visibility from above


@dataclass(frozen=True, eq=False)
class ScanSurface:
    """Surface of a scan whose faces share vertices."""

    vertices: Array  # positions [mm], shape (v, 3)
    faces: NDArray[np.int64]  # vertex indices, shape (f, 3)
    of_vertex: Indices  # index of the surface vertex of each scan vertex, shape (V,)
    piece: Indices  # index of the connected component of each vertex, shape (v,)
    merged: int  # number of scan vertices merged with a coincident vertex
    empty: int  # number of dropped degenerate faces
    repeated: int  # number of dropped duplicate faces

    @classmethod
    def of(cls, mesh: Mesh) -> ScanSurface:
        """Return the cleaned surface of a scan."""
        vertices, index = merged_places(mesh.vertices)
        merged = len(mesh.vertices) - len(vertices)
        faces = index[mesh.faces]
        solid = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        faces = faces[solid]
        used = np.zeros(len(vertices), dtype=bool)
        used[faces] = True
        if used.any() and not used.all():  # unused vertices map to the nearest surface vertex
            number = np.cumsum(used) - 1
            number[~used] = cKDTree(vertices[used]).query(vertices[~used])[1]
            vertices, index, faces = vertices[used], number[index], number[faces]
        corners = np.sort(faces, axis=1)
        n = len(vertices)
        order = np.lexsort(corners.T)
        ranked = corners[order]
        new = np.r_[True, (ranked[1:] != ranked[:-1]).any(axis=1)][: len(ranked)]
        kept = np.sort(order[new])
        links = coo_array(
            (np.ones(3 * len(kept), np.int8), (faces[kept].ravel(), np.roll(faces[kept], 1, axis=1).ravel())),
            shape=(n, n),
        )
        piece = connected_components(links, directed=False)[1]
        return cls(
            vertices=vertices,
            faces=faces[kept],
            of_vertex=index,
            piece=piece.astype(np.int64),
            merged=merged,
            empty=int(len(solid) - solid.sum()),
            repeated=len(faces) - len(kept),
        )

    def edges(self) -> Indices:
        """Return the unique edges, shape (E, 2)."""
        n = len(self.vertices)
        pairs = np.sort(self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        return np.stack(np.divmod(np.unique(pairs[:, 0] * n + pairs[:, 1]), n), axis=1)

    def edge_mm(self, edges: Indices) -> float:
        """Return the median length of edges (E, 2) [mm]."""
        return float(np.median(np.linalg.norm(self.vertices[edges[:, 0]] - self.vertices[edges[:, 1]], axis=1)))

    def wound(self, up: Array) -> ScanSurface:
        """Return the surface with inward-facing components flipped; `up` (3,) is the occlusal direction.

        A component faces outward if its part that is visible from the occlusal side faces that side.
        """
        corners = self.vertices[self.faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        owner = self.piece[self.faces[:, 0]]
        middle = corners.mean(axis=1)
        one = np.cross(up, np.eye(3)[np.abs(up).argmin()])
        plan = np.floor(middle @ np.stack([one, np.cross(up, one)], axis=1) / _SEEN_MM).astype(np.int64)
        plan -= plan.min(axis=0)
        cell = (owner * (plan[:, 0].max() + 1) + plan[:, 0]) * (plan[:, 1].max() + 1) + plan[:, 1]
        index = np.unique(cell, return_inverse=True)[1].reshape(-1)
        height = middle @ up
        highest = np.full(int(index.max()) + 1, -np.inf)
        np.maximum.at(highest, index, height)
        seen = height > highest[index] - _SEEN_MM / 2
        turned = (np.bincount(owner, np.where(seen, cross @ up, 0.0), int(self.piece.max()) + 1) < 0)[owner]
        faces = np.where(turned[:, None], self.faces[:, ::-1], self.faces)
        return ScanSurface(self.vertices, faces, self.of_vertex, self.piece, self.merged, self.empty, self.repeated)

    def normals(self) -> Array:
        """Return the unit normals of the vertices, averaged over a few tenths of a millimetre, shape (v, 3)."""
        corners = self.vertices[self.faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        n = len(self.vertices)
        corner = self.faces.ravel()
        normals = np.stack([np.bincount(corner, np.repeat(cross[:, k], 3), n) for k in range(3)], axis=1)
        edges = self.edges()
        length = self.edge_mm(edges)
        mean = averaging(edges, n)
        # The kernel of one averaging step has a standard deviation of about 0.7 edge lengths; variances add.
        for _ in range(int(np.clip(round(2 * (_SCALE_MM / max(length, 1e-6)) ** 2), 0, _MOST_ROUNDS))):
            normals = mean @ normals
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)

    def creases(self, edges: Indices) -> Array:
        """Return the inward curvature at every vertex [1/mm], shape (v,), >= 0.

        This is the negated smaller principal curvature where that is negative, from Taubin's tensor of the normal
        curvatures along the edges ("Estimating the tensor of curvature of a surface from a polyhedral approximation",
        ICCV 1995), computed with averaged normals. Where edges are too long for this, fold angles between faces are
        used.
        """
        n = len(self.vertices)
        normals = self.normals()
        along = self.vertices[edges[:, 1]] - self.vertices[edges[:, 0]]
        square = np.maximum(np.einsum("ij,ij->i", along, along), 1e-12)
        bend = np.einsum("ij,ij->i", normals[edges[:, 1]] - normals[edges[:, 0]], along) / square
        ends, bend, along = edges.ravel(), np.repeat(bend, 2), np.repeat(along / np.sqrt(square)[:, None], 2, axis=0)
        one, two = _tangents(normals)
        a, b = (np.einsum("ij,ij->i", along, axis[ends]) for axis in (one, two))
        # Fit the symmetric 2 x 2 curvature tensor to k = xx a^2 + 2 xy a b + yy b^2 by least squares.
        rows = np.stack([a * a, 2 * a * b, b * b], axis=1)
        A = np.empty((n, 3, 3))
        y = np.empty((n, 3))
        for i in range(3):
            y[:, i] = np.bincount(ends, rows[:, i] * bend, n)
            for j in range(i, 3):
                A[:, i, j] = A[:, j, i] = np.bincount(ends, rows[:, i] * rows[:, j], n)
        A += 1e-3 * np.eye(3)
        xx, xy, yy = np.linalg.solve(A, y[..., None])[..., 0].T
        least = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
        length = np.bincount(ends, np.repeat(np.sqrt(square), 2), n) / np.maximum(np.bincount(ends, minlength=n), 1)
        coarse = np.clip((length - _FINE_MM) / _FINE_MM, 0.0, 1.0)
        return np.maximum(np.maximum(-least, 0.0), coarse * self._folds() / _SCALE_MM)

    def _folds(self) -> Array:
        """Return the largest inward fold angle between two faces at every vertex [rad], shape (v,), >= 0."""
        n = len(self.vertices)
        corners = self.vertices[self.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        pairs = np.sort(self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        key = pairs[:, 0] * n + pairs[:, 1]
        order = np.argsort(key, kind="stable")
        same = key[order][1:] == key[order][:-1]
        first, second = order[:-1][same], order[1:][same]
        one, two = first // 3, second // 3
        middle = corners.mean(axis=1)
        inwards = np.einsum("ij,ij->i", middle[two] - middle[one], normals[one]) > 0
        angle = np.where(inwards, np.arccos(np.clip(np.einsum("ij,ij->i", normals[one], normals[two]), -1, 1)), 0.0)
        fold = np.zeros(n)
        np.maximum.at(fold, pairs[first].ravel(), np.repeat(angle, 2))
        return fold


def merged_places(vertices: Array) -> tuple[Array, Indices]:
    """Return the unique positions (v, 3) of vertices (V, 3), and the index of the position of each vertex, (V,)."""
    order = np.lexsort(vertices.T)
    ranked = vertices[order]
    new = np.r_[True, (ranked[1:] != ranked[:-1]).any(axis=1)]
    index = np.empty(len(vertices), np.int64)
    index[order] = np.cumsum(new) - 1
    return np.ascontiguousarray(ranked[new]), index


def averaging(edges: Indices, count: int) -> csr_array:
    """Return the matrix that averages the value at each of `count` vertices with the mean of its neighbours' values."""
    rows, columns = np.r_[edges[:, 0], edges[:, 1]], np.r_[edges[:, 1], edges[:, 0]]
    degree = np.maximum(np.bincount(rows, minlength=count), 1)
    own = np.arange(count)
    values = np.r_[0.5 / degree[rows], np.full(count, 0.5)]
    return csr_array(coo_array((values, (np.r_[rows, own], np.r_[columns, own])), shape=(count, count)))


def _tangents(normals: Array) -> tuple[Array, Array]:
    """Return two orthonormal tangents for each unit normal (v, 3)."""
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    one = np.cross(normals, helper)
    one /= np.maximum(np.linalg.norm(one, axis=1, keepdims=True), 1e-12)
    return one, np.cross(normals, one)
