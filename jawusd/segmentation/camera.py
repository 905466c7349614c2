"""Segment the images of one camera, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera, transform_points
from jawusd.media.pixels import ColourPicture
from jawusd.segmentation.arches import Expectation, ScanSurface, Seeds, expect_crowns
from jawusd.segmentation.colours import ColourModel, SegmentationConfig
from jawusd.segmentation.files import Key
from jawusd.segmentation.learn import Example, cut_picture, overlap
from jawusd.segmentation.picture import PictureFrame, Window

_ARCHES = (0, 1)
_EVERY = 20  # stride over the crown vertices; only every 20th vertex is projected to find the window


@dataclass(frozen=True, eq=False)
class Segment:
    """Segmentation of both arches in one image."""

    camera: Camera  # pinhole camera of the window
    masks: NDArray[np.uint8]  # coverage of the upper and lower arch, 0..255, uint8, shape (2, h, w)
    present: Mask  # whether each arch is visible, shape (2,)
    # tooth probability just inside each arch's outline minus that just outside it, -1 .. 1; NaN without an outline
    contrast: Array
    # fraction of each arch's mask outside the expected crowns; NaN without a mask
    unexpected: Array
    # numbers of outline pixels of each arch: on visible edges, on no visible edge, and next to the other arch, shape
    # (2, 3)
    outline: NDArray[np.int64]
    # the segmented window and the expected crowns
    window: Window
    expected: Expectation

    def only(self, arches: Mask) -> Segment:
        """Return the segmentation with the masks of only those arches that are true in `arches`, shape (2,)."""
        if arches.all():
            return self
        masks = np.where(arches[:, None, None], self.masks, np.uint8(0))
        unknown = np.where(arches, 0.0, np.nan)
        return replace(
            self,
            masks=masks,
            present=self.present & arches,
            contrast=self.contrast + unknown,
            unexpected=self.unexpected + unknown,
            outline=np.where(arches[:, None], self.outline, 0),
        )


class CameraSegmenter:
    """Segmentation of both arches in one camera's images; `colours` is the colour model learned so far."""

    def __init__(self, source: Camera, meshes: Sequence[Mesh], poses: Array, config: SegmentationConfig) -> None:
        """Prepare the upper and lower scan; `poses` (2, 4, 4) are their world poses at any time of the take."""
        self._config = config
        upper, lower = meshes
        self._scans = ScanSurface.of(upper), ScanSurface.of(lower)
        self._points = [scan.vertices[np.unique(scan.crown_faces)[::_EVERY]] for scan in self._scans]
        self._frame = PictureFrame(source, self._around(poses).mean(0), config.working_px_per_mm)
        self.colours = ColourModel(config.memory_frames)

    def configure(self, config: SegmentationConfig) -> None:
        """Replace the configuration of the segmentation."""
        self._config = config

    def segment(
        self,
        image: ColourPicture,
        poses: Array,
        turn: int,
        keys: Sequence[Key | None] = (None, None),
    ) -> Segment | None:
        """Segment a recorded RGB image (H, W, 3); None if the teeth are out of view.

        Args:
            poses: expected T_world_upper, T_world_lower, shape (2, 4, 4).
            turn: number of the iteration; 0 with predicted poses, 1 or more with refined poses.
        """
        c = self._config
        window = self._frame.window(image, self._around(poses), c.margin_mm)
        if window is None:
            return None
        expected = expect_crowns(self._scans, poses, window.camera)
        seeds = self._seeds(window, keys)
        if turn == 0 or not self.colours.is_trained():
            self._learn(window, expected, keys, seeds)
        reach = c.reach_mm[min(turn, len(c.reach_mm) - 1)]
        # The tracker needs outlines that are consistent over time. Computed outlines are more consistent than annotated
        # outlines, so a finished mask replaces a computed mask only if the computed mask is wrong.
        drawn = seeds.share if seeds is not None and seeds.known.all() else None
        guide = None if drawn is not None else seeds
        # Refine the borders in the first iteration, too; with rough outlines, the tracker would report a lost arch.
        shares, clear = cut_picture(window, expected, self.colours, c, self._frame.px_per_mm, reach, guide)
        if drawn is not None and min(map(overlap, shares, drawn)) < c.key_overlap:
            shares = drawn
        masks = np.round(255 * shares).astype(np.uint8)
        present = np.array([(mask > 127).sum() >= c.least_px for mask in masks])
        contrast, unexpected = self._contrast(window, masks), _unexpected(masks, expected)
        return Segment(window.camera, masks, present, contrast, unexpected, _outline(masks, clear), window, expected)

    def recorded(self, segment: Segment) -> list[NDArray[np.uint8]]:
        """Return the masks of both arches in recorded pixels, (H, W) uint8, 0 or 255."""
        return [self._frame.recorded(mask.astype(np.float32) / 255, segment.window) for mask in segment.masks]

    def _around(self, poses: Array) -> Array:
        return np.concatenate([transform_points(poses[r], self._points[r]) for r in _ARCHES])

    def study(self, image: ColourPicture, poses: Array, keys: Sequence[Key | None]) -> Example | None:
        """Learn the colours of an annotated image at aligned poses, and return the image as an example for learning.

        Return None if the annotated masks are not finished, or if the teeth are out of view.
        """
        window = self._frame.window(image, self._around(poses), self._config.margin_mm)
        if window is None:
            return None
        expected = expect_crowns(self._scans, poses, window.camera)
        seeds = self._seeds(window, keys)
        self._learn(window, expected, keys, seeds)
        if seeds is None or not seeds.known.all():
            return None
        return Example(window, expected, seeds.share, self.colours, self._frame.px_per_mm)

    def _seeds(self, window: Window, keys: Sequence[Key | None]) -> Seeds | None:
        """Return the annotations of an image in a window."""
        if all(key is None for key in keys):
            return None
        known, share = np.zeros((2, *window.rgb.shape[:2]), bool), np.zeros((2, *window.rgb.shape[:2]), np.float32)
        for r, key in enumerate(keys):
            if key is not None:
                known[r] = self._frame.given(key.known, window) > 127
                share[r] = self._frame.given(key.mask, window) / np.float32(255)
        return Seeds(known | all(key is not None and key.finished for key in keys), share)

    def _learn(self, window: Window, expected: Expectation, keys: Sequence[Key | None], seeds: Seeds | None) -> None:
        """Update the colours with an image; annotated pixels have a higher weight."""
        c = self._config
        if not all(key is not None and key.finished for key in keys):
            nearest = expected.inside_px.max(0) / self._frame.px_per_mm
            self.colours.learn(window.rgb, nearest > c.inner_mm, nearest < -c.outer_mm)
        if seeds is not None:
            kernel = np.ones((3, 3), np.uint8)
            teeth = np.any(seeds.known & (seeds.share > 0.5), axis=0).astype(np.uint8)
            outer = np.all(seeds.known & (seeds.share <= 0.5), axis=0) & (cv2.dilate(teeth, kernel, iterations=2) == 0)
            self.colours.learn(window.rgb, cv2.erode(teeth, kernel) > 0, outer, c.key_weight)

    def _contrast(self, window: Window, masks: NDArray[np.uint8]) -> Array:
        """Return the tooth probability just inside an arch's outline minus the probability just outside both arches."""
        odds = self.colours.log_odds(window.rgb)
        share = 1 / (1 + np.exp(-odds))
        teeth = (masks.max(0) > 127).astype(np.uint8)
        kernel = np.ones((5, 5), np.uint8)
        outside = (cv2.dilate(teeth, kernel) > 0) & (teeth == 0)
        out = np.full(2, np.nan)
        for r in _ARCHES:
            arch = (masks[r] > 127).astype(np.uint8)
            inner = (arch > 0) & (cv2.dilate(1 - teeth, kernel) > 0)
            outer = outside & (cv2.dilate(arch, kernel) > 0)
            if inner.any() and outer.any():
                out[r] = share[inner].mean() - share[outer].mean()
        return out


def _outline(masks: NDArray[np.uint8], clear: Mask) -> NDArray[np.int64]:
    kernel = np.ones((3, 3), np.uint8)
    out = np.zeros((2, 3), np.int64)
    for r, mask in enumerate(masks):
        arch = (mask > 127).astype(np.uint8)
        outline = (arch > 0) & (cv2.erode(arch, kernel) == 0)
        other = cv2.dilate((masks[1 - r] > 127).astype(np.uint8), kernel) > 0
        out[r] = (outline & clear & ~other).sum(), (outline & ~clear & ~other).sum(), (outline & other).sum()
    return out


def _unexpected(masks: NDArray[np.uint8], expected: Expectation) -> Array:
    out = np.full(2, np.nan)
    for r, mask in enumerate(masks):
        teeth = mask > 127
        if teeth.any():
            out[r] = (teeth & (expected.inside_px[r] < 0)).sum() / teeth.sum()
    return out
