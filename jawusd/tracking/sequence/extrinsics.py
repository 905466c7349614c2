"""Corrections of camera poses, estimated from a whole take; prior of the corrections, and corrected views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.notes import CameraCorrections, TracksMeta
from jawusd.geometry import Camera, se3_adjoint, se3_exp, se3_inverse, se3_log
from jawusd.tracking.contour.equations import motion_about, translation
from jawusd.tracking.contour.views import View


@dataclass(frozen=True, eq=False)
class Extrinsics:
    """Corrections of camera poses.

    For camera c, the world is moved by exp(twists[c]) about the pivot. A motion common to all cameras would be a motion
    of the world, so the sum of the twists is constrained to zero.
    """

    T_cam_world: Array  # the calibrated poses, shape (C, 4, 4)
    pivot: Array  # centre of the teeth in world coordinates [mm], where the masks constrain motion best, shape (3,)
    twists: Array  # the corrections [rad, mm], shape (C, 6)
    sigma: Array  # standard deviations of the corrections [rad, mm], shape (C, 6)

    @classmethod
    def calibrated(cls, cameras: Sequence[Camera], pivot: Array) -> Extrinsics:
        """Return zero corrections for the calibrated cameras."""
        nothing = np.zeros((len(cameras), 6))
        return cls(np.stack([c.T_cam_world for c in cameras]), np.asarray(pivot, float), nothing, nothing)

    def motions(self) -> Array:
        """Return the apparent motion of the world in each camera, shape (C, 4, 4)."""
        return motion_about(self.pivot, self.twists)

    def then(self, twists: Array, sigma: Array) -> Extrinsics:
        """Return the corrections composed with further twists and their standard deviations, shapes (C, 6)."""
        both = se3_log(se3_exp(self.twists) @ se3_exp(twists))
        return replace(self, twists=both - both.mean(0), sigma=sigma)

    def poses(self) -> Array:
        """Return the corrected T_cam_world, shape (C, 4, 4)."""
        return self.T_cam_world @ self.motions()

    def correct(self, views: Sequence[View]) -> list[View]:
        """Return the views with the projections of the corrected cameras."""
        moved = self.motions()
        return [
            replace(view, matrix=view.matrix @ M, eye=se3_inverse(M)[:3, :3] @ view.eye + se3_inverse(M)[:3, 3])
            for view, M in zip(views, moved, strict=True)
        ]

    def precision(self, turn_rad: float, move_mm: float) -> Array:
        """Return the prior precision of the twists of each camera, shape (C, 6, 6).

        The standard deviations per axis apply to rotations about the camera centre and to translations.
        """
        A = se3_adjoint(translation(-self.pivot) @ se3_inverse(self.T_cam_world))
        variance = np.r_[np.full(3, turn_rad**2), np.full(3, move_mm**2)]
        return np.linalg.inv(A @ (variance[:, None] * np.swapaxes(A, -1, -2)))

    def report(self, names: Sequence[str]) -> CameraCorrections:
        """Return corrections, uncertainties and corrected poses by camera name, for the tracks' metadata."""

        def by_name(values: Array) -> dict[str, list[float]]:
            return dict(zip(names, values.tolist(), strict=True))

        return {
            "corrected": bool(self.twists.any()),
            "pivot_mm": self.pivot.tolist(),
            "turns_deg": by_name(np.degrees(self.twists[:, :3])),
            "turns_sigma_deg": by_name(np.degrees(self.sigma[:, :3])),
            "moves_mm": by_name(self.twists[:, 3:]),
            "moves_sigma_mm": by_name(self.sigma[:, 3:]),
            "T_cam_world": dict(zip(names, self.poses().tolist(), strict=True)),
        }


def corrected_cameras(cameras: Sequence[Camera], meta: TracksMeta) -> list[Camera]:
    """Return cameras with the corrections of pose and focal length that are stored in the metadata of tracks."""
    poses = meta["extrinsics"]["T_cam_world"] if "extrinsics" in meta else {}
    moved = [replace(c, T_cam_world=np.array(poses.get(c.name, c.T_cam_world))) for c in cameras]
    focal = meta.get("focal", {})
    return [_with_focal(c, focal[c.name][0]) if c.name in focal else c for c in moved]


def _with_focal(camera: Camera, factor: float) -> Camera:
    """Return a camera with its focal length multiplied by a factor f; the distortion of each pixel is kept.

    Normalised coordinates x become x / f; in OpenCV's model, k1 therefore becomes f^2 k1, and p1 becomes f p1.
    """
    K = camera.K.copy()
    K[:2, :2] *= factor
    powers = np.array([2, 4, 1, 1, 6, 2, 4, 6])[: camera.distortion.size]
    return replace(camera, K=K, distortion=camera.distortion * factor**powers)
