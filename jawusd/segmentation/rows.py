"""Find both dental arches in an image without prior knowledge, to initialise a search.

Teeth are brighter and less red than their surroundings; the gap between the arches of an open mouth is dark or red.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from jawusd.base.arrays import Array, Mask

_WIDTH_PX = 480  # image width at which teeth are searched for
# Teeth are found by thresholding lightness minus redness, CIELAB L* - 2.5 a*: weight of a*, candidate thresholds as
# percentiles of the image, and the percentile that counts as white.
_REDNESS, _LEVELS, _BRIGHTEST = 2.5, (40, 55, 65, 72, 78, 83, 87, 90, 92, 94, 96), 99.5
# Minimum fraction of the surroundings that is redder or darker than the teeth; minimum difference of a* to count as
# redder, and maximum ratio of brightness to count as darker.
_UNLIKE, _REDDER, _DARKER = 0.6, 3.0, 0.3
_LEAST_AREA, _MOST_AREA = 0.0015, 0.2  # minimum and maximum fraction of the image covered by teeth
# radius of the morphological closing; inner and outer distance of the ring that samples the surroundings of teeth
_CLOSE_PX, _NEAR_PX, _FAR_PX = 4, 3, 12
# Maximum distance between the arches along and across their columns, in widths of the one found first; wide-open
# mouths need this much from the side, where arches look narrow. Minimum area of a part relative to an arch; minimum
# brightness and contrast of a part relative to the teeth found first, above those of wet lips and chins.
_ROWS_APART, _ROWS_ASIDE, _LEAST_PART, _AS_BRIGHT, _LIKE = 1.6, 0.4, 0.02, 0.65, 0.5
# Candidate lines between the arches: tilts relative to half the width, sags relative to the height, and minimum
# fraction of the tooth pixels on each side.
_TILTS, _SAGS, _LEAST_SHARE = np.linspace(-0.3, 0.3, 21), np.linspace(-0.4, 0.4, 13), 0.2
_LINE_PX = (-1, 0, 1)  # offsets from a line of the pixel rows that are averaged to test for a gap


@dataclass(frozen=True, eq=False)
class Rows:
    """Both dental arches in an image."""

    masks: NDArray[np.uint8]  # upper and lower arch, 0 or 255, shape (2, H, W)
    # fraction of the line between the arches that crosses teeth instead of a gap, 0 .. 1; 0 if they do not touch
    bridged: float


def tooth_rows(rgb: NDArray[np.uint8], turns: int = 0) -> Rows | None:
    """Return the dental arches in an RGB image (H, W, 3) of a roughly upright head; None if no teeth are found.

    `turns` is the number of counter-clockwise quarter turns that make the image upright.
    """
    found = _upright_rows(np.ascontiguousarray(np.rot90(rgb, turns)))
    return found and Rows(np.ascontiguousarray(np.rot90(found.masks, -turns, axes=(1, 2))), found.bridged)


def _upright_rows(rgb: NDArray[np.uint8]) -> Rows | None:
    height, width = rgb.shape[:2]
    small = cv2.resize(rgb, (_WIDTH_PX, max(8, round(height * _WIDTH_PX / width))), interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(small, (0, 0), 1.0).astype(np.float32)
    smooth = np.minimum(smooth / max(float(np.percentile(smooth, _BRIGHTEST)), 1.0), 1.0)
    lab = np.asarray(cv2.cvtColor(smooth, cv2.COLOR_RGB2LAB), np.float64)
    redness, toothlike = lab[..., 1], lab[..., 0] - _REDNESS * lab[..., 1]
    found = _teeth(toothlike, redness)
    if found is None:
        return None
    teeth, level = found
    usual = float(np.median(toothlike[teeth]))
    split = _split(teeth, np.clip((toothlike - level) / max(usual - level, 1.0), 0.0, 1.0))
    if split is None:
        return None
    rows, bridged = split
    shapes = [cv2.resize(255 * row.astype(np.uint8), (width, height), interpolation=cv2.INTER_LINEAR) for row in rows]
    return Rows(np.where(np.stack(shapes) > 127, 255, 0).astype(np.uint8), bridged)


def _teeth(toothlike: Array, redness: Array) -> tuple[Mask, float] | None:
    """Return a mask of the teeth, and the threshold that separates them."""
    best: tuple[float, float, float, Mask] | None = None
    for level in np.percentile(toothlike, _LEVELS).tolist():
        above = ndimage.binary_opening(toothlike > level, np.ones((2, 2)))
        groups, count = ndimage.label(_closed(above))
        areas = np.bincount(groups.ravel(), minlength=count + 1)
        fair = (areas > _LEAST_AREA * groups.size) & (areas < _MOST_AREA * groups.size)
        fair[[0, *_at_border(groups)]] = False
        boxes = ndimage.find_objects(groups)
        for number in np.flatnonzero(fair).tolist():
            inside, outside = _group_contrast(groups, number, boxes[number - 1], above, toothlike, redness)
            worth = (inside - outside) ** 2 * np.sqrt(areas[number])
            if worth > (0.0 if best is None else best[0]):
                best = worth, inside, outside, groups == number
    if best is None:
        return None
    _, inside, outside, group = best
    # threshold midway between teeth and surroundings, since highlights on lips are brighter than the surroundings
    level = (inside + outside) / 2
    parts, count = ndimage.label(toothlike > level)
    like = ndimage.median(toothlike, parts, np.arange(count + 1)) > outside + _AS_BRIGHT * (inside - outside)
    own = np.bincount(parts.ravel(), group.ravel(), count + 1) > 0.5 * np.bincount(parts.ravel())
    boxes = ndimage.find_objects(parts)

    def stands_out(number: int) -> float:
        inside, outside = _group_contrast(parts, number, boxes[number - 1], parts > 0, toothlike, redness)
        return inside - outside

    kept = [
        number
        for number in _parts_near(parts, group)
        if like[number] and (own[number] or stands_out(number) > _LIKE * (inside - outside))
    ]
    return (np.isin(parts, kept), level) if kept else None


def _distance(away: Mask) -> NDArray[np.float32]:
    """Return the city-block distance of every pixel from the nearest false pixel of `away` [px]."""
    return np.asarray(cv2.distanceTransform(away.astype(np.uint8), cv2.DIST_L1, 3), np.float32)


def _closed(mask: Mask) -> Mask:
    """Return a mask with its small gaps filled; pixels outside the image count as background."""
    grown = np.pad(_distance(~mask) <= _CLOSE_PX, 1)
    return (_distance(grown) > _CLOSE_PX)[1:-1, 1:-1]


def _at_border(groups: NDArray[np.int32]) -> list[int]:
    return np.unique(np.concatenate([groups[0], groups[-1], groups[:, 0], groups[:, -1]])).tolist()


def _group_contrast(
    groups: NDArray[np.int32],
    number: int,
    box: tuple[slice[int, int, None], slice[int, int, None]],
    above: Mask,
    toothlike: Array,
    redness: Array,
) -> tuple[float, float]:
    """Return the brightness of teeth and of their surroundings; zeros if the surroundings are not redder or darker."""
    rows, columns = box
    around = (
        slice(max(rows.start - _FAR_PX, 0), rows.stop + _FAR_PX),
        slice(max(columns.start - _FAR_PX, 0), columns.stop + _FAR_PX),
    )
    group = groups[around] == number
    own = group & above[around]
    away = _distance(~group)
    ring = (away <= _FAR_PX) & (away > _NEAR_PX)
    if not own.any() or not ring.any():
        return 0.0, 0.0
    inside = float(np.median(toothlike[around][own]))
    unlike = redness[around][ring] > np.median(redness[around][own]) + _REDDER
    unlike |= toothlike[around][ring] < _DARKER * inside
    return (inside, float(np.percentile(toothlike[around][ring], 80))) if unlike.mean() > _UNLIKE else (0.0, 0.0)


def _parts_near(parts: NDArray[np.int32], group: Mask) -> list[int]:
    """Return the labels of the parts near a group of teeth whose size and position are those of teeth."""
    rows, columns = np.nonzero(group)
    width = np.ptp(columns) + 1
    apart, aside = int(_ROWS_APART * width), int(_ROWS_ASIDE * width)
    around = np.zeros(parts.shape, bool)
    across = np.s_[max(columns.min() - aside, 0) : columns.max() + aside + 1]
    around[max(rows.min() - apart, 0) : rows.max() + apart, across] = True
    areas = np.bincount(parts.ravel())
    inside = np.bincount(parts.ravel(), around.ravel(), len(areas))
    kept = (inside > 0.8 * areas) & (areas > _LEAST_PART * ((parts > 0) & group).sum())
    kept[[0, *_at_border(parts)]] = False
    return np.flatnonzero(kept).tolist()


def _split(teeth: Mask, bright: Array) -> tuple[NDArray[np.bool_], float] | None:
    """Split teeth into upper and lower arch (2, h, w) at the line with the lowest bridged fraction; return both."""
    rows, columns = np.nonzero(teeth)
    first, last, top, bottom = columns.min(), columns.max(), rows.min(), rows.max()
    lines = top + _lines(int(last - first + 1), int(bottom - top + 1))  # pixel row at each column, shape (N, width)
    np.clip(lines, 1, len(teeth) - 2, out=lines)
    across = np.arange(first, last + 1)
    taken = teeth[:, across].any(0)
    upper = np.cumsum(teeth[:, across], axis=0)
    share = upper[lines, np.arange(len(across))].sum(1) / upper[-1].sum()
    fair = np.flatnonzero((share > _LEAST_SHARE) & (share < 1 - _LEAST_SHARE))
    if not len(fair):
        return None
    lines = lines[fair]
    near = np.mean([np.roll(bright, -k, axis=0) for k in _LINE_PX], axis=0)  # mean over pixel rows around each pixel
    bridged = near[lines[:, taken], across[taken]].mean(1)
    best = int(bridged.argmin())
    below = np.zeros(teeth.shape, bool)
    below[:, across] = np.arange(len(teeth))[:, None] > lines[best]
    return np.stack([teeth & ~below, teeth & below]), float(bridged[best])


@lru_cache(maxsize=8)
def _lines(width: int, height: int) -> NDArray[np.int64]:
    """Return candidate lines across a box, each as the pixel row at every column, shape (N, width)."""
    place = np.linspace(-1.0, 1.0, width)
    middles = np.arange(0.15 * height, 0.9 * height, 1.0)
    middle, tilt, sag = (grid.reshape(-1, 1) for grid in np.meshgrid(middles, _TILTS * width / 2, _SAGS * height))
    return np.rint(middle + tilt * place + sag * place**2).astype(np.int64)
