"""Write lenses of other programs with OpenCV's coefficients."""

from __future__ import annotations

import numpy as np

from jawusd.geometry.arrays import Array

_SAMPLES = 400
_BEYOND = 1.1  # the undistorted picture may reach farther than the recorded one


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
