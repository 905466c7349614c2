"""Labels of the teeth scans as a brush changes them: strokes, undo, and what is not saved yet."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Indices, Mask
from jawusd.formats.mesh import BASE, GUM, TOOTH, Mesh

#: What the brush paints, by the name on its button.
BRUSHES = {"crown": TOOTH, "gum": GUM, "base": BASE}


class ScanBrush:
    """Hold the labels of both scans of one page.

    Attributes:
        labels: of `formats.mesh` per vertex, uint8 (V,), by arch.
        changed: arches whose labels differ from those saved.
    """

    def __init__(self, scans: Mapping[str, Mesh], labels: Mapping[str, NDArray[np.uint8]]) -> None:
        self._scans = scans
        self.labels = {arch: found.copy() for arch, found in labels.items()}
        self._strokes: list[tuple[str, Indices, NDArray[np.uint8]]] = []
        self.changed: set[str] = set()

    def paint(self, arch: str, vertex: int, radius_mm: float, label: int) -> int:
        """Label the surface within a radius of a vertex, as far as it hangs together there; return how many change."""
        near = surface_near(self._scans[arch], vertex, radius_mm)
        near = near[self.labels[arch][near] != label]
        if len(near):
            self._strokes.append((arch, near, self.labels[arch][near]))
            self.labels[arch][near] = label
            self.changed.add(arch)
        return len(near)

    @property
    def strokes(self) -> int:
        """Return how many strokes can be taken back."""
        return len(self._strokes)

    def undo(self) -> str | None:
        """Take back the last stroke; return its arch, None where there is none."""
        if not self._strokes:
            return None
        arch, where, before = self._strokes.pop()
        self.labels[arch][where] = before
        self.changed.add(arch)
        return arch

    def saved(self, arch: str) -> None:
        """Note that the labels of an arch are written."""
        self.changed.discard(arch)

    def faces_with(self, arch: str, label: int) -> Mask:
        """Return which faces of an arch are drawn as crown, gum or base, shape (F,): by most of their corners."""
        corner = self.labels[arch][self._scans[arch].faces]
        tooth = ((corner != GUM) & (corner != BASE)).sum(axis=1) >= 2
        base = (corner == BASE).sum(axis=1) >= 2
        return np.asarray(tooth if label == TOOTH else base & ~tooth if label == BASE else ~tooth & ~base)


def surface_near(mesh: Mesh, vertex: int, radius_mm: float) -> Indices:
    """Return the vertices within a radius of one that faces inside the radius connect with it."""
    inside = np.linalg.norm(mesh.vertices - mesh.vertices[vertex], axis=1) <= radius_mm
    faces = mesh.faces[inside[mesh.faces].all(axis=1)]
    members = np.flatnonzero(inside)
    # Vertices at the same place are one: triangle soups share none.
    place = np.unique(mesh.vertices[members], axis=0, return_inverse=True)[1].reshape(-1)
    of_vertex = np.full(len(mesh.vertices), -1, np.int64)
    of_vertex[members] = place
    reached = np.zeros(int(place.max()) + 1, dtype=bool)
    reached[of_vertex[vertex]] = True
    corners = of_vertex[faces]
    while True:
        touched = reached[corners].any(axis=1)
        before = int(reached.sum())
        reached[corners[touched].ravel()] = True
        if int(reached.sum()) == before:
            return members[reached[place]]
