"""Write lenses of other programs with OpenCV's coefficients."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from jawusd.base.arrays import Array
from jawusd.geometry.so3 import so3_exp

_SAMPLES = 400
_BEYOND = 1.1  # the undistorted picture may reach farther than the recorded one
_CLOSE_PX = 0.005  # a fit that is this close needs no other K
_ROUNDS, _MOST_DAMPING = 200, 1e12


def opencv_radial(K: Array, size_px: tuple[int, int], radial: Array) -> tuple[Array, float]:
    """Return OpenCV's radial coefficients k1, k2, k3[, k4, k5, k6] of 1 + a1 r^2 + a2 r^4 + a3 r^6 + a4 r^8.

    With a fourth term a ratio of two polynomials is fitted to it over the picture.

    Args:
        K: intrinsic matrix (3, 3) [px].
        size_px: width and height.
        radial: a1 to a4, shape (4,).

    Returns:
        The coefficients, shape (3,) or (6,), and how far they are off at most [px].
    """
    if radial[3] == 0:
        return radial[:3].copy(), 0.0
    corners = np.array([[x, y] for x in (0, size_px[0]) for y in (0, size_px[1])], np.float64)
    reach = np.abs((corners - K[:2, 2]) / np.diag(K)[:2]).max(0)
    r2 = np.linspace(0, (_BEYOND * float(np.linalg.norm(reach))) ** 2, _SAMPLES)[1:]
    g = 1 + sum(a * r2 ** (k + 1) for k, a in enumerate(radial))
    powers = np.stack([r2, r2**2, r2**3], axis=1)
    # n = g d is linear in the coefficients of both; weighed by r, as pixels are.
    weight = np.sqrt(r2)[:, None]
    found = np.linalg.lstsq(weight * np.hstack([powers, -g[:, None] * powers]), weight[:, 0] * (g - 1), rcond=None)[0]
    n, d = 1 + powers @ found[:3], 1 + powers @ found[3:]
    off = np.abs(n / d - g) * np.sqrt(r2) * float(np.diag(K)[:2].max())
    return np.asarray(found, np.float64), float(off.max() if (d > 0).all() else np.inf)


def opencv_lens(K: Array, recorded_px: Array, ideal: Array) -> tuple[Array, Array, Array, float]:
    """Return K and OpenCV's eight coefficients of a lens that is known by points in the picture and without distortion.

    K is kept where the coefficients alone follow the lens closely; else it takes what is linear in the lens, as the
    bending of a cylinder or a squeeze, and at last the camera turns: with the principal point, that moves the middle of
    the distortion.

    Args:
        K: intrinsic matrix (3, 3) [px] to begin with.
        recorded_px: points of the picture (N, 2) [px].
        ideal: the same on the plane at depth 1 of a pinhole, x right, y down, shape (N, 2).

    Returns:
        K (3, 3), the coefficients (8,), the rotation vector (3,) [rad] by which the ideal points turn before, and how
        far pixels are off at most; infinite where the fit does not hold.
    """
    best, off = np.concatenate([K[[0, 1, 0, 0, 1], [0, 1, 1, 2, 2]], np.zeros(11)]), np.inf
    for free in (np.arange(5, 13), np.arange(13), np.arange(16)):
        best = _least_squares(best, free, recorded_px, ideal)
        off = float(np.abs(_through(best, ideal) - recorded_px).max())
        if off <= _CLOSE_PX:
            break
    fx, fy, skew, cx, cy = best[:5]
    fitted = np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return fitted, best[5:13], best[13:], off if np.isfinite(off) else np.inf


def _least_squares(values: Array, free: npt.NDArray[np.intp], recorded_px: Array, ideal: Array) -> Array:
    """Return the values with those of the free indices fitted: Levenberg-Marquardt with slopes by differences."""
    values, damping = values.copy(), 1e-3
    steps = np.where(np.arange(16) < 5, 1e-4 * values[0], 1e-6)
    residual = (_through(values, ideal) - recorded_px).ravel()
    for _ in range(_ROUNDS):
        slopes = np.empty((residual.size, free.size))
        for column, k in enumerate(free):
            nudged = values.copy()
            nudged[k] += steps[k]
            slopes[:, column] = ((_through(nudged, ideal) - recorded_px).ravel() - residual) / steps[k]
        normal, gradient = slopes.T @ slopes, slopes.T @ residual
        moved = values.copy()
        moved[free] -= np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), gradient)
        after = (_through(moved, ideal) - recorded_px).ravel()
        if not np.isfinite(after).all() or after @ after > residual @ residual:
            damping *= 10
            if damping > _MOST_DAMPING:
                break
            continue
        gained = residual @ residual - after @ after
        values, residual, damping = moved, after, max(damping / 10, 1e-12)
        if gained < 1e-9 * (residual @ residual) + 1e-14:
            break
    return values


def _through(values: Array, ideal: Array) -> Array:
    """Return the pixels (N, 2) of ideal points through K and OpenCV's lens, as `Camera` states them."""
    fx, fy, skew, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6 = values[:13]
    turned = so3_exp(values[13:]) @ np.vstack([ideal.T, np.ones(len(ideal))])
    x, y = turned[:2] / turned[2]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    dx = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    dy = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.column_stack([fx * dx + skew * dy + cx, fy * dy + cy])
