"""Segment the pictures of one camera, frame after frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera, transform_points
from jawusd.segmentation.border import settle_borders
from jawusd.segmentation.colours import ColourModel
from jawusd.segmentation.config import SegmentationConfig
from jawusd.segmentation.crowns import Expectation, ScanSurface, expect_crowns
from jawusd.segmentation.picture import PictureFrame, Window
from jawusd.segmentation.rows import cut_rows, learn_colours

_ROWS = (0, 1)
_EVERY = 20  # vertices of a crown to one that tells where it is


@dataclass(frozen=True, eq=False)
class Segment:
    """Hold both rows in one picture.

    Attributes:
        camera: the pinhole camera of the window.
        masks: shares of the upper and lower row, 255 = all, uint8, shape (2, h, w).
        present: which rows are to be seen at all, shape (2,).
        contrast: how far colours change for the better at the outline, per row, -1 .. 1; NaN where there is none.
        unexpected: how much of each row's mask is not where the crowns were expected, as a share; NaN without a mask.
        outline: pixels of each row's outline that show in the picture, that do not, and that border the other row,
            shape (2, 3).
        window, expected: what was segmented, and what was expected there.
    """

    camera: Camera
    masks: NDArray[np.uint8]
    present: NDArray[np.bool_]
    contrast: NDArray[np.float64]
    unexpected: NDArray[np.float64]
    outline: NDArray[np.int64]
    window: Window
    expected: Expectation


class CameraSegmenter:
    """Find both rows of teeth in one camera's pictures."""

    def __init__(
        self, source: Camera, meshes: Sequence[Mesh], poses: NDArray[np.float64], config: SegmentationConfig
    ) -> None:
        """Prepare for a take.

        Args:
            source: the calibrated camera.
            meshes: upper and lower teeth scan [mm].
            poses: T_world_upper, T_world_lower at some time of the take, shape (2, 4, 4).
            config: the segmentation's numbers.
        """
        self._config = config
        self._scans = tuple(ScanSurface.of(mesh) for mesh in meshes)
        self._points = [scan.crown_points()[::_EVERY] for scan in self._scans]
        self._frame = PictureFrame(source, self._around(poses).mean(0), config.working_px_per_mm)
        self._colours = ColourModel(config.memory_frames)

    def segment(
        self,
        image: NDArray[np.uint8],
        poses: NDArray[np.float64],
        turn: int,
        keys: Sequence[NDArray[np.uint8] | None] = (None, None),
    ) -> Segment | None:
        """Segment a picture.

        Args:
            image: (H, W, 3) RGB as recorded.
            poses: T_world_upper, T_world_lower as expected, shape (2, 4, 4).
            turn: 0 for predicted poses, then 1 and so on as they get better.
            keys: masks of both rows made by a person, (H, W) uint8 as recorded, or None.

        Returns:
            What was found; None if the teeth are out of sight.
        """
        c = self._config
        window = self._frame.window(image, self._around(poses), c.margin_mm)
        if window is None:
            return None
        expected = expect_crowns(self._scans, poses, window.camera)
        scale = self._frame.px_per_mm
        drawn = [None if key is None else self._frame.given(key, window) for key in keys]
        if all(mask is not None for mask in drawn):
            self._learn_from(window, np.maximum(*drawn), turn)
        elif turn == 0 or not self._colours.knows():
            learn_colours(self._colours, window.rgb, expected, c, scale)
        reach = c.reach_mm[min(turn, len(c.reach_mm) - 1)]
        shares = cut_rows(window.rgb, expected, self._colours, c, scale, reach)
        clear = np.zeros(shares.shape[1:], bool)
        if turn > 0:  # predicted poses call for a look only
            shares, clear = settle_borders(shares, window.rgb, c, scale)
        masks = np.round(255 * shares).astype(np.uint8)
        for r, mask in enumerate(drawn):
            if mask is not None:
                masks[r] = mask
        present = np.array([(mask > 127).sum() >= c.least_px for mask in masks])
        contrast, unexpected = self._contrast(window, masks), _unexpected(masks, expected)
        return Segment(window.camera, masks, present, contrast, unexpected, _outline(masks, clear), window, expected)

    def recorded(self, segment: Segment) -> list[NDArray[np.uint8]]:
        """Return the masks of both rows as recorded, (H, W) uint8, 0 or 255."""
        return [self._frame.recorded(mask.astype(np.float32) / 255, segment.window) for mask in segment.masks]

    def _around(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([transform_points(poses[r], self._points[r]) for r in _ROWS])

    def _learn_from(self, window: Window, teeth: NDArray[np.uint8], turn: int) -> None:
        """Let the colours follow a person's mask; what it leaves out is surroundings, under crowns too."""
        if turn > 0:
            return
        kernel = np.ones((3, 3), np.uint8)
        inner = cv2.erode(teeth, kernel) > 127
        outer = cv2.dilate(teeth, kernel, iterations=2) < 128
        self._colours.learn(window.rgb, inner, outer, self._config.key_weight)

    def _contrast(self, window: Window, masks: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Return how much likelier teeth are just inside the outline of a row than just outside of both rows."""
        odds = self._colours.weigh(window.rgb)
        share = 1 / (1 + np.exp(-odds))
        teeth = (masks.max(0) > 127).astype(np.uint8)
        kernel = np.ones((5, 5), np.uint8)
        outside = (cv2.dilate(teeth, kernel) > 0) & (teeth == 0)
        out = np.full(2, np.nan)
        for r in _ROWS:
            row = (masks[r] > 127).astype(np.uint8)
            inner = (row > 0) & (cv2.dilate(1 - teeth, kernel) > 0)
            outer = outside & (cv2.dilate(row, kernel) > 0)
            if inner.any() and outer.any():
                out[r] = share[inner].mean() - share[outer].mean()
        return out


def _outline(masks: NDArray[np.uint8], clear: NDArray[np.bool_]) -> NDArray[np.int64]:
    kernel = np.ones((3, 3), np.uint8)
    out = np.zeros((2, 3), np.int64)
    for r, mask in enumerate(masks):
        row = (mask > 127).astype(np.uint8)
        outline = (row > 0) & (cv2.erode(row, kernel) == 0)
        other = cv2.dilate((masks[1 - r] > 127).astype(np.uint8), kernel) > 0
        out[r] = (outline & clear & ~other).sum(), (outline & ~clear & ~other).sum(), (outline & other).sum()
    return out


def _unexpected(masks: NDArray[np.uint8], expected: Expectation) -> NDArray[np.float64]:
    out = np.full(2, np.nan)
    for r, mask in enumerate(masks):
        teeth = mask > 127
        if teeth.any():
            out[r] = (teeth & (expected.inside_px[r] < 0)).sum() / teeth.sum()
    return out
