"""How pictures become masks: which channel and values mean background and which mean teeth."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.media.pixels import Slices

MaskImage = NDArray[np.uint8]
RawImage = NDArray[np.uint8] | NDArray[np.uint16]  # as files store it

# Soft edges are neither teeth nor background, and so is most of a photograph: with a larger share of such pixels the
# picture is no mask. Masks of three cameras had up to 0.024 after a blur of 8 px, small ones 0.2; their footage 0.39
# and more.
MOST_GRAY = 0.2
MOST_SOFT = 0.35  # of what is not background: reached by the same masks after a blur of 8 px, not of 4 px (0.3)
_FAINT = 0.25  # of the contrast: what stays below it is noise, and a picture without more shows no teeth
_DEAD_ZONE = 0.06  # of the contrast, by which coding with loss misses the levels


@dataclass(frozen=True)
class MaskLevels:
    """Say how pictures of one source become coverage.

    `plane` is the channel that tells teeth from background: "alpha", "brightest" or "darkest" of the colours, or the
    number of one of them.
    """

    plane: str = "brightest"
    background: float = 0.0
    teeth: float = 255.0
    deep: bool = False  # 16 bit per channel
    lossy: bool = False  # coding has left noise around the levels
    doubtful: bool = False  # whether border and area disagree about which level is the background
    # share of what is not background that lies between the levels
    soft: float = field(default=0.0, compare=False)

    @property
    def usual(self) -> bool:
        """Tell whether black is background and full white teeth."""
        white = 65535.0 if self.deep else 255.0
        near = _DEAD_ZONE * white if self.lossy else 0.0
        return abs(self.background) <= near and abs(self.teeth - white) <= near

    @property
    def inverted(self) -> bool:
        """Tell whether teeth are darker than the background."""
        return self.teeth < self.background

    def coverage(self, image: RawImage) -> tuple[MaskImage | None, str]:
        """Return the mask of a picture, 0 .. 255, half of it the outline; None without teeth, and why if that is odd.

        The reason, to follow the name of the picture, is empty for a mask and for an empty picture. The mask may be the
        picture itself.
        """
        if (image.dtype == np.uint16) != self.deep:
            return None, f"has {8 * image.dtype.itemsize} bits per channel, unlike the others"
        plane = channel(image, self.plane)
        low, high, _, _ = cv2.minMaxLoc(plane)
        if low == high:
            empty = self.plane == "alpha" or abs(low - self.teeth) > abs(low - self.background)
            return None, "" if empty else f"is {low:g} all over, which means teeth everywhere"
        box = self._around_teeth(plane)  # mostly a tenth of the picture; all else is not looked at again
        part = self._shares(plane[box])
        inside = cv2.countNonZero(cv2.inRange(part, 128, 255))
        if inside == 0:
            brightest = low if self.inverted else high
            faint = int(part.max()) <= 255 * _FAINT
            return None, "" if faint else f"reaches only {brightest:g}, teeth are {self.teeth:g} in the others"
        if (gray := cv2.countNonZero(cv2.inRange(part, 26, 229)) / plane.size) > MOST_GRAY:
            return None, f"is no mask: {gray:.0%} of it are neither teeth nor background"
        mask = part if part.shape == plane.shape else self._placed(part, box, plane)
        if inside > mask.size / 2 and border_share(mask, 127.5) > 0.5:
            return None, f"has {inside / mask.size:.0%} teeth, up to the border: as if inverted, unlike the others"
        return mask, ""

    def _around_teeth(self, plane: RawImage) -> Slices:
        """Return the rows and columns of a channel outside of which all is background; at least one pixel."""

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
        """Return the share of teeth in pixels of a channel, 0 .. 255."""
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
        """Whether 8 bit pixels are shares as they are."""
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
    """Return one channel (h, w) of a picture; see `MaskLevels`."""
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
    """Return how much the channels of a picture (h, w, 3 or 4) differ at most in a pixel."""
    return float(cv2.minMaxLoc(cv2.subtract(channel(image, "brightest"), channel(image, "darkest")))[1])


def border_share(image: MaskImage, above: float) -> float:
    """Return the share of the outermost pixels above a value."""
    return float((np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]]) > above).mean())
