"""A few masks of a camera, measured: how much they show, where, and in which frames there are any."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass

import cv2
import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.capture import CameraSource
from jawusd.media.mask_levels import MaskImage
from jawusd.media.masks import MaskReader, open_masks

_SPREAD = 9  # frames looked at over a whole clip
_POINTS = 500  # pixels kept of a mask
_HALF = 128


@dataclass(frozen=True, eq=False)
class MaskSamples:
    """Hold what some masks of one camera show; frames are the camera's own."""

    counts: tuple[int, int]  # frames of the mask sources, upper and lower
    first_last: tuple[
        tuple[int, int] | None, tuple[int, int] | None
    ]  # frames with a mask of each arch, None: none found
    read: Callable[[int, int], MaskImage | None]  # arch, frame: the mask

    @property
    def first_frame(self) -> int | None:
        """Return the first frame with a mask of any arch."""
        return min((frames[0] for frames in self.first_last if frames is not None), default=None)

    def pixels(self, arch: int, frame: int) -> Array:
        """Return some pixels (x, y) of a mask, shape (N <= 500, 2); N = 0 where there is none."""
        mask = self.read(arch, frame)
        if mask is None:
            return np.empty((0, 2))
        y, x = np.nonzero(mask >= _HALF)
        chosen = slice(None, None, max(1, len(x) // _POINTS))
        return np.stack([x[chosen], y[chosen]], axis=1).astype(np.float64)


def sample_masks(source: CameraSource, size_px: tuple[int, int], files: ExitStack) -> MaskSamples:
    """Look at masks spread over a clip, and find the first and the last frame that has any.

    Args:
        source: a camera with masks.
        size_px: (width, height) of its pictures.
        files: closes the masks when it is closed.

    Raises:
        CaptureError: masks are missing, damaged, of another size or no masks.
    """
    pair = [files.enter_context(reader) for reader in open_masks(source, size_px)]
    ranges = tuple(_first_last(reader) for reader in pair)
    return MaskSamples(
        (pair[0].count, pair[1].count), (ranges[0], ranges[1]), lambda arch, frame: pair[arch].read(frame)
    )


def _first_last(reader: MaskReader) -> tuple[int, int] | None:
    """Return the first and the last frame with a mask, taking those between for masked, or None."""
    spread = np.unique(np.linspace(0, reader.count - 1, _SPREAD).round().astype(int)).tolist()
    shown = [frame for frame in spread if _shows(reader, frame)]
    if not shown:
        return None
    before = max((frame for frame in spread if frame < shown[0]), default=-1)
    after = min((frame for frame in spread if frame > shown[-1]), default=reader.count)
    return _boundary(reader, shown[0], before), _boundary(reader, shown[-1], after)


def _boundary(reader: MaskReader, shown: int, empty: int) -> int:
    """Return the frame with a mask that is nearest to the empty one, by bisection."""
    while abs(shown - empty) > 1:
        middle = (shown + empty) // 2
        if _shows(reader, middle):
            shown = middle
        else:
            empty = middle
    return shown


def _shows(reader: MaskReader, frame: int) -> bool:
    mask = reader.read(frame)
    return mask is not None and cv2.countNonZero(mask) > 0
