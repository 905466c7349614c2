"""Find which values of mask pictures mean background and which mean teeth, from their content, once per take."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from jawusd.base.arrays import Array
from jawusd.media.mask_levels import MOST_GRAY, MaskLevels, RawImage, border_share, channel, spread_of_colours

_NEAR = 24  # of 255: values this near to one another are one level, blurred or coded with loss
_FLAT = 10  # of 255: pixels that differ less from their neighbours lie inside a region, not on its edge
_ALIKE = 0.15  # of the contrast: how far the levels of two pictures of one source may differ
_MOST_THIRD = 0.25  # area of a third level over that of the smaller of the other two; soft edges are not flat
_SHARP = 0.8  # of its area within one step of a level's value: labels, but not the smooth parts of a photograph


class NotMasks(Exception):
    """Pictures are not masks: `reason` says what they hold, `hint` what to do, `index` which one shows it, if one."""

    def __init__(self, index: int | None, reason: str, hint: str) -> None:
        """Take the number of a picture within those given, None for all of them."""
        super().__init__(reason)
        self.index, self.reason, self.hint = index, reason, hint


@dataclass(frozen=True)
class _Levels:
    """Hold the two levels of one channel of a picture and where they lie."""

    low: float
    high: float
    light: float  # share of the picture nearer to the high level
    light_border: float  # the same along its border
    gray: float  # share of the picture that is neither
    soft: float  # share of what is not dark that is neither, if light is teeth
    soft_dark: float  # the same of what is not light, if dark is teeth
    third: float | None  # a further level that has much area

    @property
    def contrast(self) -> float:
        return self.high - self.low


@dataclass(frozen=True)
class _Looked:
    """Hold what one picture shows in each of its channels that are not of one value."""

    number: int  # within those looked at
    planes: dict[str, _Levels]
    opaque: bool  # has an alpha channel, which cuts nothing out
    deep: bool


def find_levels(pictures: Iterable[RawImage], lossy: bool, more: Callable[[], Iterable[RawImage]]) -> MaskLevels | None:
    """Return what the values of a source mean, None if none of its pictures shows anything.

    The two levels are those that most pictures agree on. The background is the darker one, unless the lighter one has
    most of the area and of the border: teeth lie amid the picture.

    Args:
        pictures: some, from the whole take.
        lossy: coded with loss.
        more: gives all others, which are looked at if those show nothing.

    Raises:
        NotMasks: most pictures that show something are no masks, or have more than two levels.
    """
    looked = [_looked(k, image) for k, image in enumerate(pictures)]
    shown = _shown(looked)
    if not shown:
        looked += [_looked(k, image) for k, image in enumerate(more(), start=len(looked))]
        shown = _shown(looked)
    if shown:
        return _agreed(shown, lossy)
    if any(one.planes for one in looked):
        raise NotMasks(
            None,
            f"the alpha channel is opaque in all {len(looked)} pictures: nothing is cut out.",
            "Export the matte itself, in black and white, or colour with its alpha (in After Effects: RGB + Alpha).",
        )
    return None


def _shown(looked: Sequence[_Looked]) -> list[_Looked]:
    """Return the pictures that show something; programs write opaque photographs for frames that have no mask."""
    if any("alpha" in one.planes for one in looked):
        return [one for one in looked if "alpha" in one.planes]
    return [one for one in looked if one.planes and not (one.opaque and one.planes["brightest"].gray > MOST_GRAY)]


def _agreed(shown: Sequence[_Looked], lossy: bool) -> MaskLevels:
    plane = _telling_plane(shown)
    found = [(one.number, one.planes[plane]) for one in shown if plane in one.planes]
    thirds = [(number, levels) for number, levels in found if levels.third is not None]
    if 2 * len(thirds) > len(found):
        number, levels = thirds[0]
        values = sorted({levels.low, levels.high, levels.third or 0.0})
        raise NotMasks(
            number,
            f"it holds the levels {', '.join(f'{value:g}' for value in values)}; a mask has two, background and teeth.",
            "Export one mask per row of teeth; or name one file for both rows as masks.labels, with upper_value and "
            "lower_value.",
        )
    masks = [(number, levels) for number, levels in found if levels.gray <= MOST_GRAY]
    if 2 * len(masks) < len(found):
        number, levels = next((n, levels) for n, levels in found if levels.gray > MOST_GRAY)
        raise NotMasks(
            number,
            f"{levels.gray:.0%} of it are gray, which is no mask: white is tooth and black is not.",
            "Check that `masks` in capture.toml names the masks and not the footage.",
        )
    alike = max(([m for m in masks if _alike(m[1], of[1], lossy)] for of in masks), key=len)
    low, high = (float(np.median([getattr(levels, end) for _, levels in alike])) for end in ("low", "high"))
    light = [float(np.mean([getattr(levels, of) for _, levels in alike])) > 0.5 for of in ("light", "light_border")]
    background, teeth = (high, low) if all(light) else (low, high)
    soft = float(np.median([levels.soft if teeth > background else levels.soft_dark for _, levels in alike]))
    return MaskLevels(plane, background, teeth, shown[0].deep, lossy, light[0] != light[1], soft)


def _alike(levels: _Levels, of: _Levels, lossy: bool) -> bool:
    if lossy and of.contrast <= _NEAR < levels.contrast:
        return False  # noise of an empty picture
    near = _ALIKE * of.contrast
    return abs(levels.low - of.low) <= near and abs(levels.high - of.high) <= near


def _telling_plane(shown: Sequence[_Looked]) -> str:
    """Return the channel with the greatest contrast; alpha if there is any."""
    totals: dict[str, float] = {}
    for one in shown:
        for plane, levels in one.planes.items():
            totals[plane] = totals.get(plane, 0.0) + levels.contrast
    return "alpha" if "alpha" in totals else max(totals, key=lambda plane: totals[plane])


def _looked(number: int, image: RawImage) -> _Looked:
    planes = ["brightest"]
    has_alpha = image.ndim == 3 and image.shape[2] == 4
    if image.ndim == 3 and spread_of_colours(image) > 0:
        planes += ["darkest", "0", "1", "2"]
    if has_alpha:
        planes.append("alpha")
    found = {plane: levels for plane in planes if (levels := _levels(channel(image, plane))) is not None}
    opaque = has_alpha and "alpha" not in found and bool(image[..., 3].min() == np.iinfo(image.dtype).max)
    return _Looked(number, found, opaque, image.dtype == np.uint16)


def _levels(plane: RawImage) -> _Levels | None:
    """Return the levels of one channel, None if it has one value."""
    low, high, _, _ = cv2.minMaxLoc(plane)
    if low == high:
        return None
    span = high - low
    if plane.dtype == np.uint8:
        values = np.clip((np.arange(256) - low) * (255 / span), 0, 255)
        unit = np.asarray(cv2.LUT(plane, np.round(values).astype(np.uint8)), np.uint8)
    else:
        unit = np.asarray(cv2.convertScaleAbs(plane, alpha=255 / span, beta=-low * 255 / span), np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    uneven = cv2.subtract(cv2.dilate(unit, kernel), cv2.erode(unit, kernel))
    counts = cv2.calcHist([unit], [0], cv2.inRange(uneven, 0, _FLAT), [256], [0, 256]).ravel().astype(np.float64)
    first, _, rest = _peak(counts)
    second, area, rest = _peak(rest)
    if not area:  # too small to have an inside
        second = 255 if first < 128 else 0
    third, third_area, _ = _peak(rest)
    dark, light = sorted((first, second))
    middle, reach = (dark + light) / 2, (light - dark) / 10
    at_dark, at_light = (
        cv2.countNonZero(cv2.inRange(unit, int(np.ceil(of - reach)), int(of + reach))) for of in (dark, light)
    )
    gray = unit.size - at_dark - at_light
    sharp = counts[max(third - 1, 0) : third + 2].sum() > _SHARP * third_area
    much = sharp and third_area > _MOST_THIRD * area > 0
    return _Levels(
        float(round(low + dark * span / 255)),
        float(round(low + light * span / 255)),
        cv2.countNonZero(cv2.inRange(unit, int(middle) + 1, 255)) / unit.size,
        border_share(unit, middle),
        gray / unit.size,
        gray / max(gray + at_light, 1),
        gray / max(gray + at_dark, 1),
        float(round(low + third * span / 255)) if much else None,
    )


def _peak(counts: Array) -> tuple[int, float, Array]:
    """Return the most frequent of 256 values, how often it or its neighbours occur, and the counts without them."""
    at = int(counts.argmax())
    near = slice(max(at - _NEAR, 0), at + _NEAR + 1)
    rest = counts.copy()
    rest[near] = 0.0
    return at, float(counts[near].sum()), rest
