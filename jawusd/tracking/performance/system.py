"""Normal equations of a take: a block band of frames coupled by smoothness, bordered by the take's unknowns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array

_BEND = (1.0, -2.0, 1.0)
_STEP = (-1.0, 1.0)


class TakeCovariance(NamedTuple):
    """Covariance of the solution."""

    own: Array  # covariance of each frame's unknowns, conditional on the take's unknowns, shape (N, L, L)
    response: Array  # derivative of each frame's unknowns with respect to the take's unknowns, shape (N, L, G)
    shared: Array  # covariance of the unknowns of the take, shape (G, G)


class _Eliminated(NamedTuple):
    sides: Array  # solution for all right-hand sides, shape (N, L, S)
    inverse_pivots: Array  # inverses of the eliminated diagonal blocks, one per pair of frames, shape (M, 2 L, 2 L)
    coupling: Array  # blocks that couple each pair with the next one, shape (M - 1, 2 L, 2 L)


class TakeSystem:
    """Accumulated normal equations of N frames with L unknowns each and G unknowns of the take.

    Each frame is coupled only with the next two, so time and memory are linear in N.
    """

    def __init__(self, frames: int, local: int, shared: int) -> None:
        self.frames, self.local, self.shared = frames, local, shared
        # Entry k: blocks that couple each frame with the k-th frame after it.
        self._blocks = [np.zeros((max(frames - k, 0), local, local)) for k in range(3)]
        self._right = np.zeros((frames, local))
        self._cross = np.zeros((frames, local, shared))
        self._corner, self._corner_right = np.zeros((shared, shared)), np.zeros(shared)

    def add_frame(self, k: int, precision: Array, right: Array) -> None:
        """Add the normal matrix (L + G, L + G) and right-hand side (L + G,) of a frame and the take."""
        n = self.local
        self._blocks[0][k] += precision[:n, :n]
        self._cross[k] += precision[:n, n:]
        self._corner += precision[n:, n:]
        self._right[k] += right[:n]
        self._corner_right += right[n:]

    def add_shared(self, precision: Array, right: Array) -> None:
        """Add a prior on the take's unknowns: diagonal precision (G,) and right-hand side (G,)."""
        self._corner += np.diag(precision)
        self._corner_right += right

    def add_bends(self, columns: slice[int, int, None], bend: Array, weight: Array) -> None:
        """Penalise current second differences at frames 1 to N - 2, shape (N - 2, w), of a slice of a frame's unknowns.

        `weight` is the precision of the second differences, shape (w,) or (N - 2, w).
        """
        self._add(_BEND, columns, bend, weight)

    def add_steps(self, columns: slice[int, int, None], step: Array, weight: Array) -> None:
        """Penalise first differences `step`, shape (N - 1, w); other arguments are as for `add_bends`."""
        self._add(_STEP, columns, step, weight)

    def _add(self, pattern: tuple[float, ...], columns: slice[int, int, None], value: Array, weight: Array) -> None:
        count = len(value)
        weight = np.broadcast_to(weight, value.shape)
        diagonal = np.arange(self.local)[columns]
        for a, first in enumerate(pattern):
            self._right[a : a + count, columns] -= first * weight * value
            for b, second in enumerate(pattern[a:]):
                self._blocks[b][a : a + count, diagonal, diagonal] += first * second * weight

    def solve(self) -> tuple[Array, Array]:
        """Solve for the steps of all frames, shape (N, L), and of the take, shape (G,)."""
        found = self._eliminated(np.concatenate([self._right[..., None], self._cross], axis=-1)).sides
        alone, response = found[..., 0], found[..., 1:]
        corner = self._corner - np.einsum("nlg,nlh->gh", self._cross, response)
        shared = np.linalg.solve(corner, self._corner_right - np.einsum("nlg,nl->g", self._cross, alone))
        return alone - response @ shared, np.asarray(shared, np.float64)

    def covariance(self) -> TakeCovariance:
        """Return the blocks of the inverse that are required for the covariances.

        The diagonal blocks of a block tridiagonal inverse follow from a second backward sweep (Takahashi et al. 1973).
        """
        found = self._eliminated(self._cross)
        shared = np.linalg.inv(self._corner - np.einsum("nlg,nlh->gh", self._cross, found.sides))
        out = found.inverse_pivots
        for k in range(len(out) - 2, -1, -1):
            gain = out[k] @ found.coupling[k]
            out[k] += gain @ out[k + 1] @ gain.T
        width = self.local
        halves = np.stack([out[:, :width, :width], out[:, width:, width:]], axis=1)
        own = halves.reshape(-1, width, width)[: self.frames]
        return TakeCovariance(own, -found.sides, np.asarray(shared, np.float64))

    def _eliminated(self, sides: Array) -> _Eliminated:
        """Solve the band system for right-hand sides of shape (N, L, S).

        Pairs of frames are eliminated block by block: LAPACK's band solvers can be a thousand times slower if their
        threads compete.
        """
        diagonal, coupling = self._pairs()
        blocks, count = len(diagonal), sides.shape[-1]
        found = np.zeros((2 * blocks, self.local, count))
        found[: self.frames] = sides
        found = found.reshape(blocks, 2 * self.local, count)
        inverse = np.empty_like(diagonal)
        for k in range(blocks):
            if k:
                gain = coupling[k - 1].T @ inverse[k - 1]
                diagonal[k] -= gain @ coupling[k - 1]
                found[k] -= gain @ found[k - 1]
            inverse[k] = np.linalg.inv(diagonal[k])
        for k in range(blocks - 1, -1, -1):
            if k < blocks - 1:
                found[k] -= coupling[k] @ found[k + 1]
            found[k] = inverse[k] @ found[k]
        return _Eliminated(found.reshape(2 * blocks, self.local, count)[: self.frames], inverse, coupling)

    def _pairs(self) -> tuple[Array, Array]:
        """Return the diagonal blocks of pairs of frames, shape (M, 2 L, 2 L), and the blocks that couple neighbours."""
        width, count = self.local, (self.frames + 1) // 2
        diagonal = np.tile(np.eye(2 * width), (count, 1, 1))
        coupling = np.zeros((count, 2 * width, 2 * width))
        own, one, two = self._blocks
        for half in (0, 1):
            part = slice(half * width, half * width + width)
            blocks = own[half::2]
            diagonal[: len(blocks), part, part] = blocks
            blocks = two[half::2]
            coupling[: len(blocks), part, part] = blocks
        within, across = one[0::2], one[1::2]
        diagonal[: len(within), :width, width:] = within
        diagonal[: len(within), width:, :width] = np.swapaxes(within, 1, 2)
        coupling[: len(across), width:, :width] = across
        return diagonal, coupling[:-1]
