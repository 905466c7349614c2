"""Find the border between crown and gum on one surface by random walks that rarely cross creases.

Seeds are vertices that are certainly crown or gum. A vertex is labelled crown if a random walk that starts there is
more likely to reach a crown seed first than a gum seed (Grady, "Random walks for image segmentation", PAMI 2006).
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array, Indices, Mask
from jawusd.meshes.scan_surface import ScanSurface

# Decay length of step weights with inward curvature: they are multiplied by exp(-_CREASE_DECAY_MM * curvature).
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
        """Return which vertices are crown, shape (v,).

        Args:
            up, down: which vertices are crown seeds and gum seeds, shape (v,).
            most_leaving: maximum rate at which walks leave a part of `up` for the gum, per mm of its outline [1/mm],
                shape (v,). Parts with a higher rate have no crease around them: they are gum ridges and are discarded
                as seeds.
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
        # Each edge that crosses the outline counts as outline of its own length.
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
    links = coo_array((np.ones(len(inside), np.int8), (inside[:, 0], inside[:, 1])), shape=(len(chosen),) * 2)
    part = connected_components(links, directed=False)[1]
    out = np.full(len(chosen), -1, np.int64)
    out[chosen] = np.unique(part[chosen], return_inverse=True)[1].reshape(-1)
    return out
