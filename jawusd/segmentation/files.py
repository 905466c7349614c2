"""Mask files: where they lie, how they are written, and masks drawn by a person."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.errors import CaptureError
from jawusd.formats.atomic import write_bytes_atomic
from jawusd.media.mask_files import PngMasks
from jawusd.media.mask_levels import RawImage
from jawusd.media.pictures import read_gray

ARCHES = ("upper", "lower")
PATTERN = "%06d.png"
_UNKNOWN = 128  # gray value of strokes where nothing was drawn
_STROKES_UNKNOWN = 0.5  # share of such pixels that makes a picture one of strokes


def mask_pattern(folder: Path, camera: str, arch: str) -> Path:
    """Return the file pattern of a camera's masks of an arch, numbered by its own frames."""
    return folder / camera / arch / PATTERN


def mask_path(folder: Path, camera: str, arch: str, own: int) -> Path:
    """Return the file of one mask."""
    return folder / camera / arch / (PATTERN % own)


def write_mask(path: Path, mask: NDArray[np.uint8]) -> None:
    """Write a mask (h, w) uint8 as PNG.

    Raises:
        OutputError: the file cannot be written.
    """
    # Run lengths suit masks: a twentieth of the time of the default, and files as small.
    settings = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    write_bytes_atomic(path, cv2.imencode(".png", mask, settings)[1].tobytes())


@dataclass(frozen=True, eq=False)
class Key:
    """Hold what a person drew for one arch in one picture."""

    mask: NDArray[np.uint8]  # 255 = tooth, (H, W) uint8
    # 255 where the mask holds, (H, W) uint8: everywhere in a finished mask, else under strokes
    known: NDArray[np.uint8]
    finished: bool  # whether it holds everywhere


class KeyMasks:
    """Read what a person drew for some frames, in folders named like those that are written.

    A picture is a finished mask, or, where at least half of it has the gray value 128, strokes: 255 on teeth of the
    arch, 0 on anything else, 128 where nothing was drawn.
    """

    def __init__(self, folder: Path | None, sizes_px: dict[str, tuple[int, int]]) -> None:
        """Find the pictures CAMERA/upper/%06d.png and CAMERA/lower/%06d.png of a folder; None holds none.

        Raises:
            CaptureError: the folder is missing or holds nothing for these cameras.
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
                f"holds no masks of {', '.join(sizes_px)}.",
                path=folder,
                hint="Name them CAMERA/upper/000123.png and CAMERA/lower/000123.png by the camera's own frames.",
            )

    def frames(self, camera: str) -> list[int]:
        """Return a camera's own frames for which anything was drawn."""
        files = [path for arch in ARCHES if self._folder for path in (self._folder / camera / arch).glob("*.png")]
        return sorted({int(path.stem) for path in files if path.stem.isdecimal()})

    def of(self, camera: str, own: int) -> list[Key | None]:
        """Return what was drawn for both arches on a camera's own frame, None where there is nothing.

        Raises:
            CaptureError: a picture cannot be decoded or has the wrong size.
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
                    f"the strokes are {gray.shape[1]} x {gray.shape[0]} px, the pictures {size[0]} x {size[1]} px.",
                    path=path,
                    hint="Draw them over a frame of the video at its own size.",
                )
            known = np.where(np.abs(gray.astype(int) - _UNKNOWN) > 64, 255, 0).astype(np.uint8)
            return Key(np.where(gray > _UNKNOWN, 255, 0).astype(np.uint8) & known, known, False)
        mask = next(source.masks(own), None)
        return None if mask is None else Key(mask, np.full_like(mask, 255), True)


def _is_strokes(picture: RawImage) -> bool:
    """Tell whether a picture, (h, w) or with channels, holds strokes and not a finished mask."""
    return bool((picture == _UNKNOWN).mean() >= _STROKES_UNKNOWN)
