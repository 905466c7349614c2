"""Move, close and open the outlines of masks, smoothly and by fractions of a pixel."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask


def outside_px(mask: Mask) -> NDArray[np.float32]:
    """Return the signed distance of every pixel (h, w) from the outline of a mask [px], negative inside."""
    inside = mask.astype(np.uint8)
    if not inside.any():
        return np.full(mask.shape, np.inf, np.float32)
    away = cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5) - cv2.distanceTransform(inside, cv2.DIST_L2, 5)
    return np.asarray(away + np.where(mask, np.float32(0.5), np.float32(-0.5)), np.float32)


def blurred(values: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    """Return the Gaussian average of a picture (h, w)."""
    return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma_px), np.float32)


def closed(mask: Mask, width_px: float) -> Mask:
    """Return a mask with gaps up to a width filled (morphological closing by a disc)."""
    return _less(~_less(~mask, 0.5 * width_px), 0.5 * width_px)


def opened(mask: Mask, width_px: float) -> Mask:
    """Return a mask without parts narrower than a width (morphological opening by a disc)."""
    return ~_less(~_less(mask, 0.5 * width_px), 0.5 * width_px)


def _less(mask: Mask, radius_px: float) -> Mask:
    """Return a mask without what lies within a radius of its outline; the picture's border is none."""
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    return np.asarray(inside - 0.5 > radius_px)


def smooth_field(nodes: Array, cell_px: float, size_px: tuple[int, int]) -> NDArray[np.float32]:
    """Interpolate values at the nodes (rows, columns) of a grid to a picture of a width and height, by cubics."""
    height, width = int(np.ceil(nodes.shape[0] * cell_px)), int(np.ceil(nodes.shape[1] * cell_px))
    field = cv2.resize(nodes.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(field[: size_px[1], : size_px[0]], np.float32)


def enlarged(field: NDArray[np.float32], times: int) -> NDArray[np.float32]:
    """Return a smooth picture (h, w) with so many times more pixels along either side."""
    return np.asarray(cv2.resize(field, None, fx=times, fy=times, interpolation=cv2.INTER_LINEAR), np.float32)


def write_mask(path: str, mask: NDArray[np.uint8]) -> None:
    """Write a mask (h, w) as a PNG file.

    Raises:
        OSError: the file cannot be written.
    """
    cv2.imencode(".png", mask, (cv2.IMWRITE_PNG_COMPRESSION, 1))[1].tofile(path)
