"""The poses that a synthetic person can take: projection onto the person's manifold.

A pose is possible if it lies on the person's three-parameter manifold with controls inside their ranges. The nearest
possible pose is found by bounded Gauss-Newton steps from the best node of a coarse grid, on distances of mandible
points.
"""

import numpy as np

from jawusd.geometry import transform_points
from jawusd.synthetic.person import Person

_LOWER, _UPPER = np.array([0.0, -1.0, -1.0]), np.array([1.0, 1.0, 1.0])
_GRID = (13, 9, 9)
_STEPS = 30  # so many are needed near zero protrusion, where the manifold has a kink
_DIFFERENCE = 1e-5
_DAMPING = 1e-3  # relative to the scale of each control, since the controls' gradients differ by a factor of ten
_CHUNK = 2000


_COMPETING = 1.3  # exponent of the competing envelope


class CompetingPerson(Person):
    """A person in whom a wide lateral movement reduces the protrusive range: |lateral|^1.3 + protrusion^1.3 <= 1."""

    def limit(self, controls):
        """Return controls (..., 3) clipped to the envelope; lateral and protrusion are scaled down jointly."""
        opening, lateral, protrusion = np.moveaxis(super().limit(controls), -1, 0)
        size = (np.abs(lateral) ** _COMPETING + np.maximum(protrusion, 0.0) ** _COMPETING) ** (1.0 / _COMPETING)
        shrink = 1.0 / np.maximum(size, 1.0)
        return np.stack([opening, lateral * shrink, np.where(protrusion > 0, protrusion * shrink, protrusion)], -1)


#: Persons by the kind of their envelope; in a box, the ranges do not depend on each other.
PERSONS = {"box": Person, "competing": CompetingPerson}


class PossiblePoses:
    """The poses of one person."""

    def __init__(self, person):
        self._person = person
        self._points = person.mandible_points
        axes = [np.linspace(low, high, n) for low, high, n in zip(_LOWER, _UPPER, _GRID, strict=True)]
        self._grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        self._few = self._points[np.linspace(0, len(self._points) - 1, 6).astype(int)]
        self._grid_points = self._moved(self._grid, self._few)

    def nearest(self, T, bounded=True):
        """Return controls (..., 3) of the nearest pose on the manifold, and the largest point distance [mm] (...).

        Unbounded, the distance is a lower limit on the error of any three-parameter fit.
        """
        T = np.asarray(T, dtype=np.float64)
        flat = T.reshape(-1, 4, 4)
        parts = [self._nearest(flat[i : i + _CHUNK], bounded) for i in range(0, len(flat), _CHUNK)]
        if not parts:
            return np.zeros((*T.shape[:-2], 3)), np.zeros(T.shape[:-2])
        controls, distance = (np.concatenate(part) for part in zip(*parts, strict=True))
        return controls.reshape(*T.shape[:-2], 3), distance.reshape(T.shape[:-2])

    def include(self, T, tolerance_mm=1.0):
        """Return for which poses (..., 4, 4) all mandible points are within the tolerance of a possible pose.

        Movements outside the three controls alone displace points by up to 0.7 mm.
        """
        return self.nearest(T)[1] <= tolerance_mm

    def _moved(self, controls, points):
        """Return points (P, 3) transformed by the poses at controls (N, 3), shape (N, 3 P)."""
        return transform_points(self._person.pose(*controls.T), points).reshape(len(controls), -1)

    def _start(self, T):
        """Return the controls of the grid nodes nearest to poses (N, 4, 4), shape (N, 3)."""
        target = transform_points(T, self._few).reshape(len(T), -1)
        squares = (self._grid_points**2).sum(1) - 2 * target @ self._grid_points.T
        return self._grid[squares.argmin(1)]

    def _nearest(self, T, bounded):
        target = transform_points(T, self._points).reshape(len(T), -1)
        controls = self._start(T)
        if bounded:
            controls = self._person.limit(controls)
        damping = np.full(len(T), _DAMPING)
        error = target - self._moved(controls, self._points)
        cost = (error**2).sum(1)
        for _ in range(_STEPS):
            trial = controls + self._step(controls, error, damping, bounded)
            if bounded:
                trial = self._person.limit(trial)
            trial_error = target - self._moved(trial, self._points)
            trial_cost = (trial_error**2).sum(1)
            better = trial_cost < cost
            controls = np.where(better[:, None], trial, controls)
            error = np.where(better[:, None], trial_error, error)
            cost = np.where(better, trial_cost, cost)
            damping = np.where(better, damping * 0.2, damping * 10.0)
        return controls, np.linalg.norm(error.reshape(len(T), -1, 3), axis=-1).max(-1)

    def _step(self, controls, error, damping, bounded):
        """Return a damped Gauss-Newton step; controls at a bound with an outward gradient are fixed."""
        now = self._moved(controls, self._points)
        jacobian = np.stack(
            [(self._moved(controls + _DIFFERENCE * e, self._points) - now) / _DIFFERENCE for e in np.eye(3)], -1
        )
        gradient = np.einsum("nij,ni->nj", jacobian, error)
        normal = np.einsum("nij,nik->njk", jacobian, jacobian)
        diagonal = np.einsum("njj->nj", normal)
        free = np.ones_like(controls, dtype=bool)
        if bounded:
            free = ~(((controls <= _LOWER) & (gradient < 0)) | ((controls >= _UPPER) & (gradient > 0)))
        normal = normal * free[:, :, None] * free[:, None, :]
        index = np.arange(3)
        normal[:, index, index] = np.where(free, diagonal * (1.0 + damping[:, None]) + 1e-9, 1.0)
        return np.linalg.solve(normal, (gradient * free)[..., None])[..., 0]
