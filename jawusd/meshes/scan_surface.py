"""Clean surface of a teeth scan, and its border of crown and gum, found by random walks that rarely cross creases.

A clean surface has merged points and no degenerate or duplicate faces; its components and creases are known. Seeds of
the walks are vertices that are certainly crown or gum. A vertex is labelled crown if a random walk that starts there is
more likely to reach a crown seed first than a gum seed (Grady, "Random walks for image segmentation", PAMI 2006).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array, Indices, Mask
from jawusd.formats.mesh import Mesh
from jawusd.geometry.points import welded
from jawusd.meshes.surfaces import summed_normals

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
        vertices, index = welded(mesh.vertices[:, ::-1])
        vertices = np.ascontiguousarray(vertices[:, ::-1])
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
        kept = np.sort(np.unique(welded(np.sort(faces, axis=1))[1], return_index=True)[1])
        return cls(
            vertices=vertices,
            faces=faces[kept],
            of_vertex=index,
            piece=components(faces[kept], len(vertices)),
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
        """Return the median length [mm] of edges (E, 2)."""
        return float(np.median(np.linalg.norm(self.vertices[edges[:, 0]] - self.vertices[edges[:, 1]], axis=1)))

    def wound(self, up: Array) -> ScanSurface:
        """Return the surface with components turned outward, judged by their part seen from the side `up` (3,)."""
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
        return replace(self, faces=np.where(turned[:, None], self.faces[:, ::-1], self.faces))

    def normals(self) -> Array:
        """Return the unit normals of the vertices, averaged over a few tenths of a millimetre, shape (v, 3)."""
        normals = summed_normals(self.vertices, self.faces)
        edges = self.edges()
        length = self.edge_mm(edges)
        mean = averaging(edges, len(self.vertices))
        # The kernel of one averaging step has a standard deviation of about 0.7 edge lengths; variances add.
        for _ in range(int(np.clip(round(2 * (_SCALE_MM / max(length, 1e-6)) ** 2), 0, _MOST_ROUNDS))):
            normals = mean @ normals
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)

    def creases(self, edges: Indices) -> Array:
        """Return the inward curvature at every vertex [1/mm], shape (v,), >= 0.

        This is the negated smaller principal curvature where that is negative, from Taubin's tensor of the normal
        curvatures along the edges ("Estimating the tensor of curvature of a surface from a polyhedral approximation",
        ICCV 1995), with averaged normals. Where edges are too long for this, fold angles between faces are used.
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


def components(faces: NDArray[np.int64] | NDArray[np.int32], count: int) -> Indices:
    """Return the index of the connected component of each of `count` vertices, (count,), of faces or edges (F, k)."""
    ends = faces.ravel(), np.roll(faces, 1, axis=1).ravel()
    links = coo_array((np.ones(faces.size, np.int8), ends), shape=(count, count))
    return connected_components(links, directed=False)[1].astype(np.int64)


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


# Length over which step weights decay as inward curvature grows: their factor is exp(-_CREASE_DECAY_MM * curvature).
_CREASE_DECAY_MM = 2.5
_SHARPEST = 3.0  # maximum curvature in the step weights [1/mm]; larger curvatures are clamped to it
# Weight of colour: the approximate probability per step that a walk stops. A stopped walk ends in crown or gum at
# random, with the probability given by the local colour.
_COLOUR_WEIGHT = 0.02
_COLOUR_STEP = 0.3  # minimum difference in crown probability between adjacent vertices for colour to support a border
_TOLERANCE, _STEPS = 1e-3, 600
# Minimum curvature [1/mm] of a crease that supports a border, and maximum distance of the crease from the border.
_EVIDENCE, _EVIDENCE_REACH_MM = 0.6, 0.5


class CreaseWalk:
    """Random walks between the vertices of one surface."""

    def __init__(self, surface: ScanSurface, by_colour: Array | None = None) -> None:
        """Find the creases; `by_colour` is the crown probability of each vertex by colour, 0 to 1, shape (v,)."""
        self._surface, self.by_colour = surface, by_colour
        self.edges = surface.edges()
        self.crease = surface.creases(self.edges)
        self._weights = self._stepping()

    def crowns(self, up: Mask, down: Mask, most_leaving: Array) -> Mask:
        """Return which vertices are crown, shape (v,), given which are crown seeds `up` and gum seeds `down`, (v,).

        `most_leaving` (v,) is the maximum rate at which walks leave a part of `up` for the gum, per mm of its outline
        [1/mm]. Parts with a higher rate have no crease around them: they are gum ridges, no seeds.
        """
        share = self._meeting(up, down)
        leaking = self._leaking(share, up, most_leaving)
        if leaking.any():
            up = up & ~leaking
            share = self._meeting(up, down)
        return self._without_islands(share > 0.5, up, down)

    def weak(self, crown: Mask) -> tuple[Indices, Mask]:
        """Return the edges between crown and gum, shape (n, 2), and which of them have no crease nearby, shape (n,)."""
        across = self.edges[crown[self.edges[:, 0]] != crown[self.edges[:, 1]]]
        supported = self.crease > _EVIDENCE
        if self.by_colour is not None:
            supported[self.edges[np.abs(np.diff(self.by_colour[self.edges], axis=1))[:, 0] > _COLOUR_STEP]] = True
        sharp = self._surface.vertices[supported]
        if not len(sharp) or not len(across):
            return across, np.ones(len(across), dtype=bool)
        middle = self._surface.vertices[across].mean(axis=1)
        return across, cKDTree(sharp).query(middle)[0] > _EVIDENCE_REACH_MM

    def _stepping(self) -> csr_array:
        """Return the step weights between vertices, shape (v, v): cotangent weights, reduced across creases."""
        surface, crease, parts = self._surface, self.crease, []
        corners = surface.vertices[surface.faces]
        for k in range(3):
            i, j = surface.faces[:, (k + 1) % 3], surface.faces[:, (k + 2) % 3]
            one, two = corners[:, (k + 1) % 3] - corners[:, k], corners[:, (k + 2) % 3] - corners[:, k]
            area = np.maximum(np.linalg.norm(np.cross(one, two), axis=1), 1e-9)
            # Cotangents are clamped because they are unbounded in slivers.
            weight = np.clip(np.einsum("ij,ij->i", one, two) / area, 0.05, 3.0) / 2
            weight *= np.exp(-_CREASE_DECAY_MM * np.minimum(0.5 * (crease[i] + crease[j]), _SHARPEST))
            parts.append((i, j, weight))
        rows, columns, values = (np.concatenate(part) for part in zip(*parts, strict=True))
        n = len(surface.vertices)
        one_way = coo_array((values, (rows, columns)), shape=(n, n)).tocsr()
        return csr_array(one_way + one_way.T)

    def _meeting(self, up: Mask, down: Mask) -> Array:
        """Return the probability that a walk from each vertex reaches a seed `up` before a seed `down`, shape (v,)."""
        share = np.where(up, 1.0, np.where(down, 0.0, 0.5))
        free, fixed = ~(up | down), up | down
        if not free.any() or not up.any() or not down.any():
            return np.where(up | ~down & up.any(), 1.0, 0.0)
        degree = self._weights.sum(axis=1)[free] + 1e-9
        inner = csr_array(diags_array(degree) - self._weights[free][:, free])
        start = self._weights[free][:, fixed] @ share[fixed] + 0.5e-9
        if self.by_colour is not None:
            inner = csr_array(inner + diags_array(_COLOUR_WEIGHT * degree))
            start = start + _COLOUR_WEIGHT * degree * self.by_colour[free]
        found, _ = cg(inner, start, x0=share[free], rtol=_TOLERANCE, maxiter=_STEPS, M=diags_array(1.0 / degree))
        share[free] = found
        return share

    def _leaking(self, share: Array, up: Mask, most_leaving: Array) -> Mask:
        """Return which crown seeds are in connected parts from which too many walks reach the gum, shape (v,)."""
        part = parts(self.edges, up)
        count = int(part.max(initial=-1)) + 1
        steps = coo_array(self._weights)
        inside, outside = steps.coords
        leaving = (part[inside] >= 0) & (part[outside] < 0)
        i, j = inside[leaving], outside[leaving]
        flow = np.bincount(part[i], steps.data[leaving] * (1.0 - share[j]), count)
        # Each edge that crosses the outline adds its length to that of the outline.
        length = np.linalg.norm(self._surface.vertices[i] - self._surface.vertices[j], axis=1)
        outline = np.maximum(np.bincount(part[i], length, count), 1e-9)
        number = np.maximum(np.bincount(part[i], minlength=count), 1)
        most = np.bincount(part[i], np.minimum(most_leaving[i], 1.0), count) / number
        return np.asarray((part >= 0) & (flow / outline > most)[part])

    def _without_islands(self, crown: Mask, up: Mask, down: Mask) -> Mask:
        """Return the crown vertices after connected parts without a seed have been given the other label."""
        for label, start in ((True, up), (False, down)):
            part = parts(self.edges, crown == label)
            started = np.zeros(int(part.max(initial=-1)) + 2, dtype=bool)
            started[part[start & (crown == label)]] = True
            crown = np.where((part >= 0) & ~started[part], not label, crown)
        return crown


def parts(edges: Indices, chosen: Mask) -> Indices:
    """Return the index of the connected part of each chosen vertex, from 0, and -1 for other vertices, shape (v,)."""
    inside = edges[chosen[edges].all(axis=1)]
    part = components(inside, len(chosen))
    out = np.full(len(chosen), -1, np.int64)
    out[chosen] = np.unique(part[chosen], return_inverse=True)[1].reshape(-1)
    return out
