"""Mask files: paths, writing, annotated masks, and contact sheets of thumbnails."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Mask
from jawusd.base.errors import CaptureError
from jawusd.formats.atomic import write_bytes_atomic
from jawusd.formats.clips import ClipSource
from jawusd.media.footage import open_clip
from jawusd.media.mask_files import PngMasks
from jawusd.media.mask_levels import RawImage
from jawusd.media.overlay import LOWER_COLOUR, UPPER_COLOUR, captioned, contact_sheet, save_png
from jawusd.media.pictures import read_gray

ARCHES = ("upper", "lower")
PATTERN = "%06d.png"
_UNKNOWN = 128  # gray value of pixels that are not annotated
_STROKES_UNKNOWN = 0.5  # minimum fraction of unannotated pixels for an image to count as strokes
_COLUMNS = 3
_TILE_PX = (480, 270)
_MARGIN = 0.15  # margin of a contact-sheet tile as a fraction of the extent of the teeth


def mask_pattern(folder: Path, camera: str, arch: str) -> Path:
    """Return the file pattern of a camera's masks of an arch, numbered like the camera's frames."""
    return folder / camera / arch / PATTERN


def mask_path(folder: Path, camera: str, arch: str, own: int) -> Path:
    """Return the path of one mask."""
    return folder / camera / arch / (PATTERN % own)


def write_mask(path: Path, mask: NDArray[np.uint8]) -> None:
    """Write a mask (h, w) uint8 as PNG; raises OutputError if the file cannot be written."""
    # Run-length encoding is twenty times faster than the default strategy, and the files have the same size.
    settings = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    write_bytes_atomic(path, cv2.imencode(".png", mask, settings)[1].tobytes())


@dataclass(frozen=True, eq=False)
class Key:
    """Annotation of one arch in one image."""

    mask: NDArray[np.uint8]  # 255 where annotated as tooth, (H, W) uint8
    # 255 at annotated pixels (everywhere in a finished mask, otherwise under strokes), (H, W) uint8
    known: NDArray[np.uint8]
    finished: bool  # whether all pixels are annotated


class KeyMasks:
    """Annotations of some frames, in folders with the same names as those of the computed masks.

    An image is a finished mask or, if at least half of its pixels have the gray value 128, strokes: 255 on teeth of the
    arch, 0 on anything else, and 128 where nothing was drawn.
    """

    def __init__(self, folder: Path | None, sizes_px: dict[str, tuple[int, int]]) -> None:
        """Find the images CAMERA/upper/%06d.png and CAMERA/lower/%06d.png in a folder, if one is given.

        Raises:
            CaptureError: the folder is missing or contains no images for these cameras.
        """
        self._folder, self._sizes_px = folder, sizes_px
        self._masks: dict[tuple[str, str], PngMasks] = {}
        if folder is None:
            return
        for camera, size in sizes_px.items():
            for arch in ARCHES:
                pattern = mask_pattern(folder, camera, arch)
                if pattern.parent.is_dir():
                    self._masks[camera, arch] = PngMasks(pattern, size, is_other=_is_strokes)
        if not self._masks:
            raise CaptureError(
                f"contains no masks of {', '.join(sizes_px)}.",
                path=folder,
                hint="Name them CAMERA/upper/000123.png and CAMERA/lower/000123.png, by the camera's frame numbers.",
            )

    def frames(self, camera: str) -> list[int]:
        """Return the numbers of a camera's annotated frames."""
        files = [path for arch in ARCHES if self._folder for path in (self._folder / camera / arch).glob("*.png")]
        return sorted({int(path.stem) for path in files if path.stem.isdecimal()})

    def of(self, camera: str, own: int) -> list[Key | None]:
        """Return the annotations of both arches at a camera's own frame; None for an arch without annotation.

        Raises:
            CaptureError: an image cannot be decoded or has the wrong size.
        """
        return [self._key(camera, arch, own) for arch in ARCHES]

    def _key(self, camera: str, arch: str, own: int) -> Key | None:
        source = self._masks.get((camera, arch))
        if source is None or self._folder is None or not 0 <= own < source.count:
            return None
        path = mask_path(self._folder, camera, arch, own)
        gray = read_gray(path)
        if gray is not None and _is_strokes(gray):
            if gray.shape[::-1] != tuple(self._sizes_px[camera]):
                size = self._sizes_px[camera]
                raise CaptureError(
                    f"the strokes are {gray.shape[1]} x {gray.shape[0]} px; the images are {size[0]} x {size[1]} px.",
                    path=path,
                    hint="Draw the strokes over a frame of the video at its original size.",
                )
            known = np.where(np.abs(gray.astype(int) - _UNKNOWN) > 64, 255, 0).astype(np.uint8)
            return Key(np.where(gray > _UNKNOWN, 255, 0).astype(np.uint8) & known, known, False)
        mask = next(source.masks(own), None)
        return None if mask is None else Key(mask, np.full_like(mask, 255), True)


def _is_strokes(picture: RawImage) -> bool:
    """Return whether an image, (h, w) or with channels, contains strokes rather than a finished mask."""
    return bool((picture == _UNKNOWN).mean() >= _STROKES_UNKNOWN)


def write_sheet(
    path: Path, shown: Sequence[tuple[str, int, str]], videos: Mapping[str, ClipSource | Path], folder: Path
) -> None:
    """Write a PNG with one tile per (camera, frame of this camera, remark), in which both arches are outlined.

    Raises:
        CaptureError: an image or mask cannot be decoded.
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
    """Return an RGB image that is cropped to its masks, with their outlines and a caption."""
    extent = np.zeros(picture.shape[:2], bool)
    for mask, colour in zip(masks, (UPPER_COLOUR, LOWER_COLOUR), strict=True):
        if mask is not None:
            outlines = cv2.findContours((mask > 127).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
            cv2.drawContours(picture, outlines, -1, colour, 2)
            extent |= mask > 127
    cut = np.asarray(cv2.resize(_cut(picture, extent), _TILE_PX, interpolation=cv2.INTER_AREA), np.uint8)
    return captioned(cut, caption)


def _cut(picture: NDArray[np.uint8], extent: Mask) -> NDArray[np.uint8]:
    """Crop an image to the surroundings of the marked pixels, with the aspect ratio of a tile if possible."""
    if not extent.any():
        return picture
    rows, columns = np.flatnonzero(extent.any(1)), np.flatnonzero(extent.any(0))
    centre = np.array([columns[0] + columns[-1], rows[0] + rows[-1]]) / 2
    half = np.array([columns[-1] - columns[0], rows[-1] - rows[0]]) * (0.5 + _MARGIN)
    half = np.array(_TILE_PX) * (half / np.array(_TILE_PX)).max()
    size = np.array(picture.shape[1::-1])
    low, high = np.clip(centre - half, 0, size).astype(int), np.clip(centre + half, 0, size).astype(int)
    return picture[low[1] : high[1], low[0] : high[0]]
