"""Pinhole cameras with OpenCV's radial-tangential distortion, and the conversion of other lens models to it.

Model: OpenCV "Camera Calibration and 3D Reconstruction": coefficients (k1, k2, p1, p2[, k3[, k4, k5, k6]]).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.geometry.se3 import se3_inverse, transform_points
from jawusd.geometry.so3 import so3_exp

_ALLOWED_COEFFICIENTS = (0, 4, 5, 8)


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera: pose, intrinsics and distortion."""

    name: str  # name of the camera in the capture
    size_px: tuple[int, int]  # image width and height [px]
    K: Array  # intrinsic matrix [px], shape (3, 3)
    distortion: Array  # OpenCV coefficients, shape (0,), (4,), (5,) or (8,)
    T_cam_world: Array  # world to camera (x right, y down, z forward) [mm], shape (4, 4)

    def __post_init__(self) -> None:
        for field, shape in (("K", (3, 3)), ("T_cam_world", (4, 4))):
            value = np.array(getattr(self, field), dtype=np.float64)
            if value.shape != shape:
                raise ValueError(f"camera {self.name}: {field} must have shape {shape}, got {value.shape}")
            object.__setattr__(self, field, value)
        distortion = np.array(self.distortion, dtype=np.float64).ravel()
        if distortion.size not in _ALLOWED_COEFFICIENTS:
            raise ValueError(
                f"camera {self.name} has {distortion.size} distortion coefficients; "
                f"expected one of {_ALLOWED_COEFFICIENTS}"
            )
        object.__setattr__(self, "distortion", distortion)

    def projection_matrix(self) -> Array:
        """Return the pinhole projection (world mm -> homogeneous px), shape (3, 4)."""
        return self.K @ self.T_cam_world[:3]

    def centre_world(self) -> Array:
        """Return the centre of projection in world coordinates [mm], shape (3,)."""
        return se3_inverse(self.T_cam_world)[:3, 3]

    def project_pinhole(self, points_world: ArrayLike) -> Array:
        """Project world points (..., 3) [mm] without lens distortion, shape (..., 2) [px]."""
        p = np.asarray(points_world, dtype=np.float64) @ self.T_cam_world[:3, :3].T + self.T_cam_world[:3, 3]
        h = p @ self.K.T
        return h[..., :2] / h[..., 2:]

    def project(self, points_world: ArrayLike) -> Array:
        """Project world points (..., 3) [mm] through the lens, distortion included, shape (..., 2) [px]."""
        return self.distort_pixels(self.project_pinhole(points_world))

    def distort_pixels(self, pinhole_px: ArrayLike) -> Array:
        """Map ideal pinhole pixels (..., 2) to pixels of the recorded image."""
        x = self._normalised(np.asarray(pinhole_px, dtype=np.float64))
        return self._pixels(self._distort(x))

    def undistort_pixels(self, pixels: ArrayLike) -> Array:
        """Map pixels (..., 2) of the recorded image to ideal pinhole pixels (Newton, to 1e-10 px for real lenses)."""
        target = self._normalised(np.asarray(pixels, dtype=np.float64))
        x = target.copy()
        h = 1e-6
        for _ in range(12):
            f = self._distort(x) - target
            # a numeric Jacobian works for all coefficient counts; Newton removes its 1e-6 error
            jx = (self._distort(x + [h, 0]) - self._distort(x - [h, 0])) / (2 * h)
            jy = (self._distort(x + [0, h]) - self._distort(x - [0, h])) / (2 * h)
            det = jx[..., 0] * jy[..., 1] - jy[..., 0] * jx[..., 1]
            x_step = (f[..., 0] * jy[..., 1] - f[..., 1] * jy[..., 0]) / det
            step = _paired(x_step, (f[..., 1] * jx[..., 0] - f[..., 0] * jx[..., 1]) / det)
            x = x - step
            if np.all(np.abs(step) < 1e-14):
                break
        return self._pixels(x)

    def scaled(self, size_px: tuple[int, int]) -> Camera:
        """Return the camera for the image resized to a width and height [px] (pixel centres at integers)."""
        sx, sy = size_px[0] / self.size_px[0], size_px[1] / self.size_px[1]
        K = self.K.copy()
        K[0] *= sx
        K[1] *= sy
        # the centre of the first pixel moves: u' + 0.5 = sx (u + 0.5)
        K[0, 2] += 0.5 * sx - 0.5
        K[1, 2] += 0.5 * sy - 0.5
        return replace(self, size_px=(int(size_px[0]), int(size_px[1])), K=K)

    def cropped(self, x0_px: int, y0_px: int, size_px: tuple[int, int]) -> Camera:
        """Return the camera for a crop with width and height ``size_px`` and first pixel (x0_px, y0_px)."""
        K = self.K.copy()
        K[0, 2] -= x0_px
        K[1, 2] -= y0_px
        return replace(self, size_px=(int(size_px[0]), int(size_px[1])), K=K)

    def depth(self, points_world: ArrayLike) -> Array:
        """Return the depth of world points (..., 3) along the optical axis [mm], shape (...)."""
        return transform_points(self.T_cam_world, np.atleast_2d(points_world))[..., 2].reshape(
            np.shape(points_world)[:-1]
        )

    def _normalised(self, px: Array) -> Array:
        y = (px[..., 1] - self.K[1, 2]) / self.K[1, 1]
        x = (px[..., 0] - self.K[0, 2] - self.K[0, 1] * y) / self.K[0, 0]
        return _paired(x, y)

    def _pixels(self, x: Array) -> Array:
        u = self.K[0, 0] * x[..., 0] + self.K[0, 1] * x[..., 1] + self.K[0, 2]
        return _paired(u, self.K[1, 1] * x[..., 1] + self.K[1, 2])

    def _distort(self, x: Array) -> Array:
        if not self.distortion.size:
            return x
        k1, k2, p1, p2, k3, k4, k5, k6 = self.distortion.tolist() + [0.0] * (8 - self.distortion.size)
        x0, x1 = x[..., 0], x[..., 1]
        r2 = x0 * x0 + x1 * x1
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        if self.distortion.size > 5:
            radial = radial / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        xy = x0 * x1
        dx = 2 * p1 * xy + p2 * (r2 + 2 * x0**2)
        dy = p1 * (r2 + 2 * x1**2) + 2 * p2 * xy
        return _paired(x0 * radial + dx, x1 * radial + dy)


def intrinsics(fx: float, fy: float, cx: float, cy: float, skew: float = 0.0) -> Array:
    """Return the intrinsic matrix K (3, 3) of focal lengths, principal point and skew [px]."""
    return np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _paired(x: Array, y: Array) -> Array:
    """Return two coordinate arrays as one of shape (..., 2); faster than `np.stack` for small arrays."""
    out = np.empty((*x.shape, 2))
    out[..., 0], out[..., 1] = x, y
    return out


_SAMPLES = 400  # number of radii at which the polynomial is sampled for the fit
_RADIUS_FACTOR = 1.1  # factor by which the fitted radius exceeds that of the image, since undistortion may enlarge it
_TOLERANCE_PX = 0.005  # maximum error of a fit with K fixed; otherwise K is fitted too
_ROUNDS, _MAX_DAMPING = 200, 1e12


def opencv_radial(K: Array, size_px: tuple[int, int], radial: Array) -> tuple[Array, float]:
    """Return OpenCV's radial coefficients k1, k2, k3[, k4, k5, k6] of 1 + a1 r^2 + a2 r^4 + a3 r^6 + a4 r^8.

    With a fourth term, a ratio of two polynomials is fitted over the image. Return the coefficients, (3,) or (6,), and
    their largest error [px].
    """
    if radial[3] == 0:
        return radial[:3].copy(), 0.0
    corners = np.array([[x, y] for x in (0, size_px[0]) for y in (0, size_px[1])], np.float64)
    reach = np.abs((corners - K[:2, 2]) / np.diag(K)[:2]).max(0)
    r2 = np.linspace(0, (_RADIUS_FACTOR * float(np.linalg.norm(reach))) ** 2, _SAMPLES)[1:]
    g = 1 + sum(a * r2 ** (k + 1) for k, a in enumerate(radial))
    powers = np.stack([r2, r2**2, r2**3], axis=1)
    # n = g d is linear in the coefficients of n and d; the weight r makes residuals proportional to pixel errors
    weight = np.sqrt(r2)[:, None]
    found = np.linalg.lstsq(weight * np.hstack([powers, -g[:, None] * powers]), weight[:, 0] * (g - 1), rcond=None)[0]
    n, d = 1 + powers @ found[:3], 1 + powers @ found[3:]
    off = np.abs(n / d - g) * np.sqrt(r2) * float(np.diag(K)[:2].max())
    return np.asarray(found, np.float64), float(off.max() if (d > 0).all() else np.inf)


def opencv_lens(K: Array, recorded_px: Array, ideal: Array) -> tuple[Array, Array, Array, float]:
    """Fit K and OpenCV's eight coefficients to a lens that is given by distorted and undistorted points.

    K is kept if the coefficients alone fit the lens. Otherwise K is fitted too, which covers linear effects such as an
    anamorphic squeeze; then the camera rotation, which with the principal point moves the centre of distortion.

    `recorded_px` (N, 2) are points of the recorded image, `ideal` (N, 2) the same points without distortion, on the
    plane at depth 1, x right, y down. Return K (3, 3), the coefficients (8,), the rotation vector (3,) [rad] applied to
    the ideal points first, and the largest error [px], infinite if the fit fails.
    """
    best, off = np.concatenate([K[[0, 1, 0, 0, 1], [0, 1, 1, 2, 2]], np.zeros(11)]), np.inf
    for free in (np.arange(5, 13), np.arange(13), np.arange(16)):
        best = _least_squares(best, free, recorded_px, ideal)
        off = float(np.abs(_through(best, ideal) - recorded_px).max())
        if off <= _TOLERANCE_PX:
            break
    return _with_lens(best).K, best[5:13], best[13:], off if np.isfinite(off) else np.inf


def _least_squares(values: Array, free: npt.NDArray[np.intp], recorded_px: Array, ideal: Array) -> Array:
    """Return the values, with those at the indices ``free`` fitted by Levenberg-Marquardt with numeric derivatives."""
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
            if damping > _MAX_DAMPING:
                break
            continue
        gained = residual @ residual - after @ after
        values, residual, damping = moved, after, max(damping / 10, 1e-12)
        if gained < 1e-9 * (residual @ residual) + 1e-14:
            break
    return values


def _through(values: Array, ideal: Array) -> Array:
    """Return the pixels (N, 2) of ideal points through the lens of `opencv_lens` with these values (16,)."""
    turned = so3_exp(values[13:]) @ np.vstack([ideal.T, np.ones(len(ideal))])
    camera = _with_lens(values)
    return camera._pixels(camera._distort((turned[:2] / turned[2]).T))


def _with_lens(values: Array) -> Camera:
    """Return a camera with fx, fy, skew, cx, cy [px] and eight distortion coefficients."""
    fx, fy, skew, cx, cy = values[:5]
    return Camera("", (1, 1), intrinsics(fx, fy, cx, cy, skew), values[5:13], np.eye(4))
