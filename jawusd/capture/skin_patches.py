"""Working images of the skin, and correlation and tracking of their patches."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.geometry import Camera, se3_inverse, transform_point
from jawusd.media.pixels import ColourPicture
from jawusd.media.working_view import WorkingView

Gray = NDArray[np.uint8]

_PX_PER_MM = 6.0  # maximum working resolution; texture finer than pores is not needed
_WINDOW_MM, _LEVELS = 5.0, 3  # side of the patch around a point, and levels of the pyramid above the working image
_LEAST_SIDE_PX = 13
_BACK_PX = 0.7  # maximum forward-backward error of a tracked point


@dataclass(frozen=True, eq=False)
class SkinView:
    """One camera's working images: undistorted and gray."""

    camera: Camera  # the pinhole camera of the working images
    side_px: int  # side of the patch around a point
    px_per_mm: float  # resolution at the mouth
    _working: WorkingView

    @classmethod
    def of(cls, source: Camera, mouth_world: Array) -> SkinView:
        """Choose the working size by the resolution at the mouth, at a world point (3,) [mm]."""
        working, px_per_mm = WorkingView.near(source, mouth_world, _PX_PER_MM)
        side = max(_LEAST_SIDE_PX, 2 * round(_WINDOW_MM * px_per_mm / 2) + 1)
        return cls(working.camera, side, px_per_mm, working)

    def picture(self, image: ColourPicture) -> Gray:
        """Return the working image (h, w) of a recorded RGB image (H, W, 3)."""
        return np.asarray(cv2.cvtColor(self._working.picture(image), cv2.COLOR_RGB2GRAY), np.uint8)


def followed(
    before: Gray, after: Gray, points: Array, side_px: int, guess: Array | None = None, levels: int = _LEVELS
) -> tuple[Array, Mask]:
    """Follow points (N, 2) [px] from one image to another, near a guess (N, 2), by default where they were, and back.

    Return positions (N, 2) [px], and which points (N,) come back to where they started.
    """
    if not len(points):
        return points.copy(), np.zeros(0, bool)
    start = points.astype(np.float32)[:, None]
    there = (points if guess is None else guess).astype(np.float32)[:, None]
    found, good = _flow(before, after, start, there, side_px, levels)
    back, also = _flow(after, before, found, found - (there - start), side_px, levels)
    ok = good & also & (np.linalg.norm(back - start, axis=2)[:, 0] <= _BACK_PX)
    return np.asarray(found[:, 0], np.float64), ok


def _flow(
    before: Gray, after: Gray, points: NDArray[np.float32], guess: NDArray[np.float32], side_px: int, levels: int
) -> tuple[NDArray[np.float32], Mask]:
    """Return where points (N, 1, 2) are found in the other image, and which are found, (N,)."""
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        before,
        after,
        points,
        guess.copy(),
        winSize=(side_px, side_px),
        maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(found, np.float32), np.asarray(status[:, 0] == 1)


def alike(one: Gray, other: Gray, points: Array, moved: Array, side_px: int) -> Array:
    """Return the normalised correlation (N,) of patches around points (N, 2) of one image and (N, 2) of another."""
    out = np.zeros(len(points))
    for k, (p, q) in enumerate(zip(points.astype(np.float32), moved.astype(np.float32))):
        a = cv2.getRectSubPix(one, (side_px, side_px), p.tolist()).astype(np.float32)
        b = cv2.getRectSubPix(other, (side_px, side_px), q.tolist()).astype(np.float32)
        a, b = a - a.mean(), b - b.mean()
        out[k] = float((a * b).sum() / (np.linalg.norm(a) * np.linalg.norm(b) + 1e-6))
    return out


class Patches:
    """The patches around all pixels of an image, for comparison with those of another image."""

    def __init__(self, image: Gray, side_px: int) -> None:
        self._side, self._image = (side_px, side_px), image.astype(np.float32)
        self._mean, self._spread = self._moments(self._image)

    def _moments(self, image: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        mean = np.asarray(cv2.boxFilter(image, -1, self._side), np.float32)
        square = np.asarray(cv2.boxFilter(image * image, -1, self._side), np.float32)
        return mean, np.sqrt(np.maximum(square - mean * mean, 1.0))

    def correlation(self, other: Gray) -> NDArray[np.float32]:
        """Return the normalised correlation with the patches at the same pixels of another image, shape (h, w)."""
        second = other.astype(np.float32)
        mean, spread = self._moments(second)
        both = np.asarray(cv2.boxFilter(self._image * second, -1, self._side), np.float32)
        return (both - self._mean * mean) / (self._spread * spread)


def warped(image: Gray, H: Array, shape: tuple[int, ...]) -> Gray:
    """Resample an image to a shape (h, w) by a homography (3, 3) from pixels of the result to the image."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpPerspective(image, H, (shape[1], shape[0]), flags=flags), np.uint8)


def homography(camera: Camera, other: Camera, T_world_mouth: Array, normal: Array, front_mm: float) -> Array:
    """Return the homography (3, 3) from one pinhole camera to another that a plane in front of the mouth induces."""
    T = camera.T_cam_world @ T_world_mouth
    n = T[:3, :3] @ normal
    distance = float(n @ transform_point(T, np.array([0.0, 0.0, front_mm])))
    between = other.T_cam_world @ se3_inverse(camera.T_cam_world)
    H = other.K @ (between[:3, :3] + np.outer(between[:3, 3], n) / distance) @ np.linalg.inv(camera.K)
    return np.asarray(H / H[2, 2], np.float64)
