"""Count, for many poses at once, the pixels in which a projected scan and its masks disagree; on the CPU.

The two counts are those of paper eqs. 8 and 9. `jawusd.paper.gl` holds the same on a GPU.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
from numba import types
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.meshes.raster import Bits, Singles, count_and_not, draw_silhouette, pack_bits, project

_MATRICES = types.Array(types.float32, 3, "C", readonly=True)
_SCREENS = types.Array(types.uint64, 3, "C", readonly=True)
_VERTICES = types.Array(types.float32, 2, "C", readonly=True)
_FACES = types.Array(types.int32, 2, "C", readonly=True)
_COUNTS = types.Array(types.int64, 2, "C")


@numba.njit(
    types.void(
        _VERTICES, _FACES, _FACES, types.boolean, _MATRICES, types.int64, _SCREENS, _SCREENS, types.int64, _COUNTS
    ),
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
    free: Bits,
    width: int,
    counts: NDArray[np.int64],
) -> None:
    """Fill counts (T, 2) for drawings first .. first + T of the list pose by pose, view by view."""
    points = np.empty((vertices.shape[0], 3), np.float32)
    bits = np.empty((masks.shape[1], masks.shape[2]), np.uint64)
    for t in range(counts.shape[0]):
        view = (first + t) % masks.shape[0]
        project(vertices, matrices[first + t], points)
        bits[:] = 0
        draw_silhouette(points, boundary_faces, 0, 0, width, cull, bits)
        counts[t, 1] = count_and_not(bits, free[view])
        draw_silhouette(points, plain_faces, 0, 0, width, cull, bits)
        counts[t, 0] = count_and_not(masks[view], bits)


class RasterCounter:
    """Count disagreeing pixels with the bit-row rasteriser; use as a context manager, or close it."""

    def __init__(
        self,
        vertices: Array,
        plain_faces: NDArray[np.int32],
        boundary_faces: NDArray[np.int32],
        *,
        cull: bool = False,
        threads: int = 1,
    ) -> None:
        """Take the scan.

        Args:
            vertices: scan coordinates [mm], shape (V, 3).
            plain_faces: teeth without the boundary of interest (red in the paper's fig. 8), shape (F, 3).
            boundary_faces: the boundary of interest (green), shape (B, 3).
            cull: leave out faces turned away; halves the time where all faces are counter-clockwise from outside.
            threads: worker threads; the counts do not depend on it.
        """
        used, index = np.unique(np.concatenate([plain_faces, boundary_faces]), return_inverse=True)
        faces = np.ascontiguousarray(index.reshape(-1, 3), np.int32)
        self._vertices = np.ascontiguousarray(vertices[used], np.float32)
        self._plain, self._boundary = faces[: len(plain_faces)], faces[len(plain_faces) :]
        self._cull, self._threads = cull, threads
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None

    def show(self, matrices: Array, masks: Mask, free: Mask) -> None:
        """Set the pictures of one instant.

        Args:
            matrices: world [mm] to homogeneous px, per view, shape (C, 3, 4).
            masks: the segmented teeth, shape (C, h, w).
            free: where boundary pixels are not counted: the masks themselves, and whatever else may hide the boundary;
                shape (C, h, w).

        Raises:
            ValueError: the shapes do not agree.
        """
        checked_screens(matrices, masks, free)
        self._matrices = np.asarray(matrices, np.float64)
        self._width = masks.shape[2]
        self._masks = np.stack([pack_bits(mask) for mask in masks])
        self._free = np.stack([pack_bits(mask) for mask in free])

    def counts(self, poses: Array) -> NDArray[np.int64]:
        """Return the disagreeing pixels of T_world_scan (N, 4, 4), shape (N, C, 2).

        They are mask pixels that the scan does not cover (E_SP, eq. 8) and boundary pixels outside `free` (E_BND, 9).
        """
        matrices = np.einsum("cij,njk->ncik", self._matrices, poses).reshape(-1, 3, 4).astype(np.float32)
        counts = np.empty((len(matrices), 2), np.int64)
        bounds = np.linspace(0, len(matrices), self._threads + 1).astype(int)

        def part(k: int) -> None:
            _count(
                self._vertices, self._plain, self._boundary, self._cull, matrices, bounds[k], self._masks, self._free,
                self._width, counts[bounds[k] : bounds[k + 1]],
            )  # fmt: skip

        list((self._pool.map if self._pool else map)(part, range(self._threads)))
        return counts.reshape(len(poses), -1, 2)

    def close(self) -> None:
        """End the threads."""
        if self._pool:
            self._pool.shutdown()

    def __enter__(self) -> RasterCounter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def checked_screens(matrices: Array, masks: Mask, free: Mask) -> None:
    """Check that matrices are (C, 3, 4) and masks and free (C, h, w) with C, h, w > 0.

    Raises:
        ValueError: they are not.
    """
    views = len(matrices)
    if np.shape(matrices) != (views, 3, 4) or np.ndim(masks) != 3 or len(masks) != views or 0 in np.shape(masks):
        raise ValueError(f"needs matrices (C, 3, 4) and masks (C, h, w), got {np.shape(matrices)}, {np.shape(masks)}")
    if np.shape(free) != np.shape(masks):
        raise ValueError(f"free has shape {np.shape(free)}, masks have {np.shape(masks)}")
