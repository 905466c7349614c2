"""Undistort images and resample them to the working size of the tracker."""

from __future__ import annotations

from dataclasses import replace
from math import ceil
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.geometry.camera import Camera
from jawusd.media.pixels import ColourPicture, DecodedPicture, Slices

_NODE_PX = 16  # spacing of the map nodes by which the region of a mask is located


_Pixel = TypeVar("_Pixel", np.uint8, np.float32)


def remap(image: NDArray[_Pixel], positions: NDArray[np.float32]) -> NDArray[_Pixel]:
    """Sample an image bilinearly at positions (h, w, 2) [px]; samples outside the image are 0."""
    black = cv2.BORDER_CONSTANT
    found = cv2.remap(image, positions, None, cv2.INTER_LINEAR, borderMode=black)  # type: ignore[call-overload]  # no 2nd map
    return np.asarray(found, image.dtype)


def shrunk(image: NDArray[np.uint8], size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """Return an image reduced to a width and height [px]; each pixel is the mean of the area that it covers."""
    return np.asarray(cv2.resize(image, size_px, interpolation=cv2.INTER_AREA), np.uint8)


def _needed(picture: DecodedPicture, positions: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Convert only the bounding box of positions (h, w, 2) [px]; the rest is black and takes no memory."""
    sides = np.concatenate([positions[0], positions[-1], positions[:, 0], positions[:, -1]])
    limit = np.array(picture.shape[1::-1])
    low = np.clip(np.floor(sides.min(0)), 0, limit - 1).astype(int)
    high = np.clip(np.floor(sides.max(0)) + 2, low + 1, limit).astype(int)
    out = np.zeros(picture.shape, np.uint8)
    box = (slice(low[1], high[1]), slice(low[0], high[0]))
    out[box] = picture[box]
    return out


class WorkingView:
    """Undistort and downscale the images of one camera; thread-safe.

    A working pixel is the mean of n x n bilinear samples of the recorded image, at the distorted positions of the
    pixels of an n times larger working image; n is the downscaling factor, rounded up. Unlike undistortion at full size
    followed by area averaging, this interpolates once, and only where needed.

    Attributes:
        camera: the pinhole camera of the working images.
        source: the camera of the recorded images.
    """

    def __init__(self, source: Camera, size_px: tuple[int, int]) -> None:
        """Prepare the maps to working images of size_px (width, height).

        Raises:
            ValueError: the working size is larger than the recorded size, or empty.
        """
        if not (0 < size_px[0] <= source.size_px[0] and 0 < size_px[1] <= source.size_px[1]):
            raise ValueError(
                f"working size is {size_px} px; expected 1 x 1 px to the recorded size of {source.size_px} px"
            )
        self.source = source
        self.camera = replace(source.scaled(size_px), distortion=np.zeros(0))
        self._samples = ceil(max(source.size_px[0] / size_px[0], source.size_px[1] / size_px[1]))
        fine_size = (size_px[0] * self._samples, size_px[1] * self._samples)
        distortion = source.distortion if source.distortion.size else None
        maps = cv2.initUndistortRectifyMap(
            source.K, distortion, None, source.scaled(fine_size).K, fine_size, cv2.CV_32FC2
        )
        self._map = np.asarray(maps[0], np.float32)
        self._nodes = np.ascontiguousarray(np.moveaxis(self._map[::_NODE_PX, ::_NODE_PX], 2, 0))
        # Largest distance between adjacent nodes [px of the recorded image].
        steps = [np.abs(np.diff(self._nodes, axis=axis)).max(initial=_NODE_PX) for axis in (1, 2)]
        self._reach_px = float(max(steps)) + 1

    @classmethod
    def near(cls, source: Camera, point_world: Array, px_per_mm: float) -> tuple[WorkingView, float]:
        """Return the view with a given or the recorded resolution [px/mm] at a point (3,) [mm], and its resolution."""
        recorded = float(np.sqrt(source.K[0, 0] * source.K[1, 1]) / source.depth(point_world))
        scale = min(1.0, px_per_mm / recorded)
        width, height = (max(1, round(side * scale)) for side in source.size_px)
        return cls(source, (width, height)), recorded * scale

    def mask(self, mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the coverage of each working pixel, 255 = full, (h, w), from a recorded mask (H, W).

        Raises:
            ValueError: the mask does not have the size of the recorded images.
        """
        self._check(mask)
        width, height = self.camera.size_px
        out = np.zeros((height, width), np.uint8)
        window = self._window(mask)
        if window is not None:
            out[window] = self._averaged(mask, window)
        return out

    def picture(self, image: ColourPicture) -> NDArray[np.uint8]:
        """Return a recorded image, (H, W) or (H, W, 3), at the working size; black where nothing was recorded.

        Raises:
            ValueError: the image does not have the recorded size.
        """
        width, height = self.camera.size_px
        return self.part(image, (slice(0, height), slice(0, width)))

    def light(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return a recorded linear-light image (H, W, 3) undistorted at full size; 0 where nothing was recorded.

        Raises:
            ValueError: the image does not have the recorded size, or the working size is smaller.
        """
        if image.shape[1::-1] != self.source.size_px or self._map.shape[1::-1] != self.source.size_px:
            raise ValueError(
                f"linear-light image has shape {image.shape}; expected {self.source.size_px} px, the size of the view"
            )
        return remap(image, self._map)

    def part(self, image: ColourPicture, window: Slices) -> NDArray[np.uint8]:
        """Return a part of `picture`, given rows and columns inside it.

        Raises:
            ValueError: the image does not have the recorded size.
        """
        self._check(image)
        return self._averaged(image, window)

    def _check(self, image: ColourPicture) -> None:
        if image.shape[1::-1] != self.source.size_px or (isinstance(image, np.ndarray) and image.dtype != np.uint8):
            kind = getattr(image, "dtype", "")
            raise ValueError(f"image is {kind} of shape {image.shape}; expected uint8 of {self.source.size_px} px")

    def _averaged(self, image: ColourPicture, window: Slices) -> NDArray[np.uint8]:
        n, (rows, cols) = self._samples, window
        part = self._map[rows.start * n : rows.stop * n, cols.start * n : cols.stop * n]
        fine = remap(image if isinstance(image, np.ndarray) else _needed(image, part), part)
        return fine if n == 1 else shrunk(fine, (cols.stop - cols.start, rows.stop - rows.start))

    def _window(self, mask: NDArray[np.uint8]) -> Slices | None:
        """Return the window of working pixels that may sample a non-black mask pixel, or None if there are none."""
        rows = np.flatnonzero(mask.max(axis=1))
        if rows.size == 0:
            return None
        cols = np.flatnonzero(mask[rows[0] : rows[-1] + 1].max(axis=0))
        reach, (x, y) = np.float32(self._reach_px), self._nodes
        # On each side of the bounding box of the mask, at least one node lies outside the box but within reach, so the
        # cells around these nodes contain the box.
        across: Mask = (x >= cols[0] - reach) & (x <= cols[-1] + reach)
        inside: Mask = across & (y >= rows[0] - reach) & (y <= rows[-1] + reach)
        spans = []
        for hits, limit in zip((inside.any(axis=1), inside.any(axis=0)), self.camera.size_px[::-1]):
            where = np.flatnonzero(hits)
            if where.size == 0:
                return None
            first = int(where[0] - 1) * _NODE_PX // self._samples
            last = int(where[-1] + 1) * _NODE_PX // self._samples
            spans.append(slice(max(first, 0), min(last + 1, limit)))
        return spans[0], spans[1]


def warp_nearest(
    picture: NDArray[np.uint8] | NDArray[np.float32], to_picture: Array, out: NDArray[np.uint8] | NDArray[np.float32]
) -> None:
    """Resample an image (H, W) by nearest neighbour to `out` (h, w) of the same dtype; 0 outside the image.

    `to_picture` (2, 3) maps pixels of `out` to pixels of `picture`.
    """
    cv2.warpAffine(picture, to_picture, out.shape[::-1], out, cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)
