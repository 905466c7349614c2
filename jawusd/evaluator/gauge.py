"""The gauge over batches: jaw parameters to the displacement of the incisal point and back.

The formulas are those of `jawusd.evaluator.formula`. ``u(0) = 0`` by construction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator import derivatives
from jawusd.evaluator.derivatives import (
    ARRAYS,
    INVERSE_ITERATIONS,
    INVERSE_STEP_MM,
    INVERSE_TOLERANCE_MM,
    LEAST_INVERSE_SLOPE,
    MOST_DOUBLINGS,
    PATIENCE,
)
from jawusd.evaluator.formula import GaugeNumbers
from jawusd.evaluator.glide import GlideTable


@dataclass(frozen=True)
class Gauge:
    """Map d to the incisal displacement u and back.

    Attributes:
        path_coefficients: Of gx and gz: ``sum_k c_k (d1 / path_scale_mm)^k, k = 1..5`` [mm], shape (2, 5).
        path_scale_mm: Length that makes the polynomials' argument of order one.
        path_limits: d1 interval [mm] in which the polynomials hold; outside they go on as straight lines (C1),
            and ``rho`` sees d1 softly clamped to it.
        glide_arch: Coefficients of rho, shape (7,).
        glide_drop: Coefficients of drop, shape (4,).
        glide_softness_mm: Radius ``e`` of the softened absolute value and ramp.
        glide_fade_mm: Opening over which the glide surface fades out.
        glide: Table added to drop; None without one.
        numbers: All of these as floats.
    """

    path_coefficients: Array
    path_scale_mm: float
    path_limits: tuple[float, float]
    glide_arch: Array
    glide_drop: Array
    glide_softness_mm: float
    glide_fade_mm: float
    glide: GlideTable | None = None
    numbers: GaugeNumbers = field(init=False, repr=False)

    def __post_init__(self) -> None:
        path_x, path_z = self.path_coefficients.tolist()
        numbers = GaugeNumbers(
            tuple(path_x),
            tuple(path_z),
            self.path_scale_mm,
            *self.path_limits,
            tuple(self.glide_arch.tolist()),
            tuple(self.glide_drop.tolist()),
            self.glide_softness_mm,
            self.glide_fade_mm,
            self.glide,
        )
        object.__setattr__(self, "numbers", numbers)

    def arrays(self) -> dict[str, Array]:
        """Return the gauge's arrays by their names in a rig."""
        names = ("path_coefficients", "path_scale_mm", "path_limits", "glide_arch", "glide_drop")
        own = {name: np.array(getattr(self, name)) for name in (*names, "glide_softness_mm", "glide_fade_mm")}
        return own if self.glide is None else {**own, **self.glide.arrays()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> Gauge:
        """Pick the gauge out of the named arrays of a model."""
        low, high = np.asarray(arrays["path_limits"], dtype=float)
        return cls(
            path_coefficients=np.asarray(arrays["path_coefficients"], dtype=float),
            path_scale_mm=float(arrays["path_scale_mm"]),
            path_limits=(float(low), float(high)),
            glide_arch=np.asarray(arrays["glide_arch"], dtype=float),
            glide_drop=np.asarray(arrays["glide_drop"], dtype=float),
            glide_softness_mm=float(arrays["glide_softness_mm"]),
            glide_fade_mm=float(arrays["glide_fade_mm"]),
            glide=GlideTable.from_arrays(arrays),
        )

    def path(self, d1: Array) -> tuple[Array, Array, Array, Array]:
        """Return gx, gz [mm] and their slopes at the openings d1 [mm], each of the shape of d1."""
        return derivatives.path(self.numbers, d1, ARRAYS)

    def arch(self, d1: Array, d2: Array) -> tuple[Array, Array, Array]:
        """Return rho(d2, d1) [mm] and its derivatives by d1 and by d2."""
        return derivatives.arch(self.numbers, d1, d2, ARRAYS)

    def drop(self, d2: Array, d3: Array) -> tuple[Array, Array, Array]:
        """Return drop(d2, d3) [mm] and its derivatives by d2 and by d3."""
        return derivatives.drop(self.numbers, d2, d3, ARRAYS)

    def displacement(self, d: Array) -> Array:
        """Return the displacement u [mm] of the incisal point, anatomical frame, shape (n, 3), for d (n, 3)."""
        d1, d2, d3 = d.T
        return np.stack(derivatives.displacement(self.numbers, d1, d2, d3, ARRAYS)[0], axis=-1)

    def displacement_jacobian(self, d: Array) -> tuple[Array, Array]:
        """Return u (n, 3) [mm] and du/dd, shape (n, 3, 3), for d (n, 3) [mm]."""
        d1, d2, d3 = d.T
        u, (x_1, y_1, y_2, y_3, z_1, z_2) = derivatives.displacement(self.numbers, d1, d2, d3, ARRAYS)
        jacobian = np.zeros((len(d), 3, 3))
        jacobian[:, 0, 0], jacobian[:, 0, 1] = x_1, 1.0
        jacobian[:, 1, 0], jacobian[:, 1, 1], jacobian[:, 1, 2] = y_1, y_2, y_3
        jacobian[:, 2, 0], jacobian[:, 2, 1], jacobian[:, 2, 2] = z_1, z_2, 1.0
        return np.stack(u, axis=-1), jacobian

    def inverse(self, u: Array) -> Array:
        """Return the d (n, 3) [mm] whose incisal displacement is u (n, 3) [mm].

        For a given d1 the other two follow in closed form, so this is a root search in one variable: Newton with the
        analytic slope, kept inside the tightest bracket seen so far. Rows that do not converge come back as NaN. One
        row goes through `derivatives.inverse`, the same search in floats.
        """
        finite = np.isfinite(u).all(axis=1)
        if len(u) == 1 and finite.all():
            x, y, z = u[0].tolist()
            return np.array([derivatives.inverse(self.numbers, (x, y, z), derivatives.FLOATS)])
        d1 = -u[:, 1]
        low, high = np.full(len(u), -np.inf), np.full(len(u), np.inf)
        d = np.full(u.shape, np.nan)
        active = np.flatnonzero(finite)
        for iteration in range(INVERSE_ITERATIONS):
            x = d1[active]
            d2, d3, remainder, slope = derivatives.opening_equation(self.numbers, tuple(u[active].T), x, ARRAYS)
            step = -remainder / np.where(slope > LEAST_INVERSE_SLOPE, slope, 1.0)
            step = np.clip(step, -INVERSE_STEP_MM, INVERSE_STEP_MM)
            done = np.abs(step) <= INVERSE_TOLERANCE_MM * (1.0 + np.abs(x))
            d[active[done]] = np.stack([x, d2, d3], axis=-1)[done]
            low[active] = np.where(remainder < 0, x, low[active])
            high[active] = np.where(remainder > 0, x, high[active])
            d1[active] = _next_opening(x, step, low[active], high[active], iteration)
            active = active[~done]
            if not active.size:
                break
        return d


def _next_opening(x: Array, step: Array, low: Array, high: Array, iteration: int) -> Array:
    """Return the next d1 to try: a Newton step, or the middle of the bracket if that leaves it or stalls."""
    bounded = np.isfinite(low) & np.isfinite(high)
    late = max(iteration - PATIENCE, 0)
    stride = np.clip(step * 2.0 ** min(late, MOST_DOUBLINGS), -INVERSE_STEP_MM, INVERSE_STEP_MM)
    newton = x + np.where(bounded, step, stride)
    halve = bounded & ((newton <= low) | (newton >= high) | (late % 2 == 1))
    middle = 0.5 * (np.where(bounded, low, 0.0) + np.where(bounded, high, 0.0))
    return np.where(halve, middle, newton)
