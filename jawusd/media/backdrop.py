"""Background images for drawing scans: the footage of a camera, or its masks if there is no footage."""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import NDArray

from jawusd.base.errors import CaptureError
from jawusd.formats.capture import CameraSource
from jawusd.media.footage import FrameReader, open_clip
from jawusd.media.masks import mask_size_px, open_masks

#: Gray values of upper teeth, lower teeth and background in masks.
_UPPER, _LOWER, _NEITHER = 150, 105, 25


class Backdrop:
    """Background images of one camera, by frame number of the reference camera; thread-safe.

    Attributes:
        size_px: (width, height) of the images.
        count: one past the last frame number of the camera itself.
        is_footage: whether the images are footage instead of masks.
    """

    def __init__(self, source: CameraSource, offset: int) -> None:
        """Open the footage or masks; their frame k is simultaneous with frame k + offset of the reference camera.

        Raises:
            CaptureError: the camera has neither a video nor masks, or they cannot be decoded.
        """
        self._offset = offset
        self._lock = threading.Lock()
        self.is_footage = source.clip is not None
        if source.clip is not None:
            self._reader = FrameReader(open_clip(source.clip))
            self.size_px, self.count = self._reader.video.size_px, self._reader.video.timeline.count
        elif source.masks is not None:
            self.size_px = mask_size_px(source.masks.upper)
            self._masks = open_masks(source, self.size_px)
            self.count = max(masks.count for masks in self._masks)
        else:
            raise CaptureError(
                "has neither a video nor masks to draw over.",
                camera=source.name,
                hint="Add one of them in the capture file.",
            )

    def picture(self, frame: int) -> NDArray[np.uint8] | None:
        """Return the image at a frame of the reference camera, (h, w, 3) RGB, read-only, or None.

        Raises:
            CaptureError: the image cannot be decoded.
        """
        own = frame - self._offset
        if self.is_footage:
            number = self._reader.video.timeline.picture(own)
            return None if number is None else self._reader.picture(number)
        with self._lock:
            found = [masks.read(own) for masks in self._masks]
        width, height = self.size_px
        out = np.full((height, width), _NEITHER, np.uint8)
        for mask, gray in zip(found, (_UPPER, _LOWER), strict=True):
            if mask is not None:
                out[mask > 127] = gray
        return np.repeat(out[:, :, None], 3, axis=2)

    def close(self) -> None:
        """Stop decoding in the background."""
        if not self.is_footage:
            for masks in self._masks:
                masks.close()
