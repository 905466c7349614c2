"""Segment the images of one camera, frame by frame, and learn how to from finished masks of a few frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypedDict

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera, transform_points
from jawusd.media.pixels import ColourPicture
from jawusd.segmentation.arches import (
    Expectation,
    ScanSurface,
    Seeds,
    cut_arches,
    expect_crowns,
    refine_borders,
    separate_arches,
)
from jawusd.segmentation.colours import ColourModel, SegmentationConfig
from jawusd.segmentation.files import Key
from jawusd.segmentation.picture import PictureFrame, Window

_ARCHES = (0, 1)
_EVERY = 20  # stride over the crown vertices; only every 20th vertex is projected to find the window


@dataclass(frozen=True, eq=False)
class Scene:
    """An image to be segmented."""

    window: Window  # its part around the teeth
    expected: Expectation  # the expected crowns in the window
    colours: ColourModel  # colour model of the image's camera
    px_per_mm: float  # resolution at the teeth

    def cut(
        self, config: SegmentationConfig, reach_mm: float, seeds: Seeds | None = None
    ) -> tuple[NDArray[np.float32], Mask]:
        """Return the coverage of both arches (2, h, w), with annotated pixels kept, and pixels with visible borders."""
        rgb, expected, px_per_mm = self.window.rgb, self.expected, self.px_per_mm
        shares = cut_arches(rgb, expected, self.colours, config, px_per_mm, reach_mm, seeds)
        shares, clear = refine_borders(shares, rgb, config, px_per_mm)
        shares = separate_arches(shares, rgb, expected, config, px_per_mm)
        shares = _widened(shares, config.wider)
        return (shares if seeds is None else seeds.pinned(shares)), clear


@dataclass(frozen=True, eq=False)
class Example:
    """Example for learning: an image with finished masks."""

    scene: Scene
    drawn: NDArray[np.float32]  # annotated coverage of both arches, shape (2, h, w)

    def cut(self, config: SegmentationConfig) -> NDArray[np.float32]:
        """Segment without the annotated masks; return the coverage of both arches, shape (2, h, w)."""
        return self.scene.cut(config, config.reach_mm[-1])[0]


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
    window: Window  # the segmented window

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

        `turn` is the number of the iteration: 0 with predicted poses (2, 4, 4), 1 or more with refined ones.
        """
        c = self._config
        scene = self._scene(image, poses)
        if scene is None:
            return None
        seeds = self._seeds(scene.window, keys)
        if turn == 0 or not self.colours.is_trained():
            self._learn(scene, keys, seeds)
        reach = c.reach_mm[min(turn, len(c.reach_mm) - 1)]
        # The tracker needs outlines that are consistent over time. Computed outlines are more consistent than annotated
        # outlines, so a finished mask replaces a computed mask only if the computed mask is wrong.
        drawn = seeds.share if seeds is not None and seeds.known.all() else None
        guide = None if drawn is not None else seeds
        # Refine the borders in the first iteration, too; with rough outlines, the tracker would report a lost arch.
        shares, clear = scene.cut(c, reach, guide)
        if drawn is not None and min(map(overlap, shares, drawn)) < c.key_overlap:
            shares = drawn
        masks = np.round(255 * shares).astype(np.uint8)
        present = np.array([(mask > 127).sum() >= c.least_px for mask in masks])
        contrast, unexpected = self._contrast(scene.window, masks), _unexpected(masks, scene.expected)
        outline = _outline(masks, clear)
        return Segment(scene.window.camera, masks, present, contrast, unexpected, outline, scene.window)

    def recorded(self, segment: Segment) -> list[NDArray[np.uint8]]:
        """Return the masks of both arches in recorded pixels, (H, W) uint8, 0 or 255."""
        return [self._frame.recorded(mask.astype(np.float32) / 255, segment.window) for mask in segment.masks]

    def _around(self, poses: Array) -> Array:
        return np.concatenate([transform_points(poses[r], self._points[r]) for r in _ARCHES])

    def study(self, image: ColourPicture, poses: Array, keys: Sequence[Key | None]) -> Example | None:
        """Learn the colours of an annotated image at aligned poses, and return the image as an example for learning.

        Return None if the annotated masks are not finished, or if the teeth are out of view.
        """
        scene = self._scene(image, poses)
        if scene is None:
            return None
        seeds = self._seeds(scene.window, keys)
        self._learn(scene, keys, seeds)
        return Example(scene, seeds.share) if seeds is not None and seeds.known.all() else None

    def _scene(self, image: ColourPicture, poses: Array) -> Scene | None:
        """Return an image with the crowns expected at given poses; None if the teeth are out of view."""
        window = self._frame.window(image, self._around(poses), self._config.margin_mm)
        if window is None:
            return None
        expected = expect_crowns(self._scans, poses, window.camera)
        return Scene(window, expected, self.colours, self._frame.px_per_mm)

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

    def _learn(self, scene: Scene, keys: Sequence[Key | None], seeds: Seeds | None) -> None:
        """Update the colours with an image; annotated pixels have a higher weight."""
        c, rgb = self._config, scene.window.rgb
        if not all(key is not None and key.finished for key in keys):
            nearest = scene.expected.inside_px.max(0) / scene.px_per_mm
            self.colours.learn(rgb, nearest > c.inner_mm, nearest < -c.outer_mm)
        if seeds is not None:
            kernel = np.ones((3, 3), np.uint8)
            teeth = np.any(seeds.known & (seeds.share > 0.5), axis=0).astype(np.uint8)
            outer = np.all(seeds.known & (seeds.share <= 0.5), axis=0) & (cv2.dilate(teeth, kernel, iterations=2) == 0)
            self.colours.learn(rgb, cv2.erode(teeth, kernel) > 0, outer, c.key_weight)

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


_FACTORS = (0.5, 2.0)  # factors that are tried for each weight, one weight at a time
_NUMBERS = ("border", "place_per_mm", "rows_per_mm")
_DOUBTS = (-1.0, 1.0)  # candidate increments of `doubt`
_WIDER = np.arange(-6, 7) * 0.05  # candidate outward shifts of the outlines, in widths of the soft border
_LEAST_GAIN = 0.01  # minimum relative improvement for which a change is kept


class LearnedNumbers(TypedDict):
    """Weights that were changed, and mean error (1 - intersection over union) before and after."""

    numbers: dict[str, object]
    disagreement: list[float]
    pictures: int


def learn_numbers(examples: Sequence[Example], config: SegmentationConfig) -> tuple[SegmentationConfig, LearnedNumbers]:
    """Optimise the weights one by one for agreement with annotated masks; return them and a summary of the changes."""
    best, cuts = config, [example.cut(config) for example in examples]
    before = least = _disagreement(examples, cuts)
    for trial in _trials(config):
        changed = {name: value for name, value in vars(trial).items() if value != getattr(config, name)}
        trial = replace(best, **changed)
        found = [example.cut(trial) for example in examples]
        value = _disagreement(examples, found)
        if value < (1 - _LEAST_GAIN) * least:
            best, cuts, least = trial, found, value
    upper, lower = (_best_width([c[r] for c in cuts], [e.drawn[r] for e in examples]) for r in (0, 1))
    wider = (upper, lower)
    cuts = [_widened(cut, wider) for cut in cuts]
    value = _disagreement(examples, cuts)
    if value < (1 - _LEAST_GAIN) * least:
        best, least = replace(best, wider=wider), value
    changed = {name: value for name, value in vars(best).items() if value != getattr(config, name)}
    return best, {"numbers": changed, "disagreement": [before, least], "pictures": len(examples)}


def _trials(config: SegmentationConfig) -> Iterator[SegmentationConfig]:
    for name in _NUMBERS:
        for factor in _FACTORS:
            yield replace(config, **{name: getattr(config, name) * factor})
    for more in _DOUBTS:
        yield replace(config, doubt=config.doubt + more)


def _widened(shares: NDArray[np.float32], wider: tuple[float, float]) -> NDArray[np.float32]:
    """Return coverages with outlines moved by fractions of the soft border's width, except between the arches."""
    if not any(wider):
        return shares
    alone = shares[::-1] < 0.05
    moved = np.where(shares > 0.02, shares + np.array(wider, np.float32)[:, None, None], shares)
    return np.where(alone, np.clip(moved, 0, 1), shares)


def _best_width(found: Sequence[NDArray[np.float32]], drawn: Sequence[NDArray[np.float32]]) -> float:
    losses = [np.mean([1 - overlap(f + w, d) for f, d in zip(found, drawn, strict=True)]) for w in _WIDER]
    return float(_WIDER[int(np.argmin(losses))])


def _disagreement(examples: Sequence[Example], cuts: Sequence[NDArray[np.float32]]) -> float:
    pairs = [(cut[r], e.drawn[r]) for cut, e in zip(cuts, examples, strict=True) for r in (0, 1)]
    return float(np.mean([1 - overlap(found, drawn) for found, drawn in pairs]))


def overlap(found: NDArray[np.float32], drawn: NDArray[np.float32]) -> float:
    """Return the intersection over union of two coverages, shape (h, w)."""
    a, b = found > 0.5, drawn > 0.5
    return float((a & b).sum() / max(1, (a | b).sum()))
