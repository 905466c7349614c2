"""Magnification of the masks relative to calibration and scans: wrong focal lengths, lenses and scan sizes.

With two or more cameras, poses cannot compensate for an image that is magnified about its principal point: over a take,
distances between projected contours and mask edges grow with the distance from that point. Magnification and its change
with the radius are estimated per camera, with poses, camera motions and outline biases eliminated.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.geometry import Camera, transform_point, transform_points
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.correspondences import search_edges
from jawusd.tracking.contour.samples import HABITS, LENGTH, NX, NY, U, V, X, Z, contour_samples
from jawusd.tracking.contour.scan import ARCHES, Scan
from jawusd.tracking.contour.views import Drawn, View

_REACH_PX = 16.0  # search distance around contours [px]: an error of 5 % in focal length shifts molars by 9 px
_RADIUS_MM = 25.0  # distance from the optical axis at which distortion is reported [mm]: the outermost visible teeth
# Prior standard deviations: magnification and distortion [-], rotation [rad] and motion [mm] of a camera per axis,
# outline bias [px].
_PRIORS = (0.1, 0.1, *(0.01,) * 3, *(2.0,) * 3, 1.0, 1.0)
_UNKNOWNS = len(_PRIORS)
_ROUNDS = 5
_LENGTH_FACTOR = 1.5  # factor on the correlation length: offsets the effects of the Tukey weight and of the fit
_LEAST_SPREAD_PX = 0.3


@dataclass(frozen=True, eq=False)
class Magnification:
    """Magnification of the teeth in each camera relative to that expected from calibration and scans."""

    scale: Array  # relative error of the magnification, shape (C,): 0.05 if teeth appear 5 % larger than expected
    sigma_scale: Array
    bend: Array  # change of `scale` from the optical axis to a radius of 25 mm at the teeth, shape (C,)
    sigma_bend: Array
    bias_px: Array  # outward mask bias at working resolution, per arch, shape (C, 2)
    sigma_bias_px: Array
    turn_rad: Array  # angle of rotation of each camera relative to the mean of all, shape (C,)
    move_mm: Array  # distance of translation of each camera relative to the mean of all, shape (C,)
    motion_clear: Array  # significance of both together, in standard deviations (Mahalanobis), shape (C,)

    @property
    def common(self) -> float:
        """The magnification error common to all cameras [-]: the median over the cameras."""
        return float(np.median(self.scale))


#: A video frame: T_world_upper and T_world_lower (2, 4, 4), its views, and the masks used (2, C).
Instant = tuple[Array, Sequence[View], Mask]


class _Rows(NamedTuple):
    """Linearised contour distances of an arch in a video frame: d = J x + C theta, pose x, shared unknowns theta."""

    distance: Array  # signed distances of the samples to the mask edges [px], shape (n,)
    length: Array  # contour length that each sample represents [px], shape (n,)
    pose: Array  # derivatives with respect to the twist of the arch, shape (n, 6)
    camera: Array  # camera index of each row, shape (n,)
    shared: Array  # derivatives with respect to the unknowns of the row's camera, shape (n, _UNKNOWNS)


def measure_magnification(
    scans: Sequence[Scan], instants: Iterable[Instant], config: TrackingConfig
) -> Magnification | None:
    """Estimate the magnification of all cameras from some frames; None without enough matches."""
    blocks: list[_Rows] = []
    cameras = 0
    for poses, views, use in instants:
        cameras = len(views)
        pivot = np.mean([transform_point(poses[r], scans[r].centre) for r in ARCHES], axis=0)
        for r in ARCHES:
            rows = (_rows(scans, r, c, poses, view, pivot, config) for c, view in enumerate(views) if use[r, c])
            parts = [part for part in rows if part is not None]
            if len(parts) >= 2:
                blocks.append(_Rows(*(np.concatenate(columns) for columns in zip(*parts, strict=True))))
    if not blocks:
        return None
    return _solved(blocks, cameras, config)


def _rows(
    scans: Sequence[Scan], r: int, c: int, poses: Array, view: View, pivot: Array, config: TrackingConfig
) -> _Rows | None:
    """Match the contour of an arch in one view within a large search distance; None if nothing matches."""
    scan, pose = scans[r], view.T_delay[r] @ poses[r]
    samples, distance = _matched(scans, r, view, poses, config)
    if not len(samples):
        return None
    points = transform_points(pose, samples[:, X : Z + 1])
    third = view.matrix[2, :3] @ points.T + view.matrix[2, 3]
    slope = displacement_slopes(samples, points, view.matrix)
    M = view.matrix[:, :3]
    focal = float(np.linalg.norm(np.cross(M[0], M[2]))) / float(M[2] @ M[2])
    radius_px = _RADIUS_MM * focal / float(np.median(third)) * float(np.linalg.norm(M[2]))
    outwards = samples[:, [U, V]] - principal_point(view.matrix)
    radial = np.einsum("nk,nk->n", samples[:, [NX, NY]], outwards)
    bias = np.zeros((len(samples), 2))
    bias[:, r] = 1.0
    centre = transform_point(poses[r], scan.centre)
    bent = radial * (outwards**2).sum(1) / radius_px**2
    shared = np.column_stack([radial, bent, np.cross(points - pivot, slope), slope, bias])
    own = np.column_stack([np.cross(points - centre, slope), slope])
    return _Rows(distance, samples[:, LENGTH], own, np.full(len(samples), c), shared)


def _matched(scans: Sequence[Scan], r: int, view: View, poses: Array, config: TrackingConfig) -> tuple[Array, Array]:
    """Return the contour samples of an arch near a mask edge (n, COLUMNS), and their distances to it (n,) [px]."""
    labels = np.zeros((2, *view.masks.shape[1:]), np.uint8)
    depth = np.zeros(labels.shape, np.float32)
    # the other arch need not be rendered, since the masks already separate the arches
    drawn = [r] if view.edges is None else ARCHES
    for arch in drawn:
        scans[arch].draw(view.matrix @ view.T_delay[arch] @ poses[arch], depth[arch], labels[arch])
    pose = view.T_delay[r] @ poses[r]
    eye = pose[:3, :3].T @ (view.eye - pose[:3, 3])
    limits = (config.sample_step_px, config.depth_tolerance_mm)
    samples, count = contour_samples(scans[r], view.matrix @ pose, eye, labels[r], depth[r], *limits)
    reach = (_REACH_PX, config.overlap_tolerance_mm, 0.8)
    if view.edges is None:
        distance = np.empty(len(samples))
        search_edges(samples, view.masks[r], labels[1 - r], depth[1 - r], *reach, distance)
    else:
        both = Drawn(labels[r], labels[1 - r], depth[1 - r])
        distance, weights = view.edges.search(samples, count, r, both, reach)
        distance = distance - samples[:, HABITS] @ view.habits[r]
        samples[:, LENGTH] *= np.nan_to_num(weights)
    found = np.isfinite(distance) & (samples[:, LENGTH] > 0)
    return samples[found], distance[found]


def _solved(blocks: Sequence[_Rows], cameras: int, config: TrackingConfig) -> Magnification:
    """Solve for the shared unknowns by iterative reweighting (Tukey), with poses eliminated block by block."""
    size = _UNKNOWNS * cameras
    prior = np.diag(np.tile(np.array(_PRIORS) ** -2.0, cameras))
    left = [block.distance for block in blocks]
    spread = max(_spread(np.concatenate(left)), _LEAST_SPREAD_PX)
    theta, covariance = np.zeros(size), np.zeros((size, size))
    for _ in range(_ROUNDS):
        S, right, eliminated = prior.copy(), np.zeros(size), []
        for block, rest in zip(blocks, left, strict=True):
            gate = config.gate_sigmas * spread
            weight = np.clip(1.0 - (rest / gate) ** 2, 0.0, None) ** 2 * block.length
            weight /= spread**2 * config.correlation_px * _LENGTH_FACTOR
            C = np.zeros((len(rest), size))
            for c in range(cameras):
                own = block.camera == c
                C[own, _UNKNOWNS * c : _UNKNOWNS * (c + 1)] = block.shared[own]
            A = np.einsum("ni,n,nj->ij", block.pose, weight, block.pose) + 1e-9 * np.eye(6)
            B, W = block.pose.T @ (weight[:, None] * C), weight[:, None] * C
            a = block.pose.T @ (weight * block.distance)
            solved = np.linalg.solve(A, np.column_stack([B, a]))
            S += C.T @ W - B.T @ solved[:, :-1]
            right += W.T @ block.distance - B.T @ solved[:, -1]
            eliminated.append((C, solved))
        covariance = np.asarray(np.linalg.inv(S), np.float64)
        theta = covariance @ right
        left = [
            block.distance - C @ theta - block.pose @ (solved[:, -1] - solved[:, :-1] @ theta)
            for block, (C, solved) in zip(blocks, eliminated, strict=True)
        ]
        spread = max(_spread(np.concatenate(left)), _LEAST_SPREAD_PX)
    sigma = np.sqrt(np.diag(covariance)).reshape(cameras, _UNKNOWNS)
    found = theta.reshape(cameras, _UNKNOWNS)
    bias_sigma = np.minimum(sigma[:, 8:], 1.0)
    motion = _motion(theta, covariance, cameras)
    return Magnification(found[:, 0], sigma[:, 0], found[:, 1], sigma[:, 1], found[:, 8:], bias_sigma, *motion)


def _motion(theta: Array, covariance: Array, cameras: int) -> tuple[Array, Array, Array]:
    """Return rotation [rad] and motion [mm] of each camera relative to the mean, and its significance, shapes (C,)."""
    against_mean = np.eye(cameras) - 1.0 / cameras
    pick = np.zeros((6, _UNKNOWNS))
    pick[:, 2:8] = np.eye(6)
    twists, clear = np.zeros((cameras, 6)), np.zeros(cameras)
    for c in range(cameras):
        rows = np.kron(against_mean[c], pick)
        twists[c] = rows @ theta
        clear[c] = np.sqrt(twists[c] @ np.linalg.pinv(rows @ covariance @ rows.T) @ twists[c])
    return np.linalg.norm(twists[:, :3], axis=1), np.linalg.norm(twists[:, 3:], axis=1), clear


def magnified(view: View, factor: float) -> View:
    """Return a view with the focal length multiplied by a factor."""
    grow = np.diag([factor, factor, 1.0])
    grow[:2, 2] = (1.0 - factor) * principal_point(view.matrix)
    return replace(view, matrix=grow @ view.matrix)


def zoomed(camera: Camera, factor: float) -> Camera:
    """Return a camera with its focal length multiplied by a factor."""
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= factor
    return replace(camera, K=K)


def principal_point(matrix: Array) -> Array:
    """Return the principal point of a projection (3, 4) without skew [px], shape (2,)."""
    return np.asarray(matrix[:2, :3] @ matrix[2, :3] / (matrix[2, :3] @ matrix[2, :3]), np.float64)


def displacement_slopes(samples: Array, points: Array, matrix: Array) -> Array:
    """Return derivatives (n, 3) of samples' normal displacements [px] with respect to their world points (n, 3)."""
    depth = points @ matrix[2, :3] + matrix[2, 3]
    across = matrix[:2, :3] - samples[:, [U, V], None] * matrix[2, :3]
    return np.asarray(np.einsum("nk,nkj->nj", samples[:, [NX, NY]], across) / depth[:, None], np.float64)


def _spread(distances: Array) -> float:
    return float(1.4826 * np.median(np.abs(distances)))
