"""Sub-pixel refinement of mask borders to image edges."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Mask
from jawusd.segmentation.colours import SegmentationConfig, log_chroma

_EVEN = 1e-4  # variance added to the variance of the log colours [-], for errors of half an 8-bit step
_FEWEST = 100  # minimum number of pixels near the border for estimating the covariance of colours
ARCH_BLUR_PX = 0.8  # sigma of the blur that makes the coverage fractional at the border between the arches
_FAR_BLUR_PX = 2.0  # sigma of the blur that assigns tooth pixels far from both arches to the nearer arch


def refine_borders(
    shares: NDArray[np.float32], rgb: NDArray[np.uint8], config: SegmentationConfig, px_per_mm: float
) -> tuple[NDArray[np.float32], Mask]:
    """Return coverages (2, h, w) with soft borders, 0.5 at the outline, and a mask of visible borders, shape (h, w).

    Pixels along the border are reclassified by Fisher's discriminant between the local mean colours on both sides
    (local region statistics, Lankton & Tannenbaum 2008), since the midpoint between tooth and surrounding colour varies
    locally. Invisible borders are not moved; parts with hardly any visible border are discarded.
    """
    colours = _blurred(log_chroma(rgb), config.border_blur_px)
    band, window = config.border_band_mm * px_per_mm, 2 * round(config.border_side_mm * px_per_mm) + 1
    inside = signed_distance(shares.sum(0) > 0.5)
    sides = _compare_sides(inside, colours, window)
    if sides is None:
        return shares, np.zeros(rgb.shape[:2], bool)
    share, contrast = sides
    clear = contrast > config.border_contrast
    moved = clear & (np.abs(inside) < band)
    teeth = np.where(moved, np.clip(share, 0, 1), inside > 0).astype(np.float32)
    teeth[_spurious(teeth > 0.5, clear, config)] = 0.0
    near = [_blurred(arch, ARCH_BLUR_PX) for arch in shares]
    far = [_blurred(arch, _FAR_BLUR_PX) for arch in shares]
    upper, lower = np.where(near[0] + near[1] > 0.2, near, far)
    teeth = _blurred(teeth, config.border_blur_px)
    return teeth * np.stack([upper, lower]) / np.maximum(upper + lower, 1e-6), clear


def _blurred(image: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.float32)


def signed_distance(region: Mask) -> NDArray[np.float32]:
    """Return the signed distance to a region's outline, positive inside [px]; a large negative value if empty."""
    if not region.any():
        return np.full(region.shape, -1e3, np.float32)
    inner = cv2.distanceTransform(region.astype(np.uint8), cv2.DIST_L2, 5)
    return inner - cv2.distanceTransform((~region).astype(np.uint8), cv2.DIST_L2, 5)


def _compare_sides(
    inside: NDArray[np.float32], colours: NDArray[np.float32], window: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """Compare every pixel with the local mean colours on both sides of the border; None if one side is empty.

    Return the tooth coverage, 0.5 midway between the sides, and the separation of their colours in standard deviations,
    0 unless both sides are nearby; shape (h, w) each.
    """
    near = np.abs(inside) < window / 2
    sides = ((inside > 1) & near, (inside < -1) & near)
    means = [_mean_near(side, colours, window) for side in sides]
    rest = [(colours - mean)[side] for (mean, _), side in zip(means, sides, strict=True)]
    if min(map(len, rest)) < _FEWEST:
        return None
    precision = np.linalg.inv(np.cov(np.concatenate(rest).T) + _EVEN * np.eye(3)).astype(np.float32)
    (tooth, has_tooth), (other, has_other) = means
    apart = tooth - other
    direction = apart @ precision
    contrast = (direction * apart).sum(2)
    share = 0.5 + (direction * (colours - (tooth + other) / 2)).sum(2) / np.maximum(contrast, 1e-6)
    return share, np.where(has_tooth & has_other, np.sqrt(np.maximum(contrast, 0)), 0)


def _mean_near(side: Mask, colours: NDArray[np.float32], window: int) -> tuple[NDArray[np.float32], Mask]:
    """Return the local mean colour of one side at every pixel, and a mask of pixels with enough of this side nearby."""
    weight = side.astype(np.float32)
    count = cv2.boxFilter(weight, -1, (window, window), normalize=False)
    total = cv2.boxFilter(colours * weight[..., None], -1, (window, window), normalize=False)
    return np.asarray(total / np.maximum(count, 1)[..., None], np.float32), np.asarray(count >= window)


def _spurious(teeth: Mask, clear: Mask, config: SegmentationConfig) -> Mask:
    """Return a mask of specks and of parts with hardly any visible border, shape (h, w)."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats(teeth.astype(np.uint8))
    outline = teeth & (cv2.erode(teeth.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
    length = np.bincount(parts[outline], minlength=count)
    founded = np.bincount(parts[outline & clear], minlength=count)
    bad = (founded < config.founded_share * length) | (stats[:, cv2.CC_STAT_AREA] < config.speck_px)
    bad[0] = False
    return bad[parts]
