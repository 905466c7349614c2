"""The camera of a photograph that nobody calibrated: one focal length, the middle of the picture, one distortion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.geometry import orthonormalise, transform_points
from jawusd.tracking.contour.equations import motion_about

#: Unknowns of a photograph: twist of the upper teeth about their centre [rad, mm], log focal length, distortion. With
#: the focal length the distance changes so that the teeth stay as large: large steps of it are then harmless.
UNKNOWNS = 8


@dataclass(frozen=True, eq=False)
class PhotoPose:
    """Hold where a photograph was taken and with what lens."""

    T_cam_upper: Array  # shape (4, 4)
    focal_px: float  # at the size of the picture
    distortion: float  # k1 of x (1 + k1 r^2), r the distance from the middle over half the width of the picture

    def stepped(self, centre: Array, step: Array) -> PhotoPose:
        """Return the pose after a step (8,) of the unknowns; `centre` is that of the upper teeth, camera [mm]."""
        pose = orthonormalise(motion_about(centre, step[:6]) @ self.T_cam_upper)
        pose[2, 3] += centre[2] * np.expm1(step[6])
        return PhotoPose(pose, self.focal_px * float(np.exp(step[6])), self.distortion + float(step[7]))

    def scaled(self, factor: float) -> PhotoPose:
        """Return the pose for the picture shrunk by a factor."""
        return replace(self, focal_px=self.focal_px * factor)

    def opencv_k1(self, size_px: tuple[int, int]) -> float:
        """Return the distortion as OpenCV's k1, of directions instead of half widths."""
        return self.distortion * (2.0 * self.focal_px / size_px[0]) ** 2

    def camera_matrix(self, size_px: tuple[int, int]) -> Array:
        """Return the projection without distortion from camera [mm] to homogeneous px, shape (3, 3)."""
        u, v = middle_of(size_px)
        return np.array([[self.focal_px, 0.0, u], [0.0, self.focal_px, v], [0.0, 0.0, 1.0]])

    def pixels(self, points: Array, size_px: tuple[int, int]) -> Array:
        """Return where points in camera coordinates (N, 3) [mm] are seen [px], shape (N, 2)."""
        flat = self.focal_px * points[:, :2] / points[:, 2:]
        return flat * (1.0 + self.distortion * _radius2(flat, size_px))[:, None] + middle_of(size_px)

    def slopes(
        self, points: Array, directions: Array, size_px: tuple[int, int], distance_mm: float
    ) -> tuple[Array, Array]:
        """Return the derivative along image directions by the camera point (N, 3) [px/mm] and by the lens (N, 2).

        The lens columns are log focal length, with the distance of the teeth, and distortion. `directions` are unit
        vectors, shape (N, 2).
        """
        flat = self.focal_px * points[:, :2] / points[:, 2:]
        r2 = _radius2(flat, size_px)
        along = (directions * flat).sum(1)
        # d(distorted)/d(flat) is symmetric: (1 + k r2) I + 2 k flat flat^T / half^2
        bent = directions * (1.0 + self.distortion * r2)[:, None]
        bent += flat * (2.0 * self.distortion * along / (0.5 * size_px[0]) ** 2)[:, None]
        by_point = np.column_stack([bent * self.focal_px, -(bent * flat).sum(1)]) / points[:, 2:]
        by_focal = (bent * flat).sum(1) + by_point[:, 2] * distance_mm
        return by_point, np.column_stack([by_focal, along * r2])


def middle_of(size_px: tuple[int, int]) -> Array:
    """Return the middle of a picture [px], shape (2,)."""
    return 0.5 * (np.array(size_px, np.float64) - 1.0)


def to_camera(pose: PhotoPose, T_upper_lower: Array, points: Array, arch: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return scan points (N, 3) of both arches in upper scan and in camera coordinates [mm], shape (N, 3) each."""
    in_upper = np.where(arch[:, None] == 1, transform_points(T_upper_lower, points), points)
    return in_upper, transform_points(pose.T_cam_upper, in_upper)


def _radius2(flat: Array, size_px: tuple[int, int]) -> Array:
    return np.asarray((flat**2).sum(1) / (0.5 * size_px[0]) ** 2, np.float64)
