"""Initial values of a calibration: the intrinsics of each camera, and the camera poses.

A detector may list the corners of a symmetric board in a different order in every image. Each order corresponds to the
board rotated in its plane. The relative pose of two fixed cameras is the same in all views only if the same corner is
listed first for both. The relative pose that most views agree on therefore determines the orders, and reveals views
that were not simultaneous.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import CalibrationError
from jawusd.geometry import make_transform, se3_inverse, so3_exp, so3_log

FEWEST_VIEWS = 6  # minimum number of board views per camera; with fewer, focal length and distance are ambiguous
# Tolerances within which relative poses count as equal: angle, and relative difference of positions.
_SAME_ANGLE_RAD, _SAME_SHARE = np.deg2rad(4.0), 0.04
_LEAST_AGREEMENT = 0.5  # minimum fraction of two cameras' shared views that must agree on the relative pose
_INTRINSIC_FLAGS = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST


@dataclass(frozen=True, eq=False)
class BoardCameras:
    """C cameras and V views of a board with N corners: initial values, or the result of the bundle adjustment."""

    K: Array  # intrinsic matrices [px], shape (C, 3, 3)
    distortion: Array  # k1 and k2 of each camera, shape (C, 2)
    T_cam_world: Array  # transforms from world (the first camera) to camera [mm], shape (C, 4, 4)
    T_world_board: Array  # transforms from board to world [mm], NaN for inconsistent views, shape (V, 4, 4)
    corners_px: Array  # corner pixels in a common order, NaN where hidden or inconsistent, (C, V, N, 2)


def initial_cameras(
    names: tuple[str, ...],
    sizes_px: tuple[tuple[int, int], ...],
    corners_px: Array,
    points_mm: Array,
    symmetries: list[NDArray[np.int64]],
) -> BoardCameras:
    """Calibrate each camera separately, then estimate the camera poses from shared views.

    Args:
        corners_px: detected corners, NaN where hidden, shape (C, V, N, 2).
        points_mm: corners on the board, shape (N, 3).
        symmetries: orders in which the corners may be listed, permutations of (N,); the first is the identity.

    Raises:
        CalibrationError: there are too few views or shared views, or the views are inconsistent.
    """
    count, views = corners_px.shape[:2]
    K, distortion, T_cam_board = np.empty((count, 3, 3)), np.empty((count, 2)), np.full((count, views, 4, 4), np.nan)
    for c, name in enumerate(names):
        K[c], distortion[c], T_cam_board[c] = _single_camera(name, sizes_px[c], corners_px[c], points_mm)
    # Reordering the corners rotates the board: with order s, T_cam_board becomes T_cam_board @ turns[s].
    turns = [_turn(points_mm, order) for order in symmetries]
    T_cam_world = _place_cameras(names, T_cam_board, turns)
    corners, T_world_board = corners_px.copy(), np.full((views, 4, 4), np.nan)
    for v in range(views):
        seen = [c for c in range(count) if np.isfinite(T_cam_board[c, v, 0, 0])]
        agreed: list[tuple[int, int]] = []
        for first in seen:  # use the board pose from the camera with which most other cameras agree
            T = se3_inverse(T_cam_world[first]) @ T_cam_board[first, v]
            found = [
                (c, s)
                for c in seen
                for s, turn in enumerate(turns)
                if _equal(T_cam_world[c] @ T, T_cam_board[c, v] @ turn)
            ]
            if len(found) > len(agreed):
                agreed, T_world_board[v] = found, T
        orders = dict(agreed)
        for c in seen:
            corners[c, v] = corners_px[c, v, symmetries[orders[c]]] if c in orders else np.nan
    return BoardCameras(K, distortion, T_cam_world, T_world_board, corners)


def _single_camera(
    name: str, size_px: tuple[int, int], corners_px: Array, points_mm: Array
) -> tuple[Array, Array, Array]:
    """Calibrate one camera (Zhang 2000, in OpenCV); return K (3, 3), k1 and k2, and T_cam_board (V, 4, 4)."""
    seen = np.isfinite(corners_px[..., 0])
    used = np.flatnonzero(seen.any(1))
    if len(used) < FEWEST_VIEWS:
        raise CalibrationError(
            f"the board is sharp in {len(used)} images; at least {FEWEST_VIEWS} are needed.",
            camera=name,
            hint="Film the board again: 40 poses at the position of the teeth, tilted up to 30 degrees, held still.",
        )
    objects = [points_mm[seen[v]].astype(np.float32) for v in used]
    pixels = [corners_px[v, seen[v]].astype(np.float32) for v in used]
    try:
        _, K, d, rotations, translations = cv2.calibrateCamera(
            objects, pixels, size_px, None, None, flags=_INTRINSIC_FLAGS
        )
    except cv2.error as error:
        raise CalibrationError(
            f"the views of the board do not determine the lens ({error.err}).",
            camera=name,
            hint="Tilt the board by up to 30 degrees in all directions; fronto-parallel views are not enough.",
        ) from error
    T = np.full((len(corners_px), 4, 4), np.nan)
    T[used] = make_transform(
        so3_exp(np.reshape(rotations, (-1, 3)).astype(np.float64)), np.reshape(translations, (-1, 3))
    )
    return K, np.ravel(d)[:2], T


def _turn(points_mm: Array, order: NDArray[np.int64]) -> Array:
    """Return the rotation R of the board about its centre for which points[order] = R points."""
    # The points are planar, so only the two axes in the plane are fitted; the normal stays fixed.
    plane = np.linalg.lstsq(points_mm[:, :2], points_mm[order, :2], rcond=None)[0].T
    R = np.eye(3)
    R[:2, :2] = np.round(plane)
    return make_transform(R, np.zeros(3))


def _equal(a: Array, b: Array) -> Mask:
    """Return whether poses (..., 4, 4) are equal within the tolerances, shape (...)."""
    angle = np.linalg.norm(so3_log(a[..., :3, :3] @ np.swapaxes(b[..., :3, :3], -1, -2)), axis=-1)
    apart = np.linalg.norm(a[..., :3, 3] - b[..., :3, 3], axis=-1)
    return (angle < _SAME_ANGLE_RAD) & (apart < _SAME_SHARE * np.linalg.norm(b[..., :3, 3], axis=-1))


def _place_cameras(names: tuple[str, ...], T_cam_board: Array, turns: list[Array]) -> Array:
    """Return T_cam_world (C, 4, 4), chained from the first camera along the camera pairs with most shared views."""
    seen = np.isfinite(T_cam_board[..., 0, 0])
    T_cam_world = np.full((len(names), 4, 4), np.nan)
    T_cam_world[0] = np.eye(4)
    placed, waiting = [0], list(range(1, len(names)))
    while waiting:
        shared = [((seen[a] & seen[b]).sum(), a, b) for a in placed for b in waiting]
        views, a, b = max(shared, key=lambda item: item[0])
        if views < FEWEST_VIEWS:
            raise CalibrationError(
                f"camera {names[b]} shares {views} sharp board views with {names[a]}; at least {FEWEST_VIEWS} are "
                "needed.",
                hint="Hold the board so that both cameras see the whole board, and start the board clips together.",
            )
        T_cam_world[b] = _relative_pose(names[a], names[b], T_cam_board[[a, b]], turns) @ T_cam_world[a]
        placed.append(b)
        waiting.remove(b)
    return T_cam_world


def _relative_pose(name_a: str, name_b: str, T_cam_board: Array, turns: list[Array]) -> Array:
    """Return the relative pose T_b_a that most shared views agree on, with the corners of each in any order."""
    both = np.isfinite(T_cam_board[..., 0, 0]).all(0)
    T_a, T_b = T_cam_board[0, both], T_cam_board[1, both]
    # Relative poses T_b_a for each corner order of camera b, shape (orders, views, 4, 4).
    candidates = np.stack([T_b @ turn @ se3_inverse(T_a) for turn in turns])
    flat = candidates.reshape(-1, 4, 4)
    # Whether views agree with candidates, shape (candidates, views).
    votes = _equal(flat[:, None, None], candidates[None]).any(1)
    support = votes.sum(1)
    best = int(np.argmax(support))
    if support[best] < _LEAST_AGREEMENT * both.sum():
        raise CalibrationError(
            f"the views of the board by {name_a} and {name_b} are inconsistent: at most {support[best]} of "
            f"{both.sum()} agree on the relative camera pose.",
            hint="The board clips must be synchronous frame by frame, and the cameras must not move.",
        )
    # Choose the most central among the poses that many views agree with.
    strong = flat[support >= 0.8 * support[best]]
    near = strong[_equal(strong, flat[best])]
    gap = np.linalg.norm(near[:, None, :3] - near[None, :, :3], axis=(-1, -2)).sum(1)
    return near[int(np.argmin(gap))]
