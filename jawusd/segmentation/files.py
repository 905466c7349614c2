"""Mask files: where they lie, how they are written and given."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.errors import CaptureError
from jawusd.formats.atomic import write_bytes_atomic
from jawusd.imaging.masks import MaskReader

ROWS = ("upper", "lower")
PATTERN = "%06d.png"


def mask_pattern(folder: Path, camera: str, row: str) -> Path:
    """Return the file pattern of a camera's masks of a row, numbered by its own frames."""
    return folder / camera / row / PATTERN


def mask_path(folder: Path, camera: str, row: str, own: int) -> Path:
    """Return the file of one mask."""
    return folder / camera / row / (PATTERN % own)


def write_mask(path: Path, mask: NDArray[np.uint8]) -> None:
    """Write a mask (h, w) uint8 as PNG.

    Raises:
        OutputError: the file cannot be written.
    """
    # Run lengths suit masks: a twentieth of the time of the default, and files as small.
    settings = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    write_bytes_atomic(path, cv2.imencode(".png", mask, settings)[1].tobytes())


class KeyMasks:
    """Give the masks a person drew for some frames, in folders named as those that are written."""

    def __init__(self, folder: Path | None, sizes_px: dict[str, tuple[int, int]]) -> None:
        """Find the masks.

        Args:
            folder: holds CAMERA/upper/%06d.png and CAMERA/lower/%06d.png, any of them; None for no masks at all.
            sizes_px: (width, height) of the pictures of every camera.

        Raises:
            CaptureError: the folder is missing or holds no mask of these cameras, or a mask has the wrong size.
        """
        self._readers: dict[tuple[str, str], MaskReader] = {}
        if folder is None:
            return
        for camera, size in sizes_px.items():
            for row in ROWS:
                pattern = mask_pattern(folder, camera, row)
                if pattern.parent.is_dir():
                    self._readers[camera, row] = MaskReader(pattern, size)
        if not self._readers:
            raise CaptureError(
                f"holds no masks of {', '.join(sizes_px)}.",
                path=folder,
                hint="Name them CAMERA/upper/000123.png and CAMERA/lower/000123.png by the camera's own frames.",
            )

    def of(self, camera: str, own: int) -> list[NDArray[np.uint8] | None]:
        """Return the masks of both rows on a camera's own frame, None where there is none.

        Raises:
            CaptureError: a mask cannot be decoded.
        """
        readers = [self._readers.get((camera, row)) for row in ROWS]
        return [None if reader is None else reader.read(own) for reader in readers]
