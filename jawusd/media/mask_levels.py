"""Convert images to masks; the channel and the values of background and teeth are found once per take."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.media.pixels import Slices

MaskImage = NDArray[np.uint8]
RawImage = NDArray[np.uint8] | NDArray[np.uint16]  # image as stored in a file

# Maximum fraction of a mask's pixels that have intermediate values. Blurred edges cause up to 0.2 in small masks;
# photographs have 0.39 or more.
MOST_GRAY = 0.2
MOST_SOFT = 0.35  # maximum median fraction of intermediate values outside the background; reached by a blur of 8 px
_FAINT = 0.25  # maximum coverage of a pixel, due to noise, in an image without teeth
_DEAD_ZONE = 0.06  # maximum deviation from a level caused by lossy coding, as a fraction of the contrast
_NEAR = 24  # Maximum difference [of 255] between values of one level after blur or lossy coding.
_FLAT = 10  # Maximum difference [of 255] between adjacent pixels inside a region; edges have larger differences.
_ALIKE = 0.15  # maximum difference of one level between images of a source, as a fraction of the contrast
# Maximum flat area of a third level relative to that of the second-largest level; soft edges have no flat area.
_MOST_THIRD = 0.25
# A third gray level counts as a label if at least this fraction of its pixels lie within 1 of its value; the fraction
# is smaller in photographs.
_SHARP = 0.8


@dataclass(frozen=True)
class MaskLevels:
    """Rule that converts the images of one source to coverage.

    `plane` is the channel that separates teeth from background: "alpha", the "brightest" or "darkest" colour, or the
    index of a colour.
    """

    plane: str = "brightest"
    background: float = 0.0
    teeth: float = 255.0
    deep: bool = False  # whether images have 16 bits per channel
    lossy: bool = False  # whether lossy coding has caused noise around the levels
    ambiguous: bool = False  # whether border and area indicate different background levels
    # Fraction of the pixels outside the background whose values lie between the two levels.
    soft: float = field(default=0.0, compare=False)

    @property
    def usual(self) -> bool:
        """Whether black is background and full white is teeth."""
        white = 65535.0 if self.deep else 255.0
        near = _DEAD_ZONE * white if self.lossy else 0.0
        return abs(self.background) <= near and abs(self.teeth - white) <= near

    @property
    def inverted(self) -> bool:
        """Whether teeth are darker than the background."""
        return self.teeth < self.background

    def coverage(self, image: RawImage) -> tuple[MaskImage | None, str]:
        """Return the mask of an image (0 to 255, outline at half), or None; and the reason why it is rejected.

        The reason is a predicate whose subject is the image, "" for masks and empty images. The mask may be the input
        itself.
        """
        if (image.dtype == np.uint16) != self.deep:
            return None, f"has {8 * image.dtype.itemsize} bits per channel, unlike other images"
        plane = channel(image, self.plane)
        low, high, _, _ = cv2.minMaxLoc(plane)
        if low == high:
            empty = self.plane == "alpha" or abs(low - self.teeth) > abs(low - self.background)
            return None, "" if empty else f"is uniformly {low:g}, the value of teeth"
        box = self._around_teeth(plane)  # crop, usually to a tenth of the image, to save time
        part = self._shares(plane[box])
        inside = cv2.countNonZero(cv2.inRange(part, 128, 255))
        if inside == 0:
            brightest = low if self.inverted else high
            faint = int(part.max()) <= 255 * _FAINT
            return None, "" if faint else f"reaches only {brightest:g}, but teeth are {self.teeth:g} in other images"
        if (gray := cv2.countNonZero(cv2.inRange(part, 26, 229)) / plane.size) > MOST_GRAY:
            return None, f"is not a mask: {gray:.0%} of its pixels are neither teeth nor background"
        mask = part if part.shape == plane.shape else self._placed(part, box, plane)
        if inside > mask.size / 2 and border_share(mask, 127.5) > 0.5:
            return (
                None,
                f"shows teeth in {inside / mask.size:.0%} of its area, up to the border: it seems inverted, unlike "
                "other images",
            )
        return mask, ""

    def _around_teeth(self, plane: RawImage) -> Slices:
        """Return the bounding box of all pixels of a channel that are not background; at least one pixel."""

        def seen(part: RawImage, axis: int) -> list[int]:
            most = part.min(axis) if self.inverted else part.max(axis)
            return np.flatnonzero(self._table[most]).tolist()

        rows = seen(plane, 1)
        if not rows:
            return slice(0, 1, 1), slice(0, 1, 1)
        band = slice(rows[0], rows[-1] + 1, 1)
        columns = seen(plane[band], 0)
        return band, slice(columns[0], columns[-1] + 1, 1)

    def _shares(self, part: RawImage) -> MaskImage:
        """Convert the pixels of a channel to coverage, 0 to 255."""
        if part.dtype != np.uint8:
            return self._table[part]
        return cast(MaskImage, part if self._as_stored else cv2.LUT(part, self._table))

    def _placed(self, part: MaskImage, box: Slices, plane: RawImage) -> MaskImage:
        if self._as_stored:
            return cast(MaskImage, plane)
        mask = np.zeros(plane.shape, np.uint8)
        mask[box] = part
        return mask

    @cached_property
    def _as_stored(self) -> bool:
        """Whether 8-bit pixels need no conversion to coverage."""
        return not self.deep and bool((self._table == np.arange(256)).all())

    @cached_property
    def _table(self) -> NDArray[np.uint8]:
        values = np.arange(65536 if self.deep else 256)
        share = np.clip((values - self.background) / (self.teeth - self.background), 0.0, 1.0)
        if self.lossy:
            share[share < _DEAD_ZONE] = 0.0
            share[share > 1 - _DEAD_ZONE] = 1.0
        return np.round(255 * share).astype(np.uint8)


def channel(image: RawImage, plane: str) -> RawImage:
    """Return one channel (h, w) of an image; see `MaskLevels.plane`."""
    if image.ndim == 2:
        return image
    parts = cv2.split(image)
    if plane == "brightest":
        found = cv2.max(cv2.max(parts[0], parts[1]), parts[2])
    elif plane == "darkest":
        found = cv2.min(cv2.min(parts[0], parts[1]), parts[2])
    else:
        found = parts[3 if plane == "alpha" else int(plane)]
    return cast(RawImage, found)


def spread_of_colours(image: RawImage) -> float:
    """Return the largest difference between the channels of a pixel in an image (h, w, 3 or 4)."""
    return float(cv2.minMaxLoc(cv2.subtract(channel(image, "brightest"), channel(image, "darkest")))[1])


def border_share(image: MaskImage, above: float) -> float:
    """Return the fraction of an image's outermost pixels that exceed a value."""
    return float((np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]]) > above).mean())


class NotMasks(Exception):
    """Raised if images are not masks; `index` is the index of the offending image if there is only one."""

    def __init__(self, index: int | None, reason: str, hint: str) -> None:
        """Store the index of the offending image, None if all images are concerned."""
        super().__init__(reason)
        self.index, self.reason, self.hint = index, reason, hint


@dataclass(frozen=True)
class _Levels:
    """The two gray levels of one channel of an image, and their distribution."""

    low: float
    high: float
    light: float  # fraction of the pixels that are closer to the high level
    light_border: float  # fraction of the border pixels that are closer to the high level
    gray: float  # Fraction of the pixels that are at neither level.
    soft: float  # The same fraction among pixels that are not dark; the softness if teeth are light.
    soft_dark: float  # fraction at neither level among pixels that are not light; the softness if teeth are dark
    third: float | None  # third level with a large area, if there is one

    @property
    def contrast(self) -> float:
        return self.high - self.low


@dataclass(frozen=True)
class _Looked:
    """Gray levels of each non-uniform channel of one sampled image."""

    number: int  # index of the image among the sampled images
    planes: dict[str, _Levels]
    opaque: bool  # whether the image has an opaque alpha channel
    deep: bool


def find_levels(pictures: Iterable[RawImage], lossy: bool, more: Callable[[], Iterable[RawImage]]) -> MaskLevels | None:
    """Return the meaning of the pixel values of a mask source, or None if all images are empty.

    The two levels are those that most images have in common. The background is the darker level, unless the lighter
    level covers most of the area and of the border, since teeth are inside the image.

    `pictures` are sampled from the whole take; `more` returns all other images, and is called if the samples are empty.

    Raises:
        NotMasks: most of the non-empty images are not masks, or have more than two levels.
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
            f"the alpha channel is opaque in all {len(looked)} images: nothing is masked.",
            "Export the matte in black and white, or colour with alpha (in After Effects: RGB + Alpha).",
        )
    return None


def _shown(looked: Sequence[_Looked]) -> list[_Looked]:
    """Return the images with a mask; some programs write opaque photographs for frames without a mask."""
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
            f"it has the levels {', '.join(f'{value:g}' for value in values)}; expected two levels, background and "
            "teeth.",
            "Export one mask per arch, or name one file for both arches as masks.labels, with upper_value and "
            "lower_value.",
        )
    masks = [(number, levels) for number, levels in found if levels.gray <= MOST_GRAY]
    if 2 * len(masks) < len(found):
        number, levels = next((n, levels) for n, levels in found if levels.gray > MOST_GRAY)
        raise NotMasks(
            number,
            f"{levels.gray:.0%} of its pixels are gray; in a mask, teeth are white and the background is black.",
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
        return False  # an image that is empty except for noise
    near = _ALIKE * of.contrast
    return abs(levels.low - of.low) <= near and abs(levels.high - of.high) <= near


def _telling_plane(shown: Sequence[_Looked]) -> str:
    """Return the channel with the highest contrast, or the alpha channel if it is present."""
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
    """Return the levels of one channel, or None if the channel is uniform."""
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
    if not area:  # teeth that are too small to have flat regions
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
    """Return the most frequent of 256 values, its count including adjacent values, and the remaining histogram."""
    at = int(counts.argmax())
    near = slice(max(at - _NEAR, 0), at + _NEAR + 1)
    rest = counts.copy()
    rest[near] = 0.0
    return at, float(counts[near].sum()), rest
