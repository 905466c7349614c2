"""Bundle adjustment of fixed cameras over views of a planar board.

The robust reprojection error is minimised over the intrinsics (fx, fy, cx, cy, k1, k2), the camera poses (the first
camera is the world frame) and the board poses. Other distortion coefficients stay 0, since few images of a small board
do not determine them. The Jacobian is analytic and sparse; the derivatives are OpenCV's for the lens, and those of Solà
et al. 2018 (eq. 143) for rotations.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_matrix

from jawusd.base.arrays import Array
from jawusd.base.errors import CalibrationError
from jawusd.capture.initial_guess import BoardCameras
from jawusd.geometry import hat, make_transform, so3_exp, so3_left_jacobian, so3_log
from jawusd.geometry.camera import intrinsics

_LENS = 6  # Number of lens parameters per camera: fx, fy, cx, cy, k1, k2.
_POSE = 6  # Number of pose parameters: rotation vector [rad], translation [mm].
_HUBER_SIGMAS, _LEAST_SIGMA_PX = 3.0, 0.02
_MOST_STEPS = 100
_OUTLIER_SIGMAS, _OUTLIER_PX = 8.0, 1.0  # residual limits; a corner is an outlier if its residual exceeds both
_FEWEST_CORNERS = 6  # minimum number of inlier corners of a view; views with fewer are dropped


@dataclass(frozen=True, eq=False)
class Bundle(BoardCameras):
    """Result of the bundle adjustment; outlier corners are NaN, and views without corners are left out."""

    residuals_px: Array  # projected minus observed pixels, NaN for corners not used, shape (C, V, N, 2)
    parameters: Array  # Camera parameters (see `camera_from`), shape (12 C - 6,).
    covariance: Array  # Covariance of the camera parameters, shape (12 C - 6, 12 C - 6).


def adjust(start: BoardCameras, points_mm: Array) -> Bundle:
    """Adjust the bundle, discard outlier corners and adjust again; `points_mm` (N, 3) are the corners on the board.

    Raises:
        CalibrationError: the adjustment does not converge.
    """
    corners = start.corners_px.copy()
    corners[:, ~np.isfinite(start.T_world_board[:, 0, 0])] = np.nan
    problem = _Problem(corners, points_mm)
    solution = problem.solve(problem.pack(start))
    off = np.linalg.norm(problem.spread(solution), axis=-1)
    outlier = off > max(_OUTLIER_SIGMAS * float(np.nanmedian(off)), _OUTLIER_PX)
    if outlier.any():
        corners = problem.corners_px.copy()
        corners[outlier] = np.nan
        corners[np.isfinite(corners[..., 0]).sum(-1) < _FEWEST_CORNERS] = np.nan
        again = _Problem(corners, points_mm)
        cameras, boards = problem.split(solution)
        problem, solution = again, again.solve(np.concatenate([cameras, boards[again.views].ravel()]))
    cameras, boards = problem.split(solution)
    K, distortion, T_cam_world = camera_from(cameras)
    return Bundle(
        K,
        distortion,
        T_cam_world,
        make_transform(so3_exp(boards[:, :3]), boards[:, 3:]),
        problem.corners_px,
        problem.spread(solution),
        cameras,
        problem.covariance(solution),
    )


def camera_from(parameters: Array) -> tuple[Array, Array, Array]:
    """Return K (C, 3, 3), k1 and k2 (C, 2) and T_cam_world (C, 4, 4) from camera parameters, shape (12 C - 6,)."""
    count = (len(parameters) + _POSE) // (_LENS + _POSE)
    lens = parameters[: count * _LENS].reshape(count, _LENS)
    K = np.zeros((count, 3, 3))
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = *lens[:, :4].T, np.ones(count)
    poses = np.concatenate([np.zeros((1, _POSE)), parameters[count * _LENS :].reshape(count - 1, _POSE)])
    return K, lens[:, 4:], make_transform(so3_exp(poses[:, :3]), poses[:, 3:])


class _Problem:
    """Residuals and Jacobian of all views in which any camera sees corners."""

    def __init__(self, corners_px: Array, points_mm: Array) -> None:
        self.views = np.flatnonzero(np.isfinite(corners_px[..., 0]).any((0, 2)))
        self.corners_px, self.points_mm = corners_px[:, self.views], points_mm
        self.cameras = len(corners_px)
        self.seen = np.isfinite(self.corners_px[..., 0])
        # For each camera: the view index and corner index of every observed point.
        self.points = [np.nonzero(seen) for seen in self.seen]

    def pack(self, start: BoardCameras) -> Array:
        """Return the unknowns of an initial guess: lenses, poses of all cameras but the first, and board poses."""
        lens = np.stack([start.K[:, 0, 0], start.K[:, 1, 1], start.K[:, 0, 2], start.K[:, 1, 2]], axis=1)
        T = np.concatenate([start.T_cam_world[1:], start.T_world_board[self.views]])
        poses = np.concatenate([so3_log(T[:, :3, :3]), T[:, :3, 3]], axis=1)
        return np.concatenate([np.hstack([lens, start.distortion]).ravel(), poses.ravel()])

    def split(self, x: Array) -> tuple[Array, Array]:
        """Split the unknowns into the camera parameters and the board parameters (V, 6)."""
        own = self.cameras * (_LENS + _POSE) - _POSE
        return x[:own], x[own:].reshape(-1, _POSE)

    def solve(self, x: Array) -> Array:
        """Return the unknowns that minimise the robust error (reweighted Levenberg-Marquardt; Triggs et al. 2000).

        The normal equations are solved densely: iterative solvers converge slowly, as focal length and distance are
        strongly correlated.
        """
        for _ in range(2):  # the second run uses the residual scale found in the first run
            scale = _HUBER_SIGMAS * max(_LEAST_SIGMA_PX, 1.4826 * float(np.median(np.abs(self.residuals(x)))))
            x = self._descend(x, scale)
        return x

    def _descend(self, x: Array, scale_px: float) -> Array:
        damping, cost = 1e-4, _huber(self.residuals(x), scale_px)
        for _ in range(_MOST_STEPS):
            residual, J = self.residuals(x), self.jacobian(x)
            weights = np.minimum(1.0, scale_px / np.maximum(np.abs(residual), 1e-300))
            normal = (J.T @ J.multiply(weights[:, None])).toarray()
            gradient = J.T @ (weights * residual)
            before = cost
            while damping < 1e10:
                damped = normal + damping * np.diag(np.diag(normal))
                candidate = x - cho_solve(cho_factor(damped), gradient)
                cost = _huber(self.residuals(candidate), scale_px)
                if cost <= before:
                    x, damping = candidate, damping / 10
                    break
                damping *= 10
            else:
                return x  # converged, since no step reduces the error
            if before - cost <= 1e-10 * before:
                return x
        raise CalibrationError(f"the bundle adjustment did not converge in {_MOST_STEPS} steps.")

    def residuals(self, x: Array) -> Array:
        """Return the residuals, projected minus observed [px], shape (R,)."""
        turns = so3_exp(self.split(x)[1][:, :3])
        return np.concatenate([self._camera(x, turns, c)[0] for c in range(self.cameras)])

    def spread(self, x: Array) -> Array:
        """Return the residuals as (C, V, N, 2), NaN where not observed."""
        out = np.full(self.corners_px.shape, np.nan)
        out[self.seen] = self.residuals(x).reshape(-1, 2)
        return out

    def jacobian(self, x: Array) -> csr_matrix:
        """Return the sparse Jacobian of the residuals with respect to the unknowns, shape (R, U)."""
        boards = self.split(x)[1]
        turns, slopes = so3_exp(boards[:, :3]), so3_left_jacobian(boards[:, :3])
        data, rows, columns, row = [], [], [], 0
        for c in range(self.cameras):
            parts = self._parts(x, turns, slopes, c)
            for first, part in parts:
                data.append(part.ravel())
                rows.append(np.repeat(np.arange(row, row + len(part)), _POSE))
                columns.append((np.broadcast_to(first, len(part))[:, None] + np.arange(_POSE)).ravel())
            row += len(parts[0][1])
        entries = (np.concatenate(data), (np.concatenate(rows), np.concatenate(columns)))
        return csr_matrix(entries, shape=(row, len(x)))

    def covariance(self, x: Array) -> Array:
        """Return the covariance of the camera parameters after marginalising the board poses."""
        J, residual = self.jacobian(x), self.residuals(x)
        sigma = 1.4826 * np.median(np.abs(residual))
        normal = (J.T @ J).toarray()
        scale = 1 / np.sqrt(np.diag(normal))  # parameters have different units, so normalise before inverting
        inverse = np.linalg.pinv(normal * scale[:, None] * scale, hermitian=True) * scale[:, None] * scale
        own = len(self.split(x)[0])
        return sigma**2 * inverse[:own, :own]

    def _camera(self, x: Array, turns: Array, c: int) -> tuple[Array, Array, Array, Array]:
        """Project the n points that camera c sees, given the board rotations (V, 3, 3).

        Return residuals (2n,), OpenCV's derivative of the pixels (2n, ...), and the points after the board and the
        camera rotation, (n, 3) each, in the order of the views.
        """
        cameras, boards = self.split(x)
        lens, pose = cameras[c * _LENS : (c + 1) * _LENS], self._pose(x, c)
        K = intrinsics(*lens[:4])
        views, corners = self.points[c]
        turned = (turns[views] @ self.points_mm[corners][..., None])[..., 0]
        carried = (turned + boards[views, 3:]) @ so3_exp(pose[:3]).T
        terms = np.array([*lens[4:], 0.0, 0.0])
        found, derived = cv2.projectPoints(carried + pose[3:], np.zeros(3), np.zeros(3), K, terms)
        seen = self.corners_px[c, views, corners]
        residual = np.asarray(found, np.float64).reshape(-1, 2) - seen
        return residual.ravel(), np.asarray(derived, np.float64), turned, carried

    def _parts(self, x: Array, turns: Array, slopes: Array, c: int) -> list[tuple[Array | int, Array]]:
        """Return blocks (2n, 6) of one camera's Jacobian, each with its column offset, for all rows or per row.

        `turns` and `slopes` (V, 3, 3) are the rotations of the boards and their left Jacobians.
        """
        pose, views = self._pose(x, c), self.points[c][0]
        _, J, turned, carried = self._camera(x, turns, c)
        # Columns of OpenCV's Jacobian: rotation 0-2, translation 3-5, f 6-7, c 8-9, distortion from 10.
        by_point = J[:, 3:6].reshape(-1, 2, 3)
        parts: list[tuple[Array | int, Array]] = [(c * _LENS, J[:, 6:12])]
        if c:
            by_turn = by_point @ (-hat(carried)) @ so3_left_jacobian(pose[:3])
            own = np.concatenate([by_turn, by_point], axis=-1).reshape(-1, _POSE)
            parts.append((self.cameras * _LENS + (c - 1) * _POSE, own))
        by_world = by_point @ so3_exp(pose[:3])
        by_turn = by_world @ (-hat(turned)) @ slopes[views]
        board = np.concatenate([by_turn, by_world], axis=-1).reshape(-1, _POSE)
        parts.append((np.repeat(len(self.split(x)[0]) + views * _POSE, 2), board))
        return parts

    def _pose(self, x: Array, c: int) -> Array:
        """Return the pose of a camera; the first camera is the world frame."""
        column = self.cameras * _LENS + (c - 1) * _POSE
        return x[column : column + _POSE] if c else np.zeros(_POSE)


def _huber(residual: Array, scale_px: float) -> float:
    size = np.abs(residual)
    return float(np.where(size <= scale_px, 0.5 * size**2, scale_px * (size - 0.5 * scale_px)).sum())
