"""The paper's energy, eqs. 6 to 9: the number of pixels in which a projected scan and the masks disagree."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol

import numba
import numpy as np
from numba import types
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import TrackingError
from jawusd.formats.mesh import BOUNDARY, Mesh, crown_face_mask, tooth_labels
from jawusd.geometry import transform_points
from jawusd.meshes.meshio import winding
from jawusd.meshes.raster import Bits, Singles, count_and_not, draw_silhouette, pack_bits, project
from jawusd.tracking.contour.views import View

_MARGIN_PX = 48  # margin [px] of the screen buffer around the initial scan: 7 mm, more than any search moves the scan
_FARTHEST_PX = 1024  # maximum extent [px] of the screen buffer beyond the masks

_MATRICES = types.Array(types.float32, 3, "C", readonly=True)
_SCREENS = types.Array(types.uint64, 3, "C", readonly=True)
_VERTICES = types.Array(types.float32, 2, "C", readonly=True)
_FACES = types.Array(types.int32, 2, "C", readonly=True)
_COUNTS = types.Array(types.int64, 2, "C")


class PixelCounter(Protocol):
    """Protocol of renderers that count the pixels of a scan: `RasterCounter` and `paper.gl.GlCounter`."""

    def show(self, matrices: Array, masks: Mask) -> None:
        """Set the masks (C, h, w) of one frame, and the matrices (C, 3, 4) of their views."""

    def counts(self, poses: Array) -> NDArray[np.int64]:
        """Return E_SP and E_BND of poses (N, 4, 4) in every view, shape (N, C, 2)."""


@dataclass(frozen=True, eq=False)
class PaperScan:
    """Regions of a teeth scan, coloured as in the paper (fig. 8)."""

    vertices: Array  # scan coordinates [mm], shape (V, 3)
    plain_faces: NDArray[np.int32]  # red: parts of teeth that only have to cover the mask, shape (F, 3)
    boundary_faces: NDArray[np.int32]  # green: the boundary of interest, shape (B, 3)
    cull: bool  # whether to cull back faces, which halves the time; needs faces counter-clockwise seen from outside
    centre: Array  # centroid of the teeth [mm], shape (3,)


def paper_scan(mesh: Mesh, name: str) -> PaperScan:
    """Extract the red and green regions of a painted teeth scan; a face is green if at least two of its corners are.

    Raises:
        TrackingError: the scan has no boundary of interest.
    """
    corner = tooth_labels(mesh)[mesh.faces]
    teeth = crown_face_mask(mesh)
    boundary = (corner == BOUNDARY).sum(1) >= 2
    if not boundary.any():
        raise TrackingError(
            f"{name} teeth scan: no boundary of interest, which the paper's energy needs (eq. 9)",
            hint="Paint the incisal edges of the front teeth green in the scan, or track with --solver contour.",
        )
    wound = winding(mesh)
    return PaperScan(
        vertices=np.asarray(mesh.vertices, np.float64),
        plain_faces=np.ascontiguousarray(mesh.faces[teeth & ~boundary], np.int32),
        boundary_faces=np.ascontiguousarray(mesh.faces[boundary], np.int32),
        # Back faces of a solid are hidden by front faces, provided that all faces are wound consistently.
        cull=wound.outward and wound.consistent,
        centre=mesh.vertices[np.unique(mesh.faces[teeth])].mean(0),
    )


class PaperEnergy:
    """Energy of poses of one arch.

    Every view is rendered into a screen buffer around the teeth, without a depth buffer: a pixel counts as red or green
    if any triangle of this colour covers its centre. With back-face culling, the counts differ by about ten pixels.
    As in the paper, boundary pixels in the mask of the other arch count, which biases the lower arch in closed bites.
    """

    def __init__(self, counter: PixelCounter, scan: PaperScan, boundary_weight: float) -> None:
        """Combine a renderer of the scan with lambda of eq. 7, the weight of the boundary term."""
        self._counter, self._scan, self._weight = counter, scan, boundary_weight
        self.evaluations = 0

    def show(self, views: Sequence[View], row: int, start: Array) -> None:
        """Set the masks of one frame, in the views with a mask of arch `row`, and T_world_scan (4, 4) of the start."""
        boxes = np.stack([self._box(view, start) for view in views])
        width, height = (boxes[:, 2:] - boxes[:, :2]).max(0)
        masks = np.zeros((len(views), height, width), bool)
        matrices = np.empty((len(views), 3, 4))
        for k, (view, (x0, y0, _, _)) in enumerate(zip(views, boxes, strict=True)):
            rows, columns = view.masks.shape[1:]
            inside = (slice(-y0, rows - y0), slice(-x0, columns - x0))
            masks[k][inside] = view.masks[row] > 127
            matrices[k] = np.array([[1, 0, -x0], [0, 1, -y0], [0, 0, 1]]) @ view.matrix
        self.mask_px = masks.sum((1, 2))
        self._counter.show(matrices, masks)

    def _box(self, view: View, start: Array) -> NDArray[np.int64]:
        """Return the box x0, y0, x1, y1 [px] around a view's masks and the initial scan; x0 and y0 are at most 0."""
        vertices = self._scan.vertices[np.unique(self._scan.boundary_faces)]
        h = transform_points(start, vertices) @ view.matrix[:, :3].T + view.matrix[:, 3]
        seen = h[:, :2] / h[:, 2:]
        size = np.array(view.masks.shape[:0:-1])
        low = np.clip(np.floor(seen.min(0)) - _MARGIN_PX, -_FARTHEST_PX, 0)
        high = np.clip(np.ceil(seen.max(0)) + _MARGIN_PX, size, size + _FARTHEST_PX)
        return np.concatenate([low, high]).astype(np.int64)

    def __call__(self, poses: Array) -> Array:
        """Return E = E_SP + lambda E_BND (eq. 7), summed over the views (eq. 6), of poses (N, 4, 4), shape (N,)."""
        self.evaluations += len(poses)
        counts = self._counter.counts(poses).sum(1)
        return counts[:, 0] + self._weight * counts[:, 1]

    def uncovered_px(self, pose: Array) -> NDArray[np.int64]:
        """Return E_SP (eq. 8) of a pose (4, 4) per view, shape (C,)."""
        return self._counter.counts(pose[None])[0, :, 0]


@numba.njit(
    types.void(_VERTICES, _FACES, _FACES, types.boolean, _MATRICES, types.int64, _SCREENS, types.int64, _COUNTS),
    nogil=True,
    cache=True,
)
def _count(
    vertices: Singles,
    plain_faces: NDArray[np.int32],
    boundary_faces: NDArray[np.int32],
    cull: bool,
    matrices: Singles,
    first: int,
    masks: Bits,
    width: int,
    counts: NDArray[np.int64],
) -> None:
    """Write the counts (T, 2) of T renderings, starting at index `first`; all views of a pose are consecutive."""
    points = np.empty((vertices.shape[0], 3), np.float32)
    bits = np.empty((masks.shape[1], masks.shape[2]), np.uint64)
    for t in range(counts.shape[0]):
        view = (first + t) % masks.shape[0]
        project(vertices, matrices[first + t], points)
        bits[:] = 0
        draw_silhouette(points, boundary_faces, 0, 0, width, cull, bits)
        counts[t, 1] = count_and_not(bits, masks[view])
        draw_silhouette(points, plain_faces, 0, 0, width, cull, bits)
        counts[t, 0] = count_and_not(masks[view], bits)


class RasterCounter:
    """CPU pixel counter based on the bit-row rasteriser; the counts do not depend on the number of threads."""

    def __init__(self, scan: PaperScan, threads: int = 1) -> None:
        plain = len(scan.plain_faces)
        used, index = np.unique(np.concatenate([scan.plain_faces, scan.boundary_faces]), return_inverse=True)
        faces = np.ascontiguousarray(index.reshape(-1, 3), np.int32)
        self._vertices = np.ascontiguousarray(scan.vertices[used], np.float32)
        self._plain, self._boundary = faces[:plain], faces[plain:]
        self._cull, self._threads = scan.cull, threads
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None

    def show(self, matrices: Array, masks: Mask) -> None:
        """Set masks (C, h, w) of a frame and matrices (C, 3, 4), world [mm] to pixels, or raises ValueError."""
        checked_screens(matrices, masks)
        self._matrices = np.asarray(matrices, np.float64)
        self._width = masks.shape[2]
        self._masks = np.stack([pack_bits(mask) for mask in masks])

    def counts(self, poses: Array) -> NDArray[np.int64]:
        """Return E_SP and E_BND, the numbers of disagreeing pixels, for T_world_scan (N, 4, 4), shape (N, C, 2).

        E_SP counts mask pixels not covered by the scan (eq. 8), E_BND boundary pixels outside the mask (eq. 9).
        """
        matrices = np.einsum("cij,njk->ncik", self._matrices, poses).reshape(-1, 3, 4).astype(np.float32)
        counts = np.empty((len(matrices), 2), np.int64)
        bounds = np.linspace(0, len(matrices), self._threads + 1).astype(int)

        def part(k: int) -> None:
            _count(
                self._vertices, self._plain, self._boundary, self._cull, matrices, bounds[k], self._masks,
                self._width, counts[bounds[k] : bounds[k + 1]],
            )  # fmt: skip

        list((self._pool.map if self._pool else map)(part, range(self._threads)))
        return counts.reshape(len(poses), -1, 2)


def checked_screens(matrices: Array, masks: Mask) -> None:
    """Raise ValueError unless matrices are (C, 3, 4) and masks (C, h, w) with C, h, w > 0."""
    views = len(matrices)
    if np.shape(matrices) != (views, 3, 4) or np.ndim(masks) != 3 or len(masks) != views or 0 in np.shape(masks):
        raise ValueError(
            f"matrices and masks must be (C, 3, 4) and (C, h, w), got {np.shape(matrices)} and {np.shape(masks)}"
        )
