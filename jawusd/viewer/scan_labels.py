"""Edit the crown, gum and base labels of the teeth scans with a brush: state of the labels, and panel."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping

import numpy as np
import viser
from numpy.typing import NDArray

from jawusd.base.arrays import Indices, Mask
from jawusd.formats.mesh import BASE, GUM, TOOTH, Mesh
from jawusd.viewer.viewed import Callback, ViewedCapture
from jawusd.viewer.widgets import Choice, Client, enable, guarded, notify, small_text

#: Label painted by each button.
BRUSHES = {"crown": TOOTH, "gum": GUM, "base": BASE}
_HELP = (
    "White: crown, red: gum, blue: base. Click on a scan to paint around the clicked point. Tracking uses only the "
    "line between crown and gum; labels below the gum have no effect."
)
_RADIUS_MM = (0.3, 8.0, 0.1, 1.5)  # radius of the brush: minimum, maximum, step, initial value


class ScanBrush:
    """Editable labels of both scans in one page, with undo.

    `labels` has the label of every vertex as in `formats.mesh`, uint8 (V,), by arch; `changed` names unsaved arches;
    `strokes`, which can be undone, have the arch, its vertices, and their labels before.
    """

    def __init__(self, scans: Mapping[str, Mesh], labels: Mapping[str, NDArray[np.uint8]]) -> None:
        self._scans = scans
        self.labels = {arch: found.copy() for arch, found in labels.items()}
        self.strokes: list[tuple[str, Indices, NDArray[np.uint8]]] = []
        self.changed: set[str] = set()

    def paint(self, arch: str, vertex: int, radius_mm: float, label: int) -> int:
        """Label the connected surface within a radius of a vertex; return the number of vertices changed."""
        near = surface_near(self._scans[arch], vertex, radius_mm)
        near = near[self.labels[arch][near] != label]
        if len(near):
            self.strokes.append((arch, near, self.labels[arch][near]))
            self.labels[arch][near] = label
            self.changed.add(arch)
        return len(near)

    def undo(self) -> str | None:
        """Undo the last stroke; return its arch, or None if there is no stroke."""
        if not self.strokes:
            return None
        arch, where, before = self.strokes.pop()
        self.labels[arch][where] = before
        self.changed.add(arch)
        return arch

    def faces_with(self, arch: str, label: int) -> Mask:
        """Return a mask of an arch's faces that have a label at most of their corners, shape (F,)."""
        corner = self.labels[arch][self._scans[arch].faces]
        tooth = ((corner != GUM) & (corner != BASE)).sum(axis=1) >= 2
        base = (corner == BASE).sum(axis=1) >= 2
        return np.asarray(tooth if label == TOOTH else base & ~tooth if label == BASE else ~tooth & ~base)


def surface_near(mesh: Mesh, vertex: int, radius_mm: float) -> Indices:
    """Return the vertices within a radius of a vertex that are connected to it by faces within that radius."""
    inside = np.linalg.norm(mesh.vertices - mesh.vertices[vertex], axis=1) <= radius_mm
    faces = mesh.faces[inside[mesh.faces].all(axis=1)]
    members = np.flatnonzero(inside)
    # Merge coincident vertices, since the faces of a triangle soup share no vertices.
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


class ScanLabelsPanel:
    """Widgets that control the brush; a click paints `label`."""

    def __init__(
        self, client: Client, capture: ViewedCapture, turned: Callback, painted: Callable[[str], None]
    ) -> None:
        """Add the widgets; call `turned` when painting is switched on or off, and `painted` to redraw an arch."""
        self._client, self._capture, self._turned, self._painted = client, capture, turned, painted
        self.brush = ScanBrush(capture.scans, capture.labels)
        self.label = BRUSHES["crown"]
        gui = client.gui
        gui.add_html(small_text(_HELP))
        self.painting = gui.add_checkbox("clicks paint", False)
        self.painting.on_update(guarded(client, self._turn))
        self.kinds = gui.add_button_group("paint", tuple(BRUSHES))
        self.kinds.on_click(guarded(client, self._choose))
        low, high, step, first = _RADIUS_MM
        self.radius = gui.add_slider("radius [mm]", low, high, step, first)
        self.undo = gui.add_button("undo", icon=viser.Icon.ARROW_BACK_UP)
        self.undo.on_click(guarded(client, self._undo))
        self._state = gui.add_html("")
        self.write = gui.add_button("save the labels", icon=viser.Icon.DEVICE_FLOPPY)
        self.write.on_click(guarded(client, self._write))
        self._show_state()

    def click(self, arch: str, vertex: int) -> None:
        """Paint the surface around a vertex."""
        if self.brush.paint(arch, vertex, self.radius.value, self.label):
            self._painted(arch)
        self._show_state()

    def _show_state(self) -> None:
        enable(self.kinds, self.painting.value)
        enable(self.radius, self.painting.value)
        enable(self.undo, bool(self.brush.strokes))
        name = next(name for name, label in BRUSHES.items() if label == self.label)
        unsaved = " and ".join(sorted(self.brush.changed))
        state = f"painting {name}; {len(self.brush.strokes)} strokes; "
        self._state.content = small_text(state + (f"not saved: {unsaved}" if unsaved else "all saved"))

    def _turn(self, _: object) -> None:
        self._show_state()
        self._turned()

    def _choose(self, event: Choice) -> None:
        self.label = BRUSHES[event.target.value]
        self._show_state()

    def _undo(self, _: object) -> None:
        arch = self.brush.undo()
        if arch is not None:
            self._painted(arch)
        self._show_state()

    async def _write(self, _: object) -> None:
        """Save both arches; an unchanged arch counts as accepted."""
        paths = []
        for arch, labels in self.brush.labels.items():
            paths.append(await asyncio.to_thread(self._capture.save_labels, arch, labels.copy()))
            self.brush.changed.discard(arch)
        self._show_state()
        names = " and ".join(path.name for path in paths)
        notify(self._client, "Written", f"{names}; run track or build again to use them")
