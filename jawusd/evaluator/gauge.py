"""The semantic gauge: jaw parameters (opening, laterotrusion, protrusion) to the displacement of the incisal point.

The parameters ``d = (d1, d2, d3)`` [mm] are what a clinician would read; the displacement ``u`` [mm] of the lower
incisal point from the closed bite is what a rigid body has. In the anatomical frame (x left, y up, z anterior)

    x = gx(d1) + d2
    y = -(d1 + drop(d2, d3) fade(d1))
    z = gz(d1) + rho(d2, d1) + d3

``gx, gz``: the person's habitual opening path; ``rho``: the gothic arch traced by a lateral excursion; ``drop``: the
tooth-glide surface the jaw must clear when it slides with the teeth together, fading out with opening.
``gauge(0) = 0`` by construction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from jawusd.geometry.arrays import Array

FADE_SOFTNESS_MM = 1.0  # rounding of the kink at d1 = 0 in the fading of the glide surface
LIMIT_SOFTNESS_MM = 4.0  # rounding of the kinks where the gothic arch stops changing with opening
ARCH_BOW_MM = 10.0  # the quadratic arch features are d2^2 / 10 mm, to keep all coefficients of one order
DROP_BEND = 0.15  # slope gained by the bent drop features per mm, saturating at 4 mm (below)
DROP_SATURATION_MM2 = 16.0
INVERSE_TOLERANCE_MM = 1e-13
INVERSE_ITERATIONS = 120
PATIENCE = 8  # steps after which Newton is taken to crawl: steps double until there is a bracket, then it is halved
INVERSE_STEP_MM = 20.0
LEAST_INVERSE_SLOPE = 0.2


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
    """

    path_coefficients: Array
    path_scale_mm: float
    path_limits: tuple[float, float]
    glide_arch: Array
    glide_drop: Array
    glide_softness_mm: float
    glide_fade_mm: float

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
        )

    def path(self, d1: Array) -> tuple[Array, Array, Array, Array]:
        """Return gx, gz [mm] and their slopes gx', gz' at the openings d1 [mm], each of the shape of d1."""
        inside = np.clip(d1, *self.path_limits)
        s = inside / self.path_scale_mm
        beyond = d1 - inside
        out = []
        for c in self.path_coefficients:
            value = ((((c[4] * s + c[3]) * s + c[2]) * s + c[1]) * s + c[0]) * s
            slope = ((((5 * c[4] * s + 4 * c[3]) * s + 3 * c[2]) * s + 2 * c[1]) * s + c[0]) / self.path_scale_mm
            out.append((value + slope * beyond, slope))
        (gx, gx_1), (gz, gz_1) = out
        return gx, gz, gx_1, gz_1

    def arch(self, d1: Array, d2: Array) -> tuple[Array, Array, Array]:
        """Return rho(d2, d1) [mm] and its derivatives by d1 and by d2."""
        inside, inside_1 = soft_clamp(d1, *self.path_limits, LIMIT_SOFTNESS_MM)
        t, t_1 = inside / self.path_scale_mm, inside_1 / self.path_scale_mm
        c = self.glide_arch
        side, side_2 = soft_absolute(d2, self.glide_softness_mm)
        by_side, by_side_t = (c[2] * t + c[1]) * t + c[0], 2 * c[2] * t + c[1]
        by_d2, by_bow = c[4] * t + c[3], (c[6] * t + c[5]) / ARCH_BOW_MM
        rho = side * by_side + d2 * (by_d2 + d2 * by_bow)
        rho_1 = (side * by_side_t + d2 * (c[4] + d2 * (c[6] / ARCH_BOW_MM))) * t_1
        rho_2 = side_2 * by_side + by_d2 + 2 * d2 * by_bow
        return rho, rho_1, rho_2

    def drop(self, d2: Array, d3: Array) -> tuple[Array, Array, Array]:
        """Return drop(d2, d3) [mm] and its derivatives by d2 and by d3."""
        c = self.glide_drop
        side, side_2 = soft_absolute(d2, self.glide_softness_mm)
        front, front_3 = soft_ramp(d3, self.glide_softness_mm)
        bent_side, bent_side_slope = _bent(side)
        bent_front, bent_front_slope = _bent(front)
        drop = c[0] * side + c[1] * front + c[2] * bent_side + c[3] * bent_front
        return drop, (c[0] + c[2] * bent_side_slope) * side_2, (c[1] + c[3] * bent_front_slope) * front_3

    def fade(self, d1: Array) -> tuple[Array, Array]:
        """Return the share of the glide surface felt at opening d1, and its derivative by d1."""
        ramp, ramp_1 = soft_ramp(d1, FADE_SOFTNESS_MM)
        x = ramp / self.glide_fade_mm
        fade = np.exp(-x * x)
        return fade, fade * (-2.0 / self.glide_fade_mm) * x * ramp_1

    def displacement(self, d: Array) -> Array:
        """Return the displacement u [mm] of the incisal point, anatomical frame, shape (n, 3), for d (n, 3)."""
        d1, d2, d3 = d.T
        gx, gz, _, _ = self.path(d1)
        drop = self.drop(d2, d3)[0] * self.fade(d1)[0]
        return np.stack([gx + d2, -(d1 + drop), gz + self.arch(d1, d2)[0] + d3], axis=-1)

    def displacement_jacobian(self, d: Array) -> tuple[Array, Array]:
        """Return u (n, 3) [mm] and du/dd, shape (n, 3, 3), for d (n, 3) [mm]."""
        d1, d2, d3 = d.T
        gx, gz, gx_1, gz_1 = self.path(d1)
        rho, rho_1, rho_2 = self.arch(d1, d2)
        drop, drop_2, drop_3 = self.drop(d2, d3)
        fade, fade_1 = self.fade(d1)
        jacobian = np.zeros((len(d), 3, 3))
        jacobian[:, 0, 0] = gx_1
        jacobian[:, 0, 1] = 1.0
        jacobian[:, 1, 0] = -(1.0 + drop * fade_1)
        jacobian[:, 1, 1] = -drop_2 * fade
        jacobian[:, 1, 2] = -drop_3 * fade
        jacobian[:, 2, 0] = gz_1 + rho_1
        jacobian[:, 2, 1] = rho_2
        jacobian[:, 2, 2] = 1.0
        return np.stack([gx + d2, -(d1 + drop * fade), gz + rho + d3], axis=-1), jacobian

    def inverse(self, u: Array) -> Array:
        """Return the d (n, 3) [mm] whose incisal displacement is u (n, 3) [mm].

        For a given d1 the other two follow in closed form, so this is a root search in one variable: Newton with the
        analytic slope, kept inside the tightest bracket seen so far. Rows that do not settle come back as NaN.
        """
        d1 = -u[:, 1]
        low, high = np.full(len(u), -np.inf), np.full(len(u), np.inf)
        d = np.full(u.shape, np.nan)
        active = np.flatnonzero(np.isfinite(u).all(axis=1))
        for iteration in range(INVERSE_ITERATIONS):
            x = d1[active]
            d2, d3, excess, slope = self._opening_equation(u[active], x)
            step = _newton_step(excess, slope)
            done = np.abs(step) <= INVERSE_TOLERANCE_MM * (1.0 + np.abs(x))
            d[active[done]] = np.stack([x, d2, d3], axis=-1)[done]
            low[active] = np.where(excess < 0, x, low[active])
            high[active] = np.where(excess > 0, x, high[active])
            d1[active] = _next_opening(x, step, low[active], high[active], iteration)
            active = active[~done]
            if not active.size:
                break
        return d

    def _opening_equation(self, u: Array, d1: Array) -> tuple[Array, Array, Array, Array]:
        """Return d2, d3 that fit u's x and z at opening d1, the excess d1 + drop fade + y [mm], and its slope."""
        gx, gz, gx_1, gz_1 = self.path(d1)
        d2 = u[:, 0] - gx
        rho, rho_1, rho_2 = self.arch(d1, d2)
        d3 = u[:, 2] - gz - rho
        drop, drop_2, drop_3 = self.drop(d2, d3)
        fade, fade_1 = self.fade(d1)
        d3_1 = -gz_1 - rho_1 + rho_2 * gx_1
        return d2, d3, d1 + drop * fade + u[:, 1], 1.0 + drop * fade_1 + (drop_3 * d3_1 - drop_2 * gx_1) * fade


def soft_absolute(x: Array, softness_mm: float) -> tuple[Array, Array]:
    """Return ``sqrt(x^2 + e^2) - e`` and its slope: |x| with the kink rounded over e = softness_mm."""
    root = np.sqrt(x * x + softness_mm * softness_mm)
    return root - softness_mm, x / root


def soft_ramp(x: Array, softness_mm: float) -> tuple[Array, Array]:
    """Return ``(x + sqrt(x^2 + e^2) - e) / 2`` and its slope: max(x, 0) with the kink rounded, zero at zero."""
    root = np.sqrt(x * x + softness_mm * softness_mm)
    return 0.5 * (x + root - softness_mm), 0.5 * (1.0 + x / root)


def soft_clamp(x: Array, low: float, high: float, softness_mm: float) -> tuple[Array, Array]:
    """Return x clamped to [low, high] with both kinks rounded, and its slope; smooth everywhere.

    A hard clamp would put a kink into the decoder, which tables, solvers and eyes all notice.
    """
    rise, rise_1 = soft_ramp(x - low, softness_mm)
    stop, stop_1 = soft_ramp(x - high, softness_mm)
    return low + rise - stop, rise_1 - stop_1


def _bent(x: Array) -> tuple[Array, Array]:
    """Return ``0.15 x^2 / sqrt(1 + x^2 / 16)`` [mm] and its slope: a drop that steepens and then runs straight."""
    square = x * x
    w = 1.0 + square / DROP_SATURATION_MM2
    root = np.sqrt(w)
    return DROP_BEND * square / root, DROP_BEND * x * (1.0 + w) / (w * root)


def _newton_step(excess: Array, slope: Array) -> Array:
    # the excess rises with d1 wherever the gauge is a gauge; a slope near or below zero can only mislead
    return np.clip(-excess / np.where(slope > LEAST_INVERSE_SLOPE, slope, 1.0), -INVERSE_STEP_MM, INVERSE_STEP_MM)


def _next_opening(x: Array, step: Array, low: Array, high: Array, iteration: int) -> Array:
    """Return the next d1 to try: a Newton step, or the middle of the bracket where that leads out of it or crawls."""
    bounded = np.isfinite(low) & np.isfinite(high)
    late = max(iteration - PATIENCE, 0)
    stride = np.clip(step * 2.0 ** min(late, 64), -INVERSE_STEP_MM, INVERSE_STEP_MM)
    newton = x + np.where(bounded, step, stride)
    halve = bounded & ((newton <= low) | (newton >= high) | (late % 2 == 1))
    middle = 0.5 * (np.where(bounded, low, 0.0) + np.where(bounded, high, 0.0))
    return np.where(halve, middle, newton)
