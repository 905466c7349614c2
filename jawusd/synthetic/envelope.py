"""The set of possible poses of a synthetic person, and the distance of any pose to it.

A pose is possible when it lies on the person's three-parameter manifold with controls inside their ranges. The nearest
one is found by bounded Gauss-Newton steps from the best node of a coarse grid, on distances of mandible points.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jawusd.base.arrays import Array
from jawusd.geometry import transform_points

PoseFunction = Callable[[Array, Array, Array], Array]

_LOWER = np.array([0.0, -1.0, -1.0])
_UPPER = np.array([1.0, 1.0, 1.0])
_GRID = (13, 9, 9)
# Poses near zero protrusion, where the manifold has a kink in its controls, need the most steps.
_STEPS = 30
_DIFFERENCE = 1e-5
# At these poses the gradients of the controls differ by a factor of ten; the damping is relative to each.
_DAMPING = 1e-3
_CHUNK = 2000


class Envelope:
    """Possible controls of one person and the nearest possible pose."""

    def __init__(self, pose: PoseFunction, points: Array, exponent: float | None) -> None:
        """Prepare the grid of start values.

        Args:
            pose: opening, lateral, protrusion (...) to T_skull_mandible (..., 4, 4).
            points: mandible points [mm], shape (P, 3).
            exponent: None for independent ranges, p for |lateral|^p + max(protrusion, 0)^p <= 1.
        """
        self._pose = pose
        self._points = points
        self._exponent = exponent
        axes = [np.linspace(low, high, n) for low, high, n in zip(_LOWER, _UPPER, _GRID, strict=True)]
        self._grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        self._few = points[np.linspace(0, len(points) - 1, 6).astype(int)]
        self._grid_points = self._moved(self._grid, self._few)

    def limit(self, controls: Array) -> Array:
        """Return controls (..., 3) inside the ranges: clipped, then lateral and protrusion scaled down together."""
        controls = np.clip(controls, _LOWER, _UPPER)
        if self._exponent is None:
            return controls
        p = self._exponent
        size = (np.abs(controls[..., 1]) ** p + np.maximum(controls[..., 2], 0.0) ** p) ** (1.0 / p)
        shrink = 1.0 / np.maximum(size, 1.0)
        lateral, protrusion = controls[..., 1] * shrink, controls[..., 2]
        protrusion = np.where(protrusion > 0, protrusion * shrink, protrusion)
        return np.stack([controls[..., 0], lateral, protrusion], -1)

    def nearest(self, T: Array, bounded: bool) -> tuple[Array, Array]:
        """Return controls (..., 3) and largest point distance [mm] (...) of the nearest pose of the manifold."""
        flat = T.reshape(-1, 4, 4)
        parts = [self._nearest(flat[i : i + _CHUNK], bounded) for i in range(0, len(flat), _CHUNK)]
        if not parts:
            return np.zeros((*T.shape[:-2], 3)), np.zeros(T.shape[:-2])
        controls, distance = (np.concatenate(part) for part in zip(*parts, strict=True))
        return controls.reshape(*T.shape[:-2], 3), distance.reshape(T.shape[:-2])

    def _moved(self, controls: Array, points: Array) -> Array:
        """Points (P, 3) under the poses of controls (N, 3), as (N, 3 P)."""
        T = self._pose(controls[:, 0], controls[:, 1], controls[:, 2])
        return transform_points(T, points).reshape(len(controls), -1)

    def _start(self, T: Array) -> Array:
        """Grid controls nearest to poses (N, 4, 4), as (N, 3)."""
        target = transform_points(T, self._few).reshape(len(T), -1)
        squares = (self._grid_points**2).sum(1) - 2 * target @ self._grid_points.T
        return self._grid[squares.argmin(1)]

    def _nearest(self, T: Array, bounded: bool) -> tuple[Array, Array]:
        target = transform_points(T, self._points).reshape(len(T), -1)
        controls = self._start(T)
        if bounded:
            controls = self.limit(controls)
        damping = np.full(len(T), _DAMPING)
        error = target - self._moved(controls, self._points)
        cost = (error**2).sum(1)
        for _ in range(_STEPS):
            step = self._step(controls, error, damping, bounded)
            trial = controls + step
            if bounded:
                trial = self.limit(trial)
            trial_error = target - self._moved(trial, self._points)
            trial_cost = (trial_error**2).sum(1)
            better = trial_cost < cost
            controls = np.where(better[:, None], trial, controls)
            error = np.where(better[:, None], trial_error, error)
            cost = np.where(better, trial_cost, cost)
            damping = np.where(better, damping * 0.2, damping * 10.0)
        distance = np.linalg.norm(error.reshape(len(T), -1, 3), axis=-1).max(-1)
        return controls, distance

    def _step(self, controls: Array, error: Array, damping: Array, bounded: bool) -> Array:
        """One damped Gauss-Newton step; controls at a bound whose gradient points outwards are fixed."""
        now = self._moved(controls, self._points)
        jacobian = np.stack(
            [(self._moved(controls + _DIFFERENCE * e, self._points) - now) / _DIFFERENCE for e in np.eye(3)], -1
        )
        gradient = np.einsum("nij,ni->nj", jacobian, error)
        normal = np.einsum("nij,nik->njk", jacobian, jacobian)
        diagonal = np.einsum("njj->nj", normal)
        free = np.ones_like(controls, dtype=bool)
        if bounded:
            held = ((controls <= _LOWER) & (gradient < 0)) | ((controls >= _UPPER) & (gradient > 0))
            free = ~held
        normal = normal * free[:, :, None] * free[:, None, :]
        index = np.arange(3)
        normal[:, index, index] = np.where(free, diagonal * (1.0 + damping[:, None]) + 1e-9, 1.0)
        return np.linalg.solve(normal, (gradient * free)[..., None])[..., 0]
