"""Thumbnails of masks over their pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Mask
from jawusd.formats.clip_source import ClipSource
from jawusd.media.footage import open_clip
from jawusd.media.overlay import LOWER_COLOUR, UPPER_COLOUR, captioned, contact_sheet, save_png
from jawusd.segmentation.files import ARCHES, KeyMasks

_COLUMNS = 3
_TILE_PX = (480, 270)
_MARGIN = 0.15  # of the teeth's extent, left around them


def write_sheet(
    path: Path, shown: Sequence[tuple[str, int, str]], videos: Mapping[str, ClipSource | Path], folder: Path
) -> None:
    """Write a PNG with a tile per (camera, its own frame, remark), upper and lower arch outlined.

    Raises:
        CaptureError: a picture or mask cannot be decoded.
        OutputError: the file cannot be written.
    """
    opened = {name: open_clip(videos[name]) for name in {camera for camera, _, _ in shown}}
    masks = KeyMasks(folder, {name: video.size_px for name, video in opened.items()})
    tiles = []
    for name, own, remark in shown:
        index = int(np.searchsorted(opened[name].timeline.stored, own))
        picture = next(opened[name].frames(index, index + 1, colour="rgb")).image.copy()
        drawn = [None if key is None else key.mask for key in masks.of(name, own)]
        tiles.append(_tile(picture, drawn, f"{name}  frame {own}  {remark}"))
    save_png(path, contact_sheet(tiles, _COLUMNS))


def _tile(picture: NDArray[np.uint8], masks: Sequence[NDArray[np.uint8] | None], caption: str) -> NDArray[np.uint8]:
    """Return a picture with its masks outlined, cut to them and captioned, RGB."""
    extent = np.zeros(picture.shape[:2], bool)
    for _, mask, colour in zip(ARCHES, masks, (UPPER_COLOUR, LOWER_COLOUR), strict=True):
        if mask is not None:
            outlines = cv2.findContours((mask > 127).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
            cv2.drawContours(picture, outlines, -1, colour, 2)
            extent |= mask > 127
    cut = np.asarray(cv2.resize(_cut(picture, extent), _TILE_PX, interpolation=cv2.INTER_AREA), np.uint8)
    return captioned(cut, caption)


def _cut(picture: NDArray[np.uint8], extent: Mask) -> NDArray[np.uint8]:
    """Return the part of a picture around what is marked, of the tile's shape as far as the picture reaches."""
    if not extent.any():
        return picture
    rows, columns = np.flatnonzero(extent.any(1)), np.flatnonzero(extent.any(0))
    centre = np.array([columns[0] + columns[-1], rows[0] + rows[-1]]) / 2
    half = np.array([columns[-1] - columns[0], rows[-1] - rows[0]]) * (0.5 + _MARGIN)
    half = np.array(_TILE_PX) * (half / np.array(_TILE_PX)).max()
    size = np.array(picture.shape[1::-1])
    low, high = np.clip(centre - half, 0, size).astype(int), np.clip(centre + half, 0, size).astype(int)
    return picture[low[1] : high[1], low[0] : high[0]]
