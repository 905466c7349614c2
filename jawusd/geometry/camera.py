"""Pinhole cameras with OpenCV's radial-tangential distortion, in numpy.

Model: OpenCV "Camera Calibration and 3D Reconstruction": coefficients (k1, k2, p1, p2[, k3[, k4, k5, k6]]).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.geometry.se3 import se3_inverse, transform_points

_ALLOWED_COEFFICIENTS = (0, 4, 5, 8)


@dataclass(frozen=True, eq=False)
class Camera:
    """Describe one calibrated camera."""

    name: str  # the camera's name in the capture
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
                f"camera {self.name}: {distortion.size} distortion coefficients, allowed are {_ALLOWED_COEFFICIENTS}"
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
        """Map ideal pinhole pixels (..., 2) to pixels of the recorded picture."""
        x = self._normalised(np.asarray(pinhole_px, dtype=np.float64))
        return self._pixels(self._distort(x))

    def undistort_pixels(self, pixels: ArrayLike) -> Array:
        """Map pixels (..., 2) of the recorded picture to ideal pinhole pixels (Newton, to 1e-10 px for real lenses)."""
        target = self._normalised(np.asarray(pixels, dtype=np.float64))
        x = target.copy()
        h = 1e-6
        for _ in range(12):
            f = self._distort(x) - target
            # A numeric Jacobian keeps one formula for all coefficient counts; Newton squares its 1e-6 error away.
            jx = (self._distort(x + [h, 0]) - self._distort(x - [h, 0])) / (2 * h)
            jy = (self._distort(x + [0, h]) - self._distort(x - [0, h])) / (2 * h)
            det = jx[..., 0] * jy[..., 1] - jy[..., 0] * jx[..., 1]
            step = np.stack(
                [
                    (f[..., 0] * jy[..., 1] - f[..., 1] * jy[..., 0]) / det,
                    (f[..., 1] * jx[..., 0] - f[..., 0] * jx[..., 1]) / det,
                ],
                axis=-1,
            )
            x = x - step
            if np.all(np.abs(step) < 1e-14):
                break
        return self._pixels(x)

    def scaled(self, size_px: tuple[int, int]) -> Camera:
        """Return the camera of the same picture resized to a width and height [px] (pixel centres at integers)."""
        sx, sy = size_px[0] / self.size_px[0], size_px[1] / self.size_px[1]
        K = self.K.copy()
        K[0] *= sx
        K[1] *= sy
        # The centre of the first pixel moves: u' + 0.5 = sx (u + 0.5).
        K[0, 2] += 0.5 * sx - 0.5
        K[1, 2] += 0.5 * sy - 0.5
        return replace(self, size_px=(int(size_px[0]), int(size_px[1])), K=K)

    def cropped(self, x0_px: int, y0_px: int, size_px: tuple[int, int]) -> Camera:
        """Return the camera of a part of the picture: size_px is its width and height, (x0_px, y0_px) its first pixel.

        The crop's own distortion stays exact because it acts on normalised coordinates.
        """
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


def _paired(x: Array, y: Array) -> Array:
    """Return two coordinates of any shape as one array (..., 2); quicker than `np.stack` for few."""
    out = np.empty((*x.shape, 2))
    out[..., 0], out[..., 1] = x, y
    return out
