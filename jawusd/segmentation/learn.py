"""Learn the weights of the energy and the offset of the annotator's outlines from finished masks of a few frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Mask
from jawusd.segmentation.arches import Expectation, Seeds, cut_arches, separate_arches
from jawusd.segmentation.border import refine_borders
from jawusd.segmentation.colours import ColourModel, SegmentationConfig
from jawusd.segmentation.picture import Window

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


@dataclass(frozen=True, eq=False)
class Example:
    """Example for learning: an image with finished masks."""

    # the image and the expected crowns
    window: Window
    expected: Expectation
    drawn: NDArray[np.float32]  # annotated coverage of both arches, shape (2, h, w)
    colours: ColourModel  # colour model of the image's camera
    px_per_mm: float  # resolution of the image

    def cut(self, config: SegmentationConfig) -> NDArray[np.float32]:
        """Segment without the annotated masks; return the coverage of both arches, shape (2, h, w)."""
        where = (self.window, self.expected, self.colours, config, self.px_per_mm)
        return cut_picture(*where, config.reach_mm[-1], None)[0]


def cut_picture(
    window: Window,
    expected: Expectation,
    colours: ColourModel,
    config: SegmentationConfig,
    px_per_mm: float,
    reach_mm: float,
    seeds: Seeds | None,
) -> tuple[NDArray[np.float32], Mask]:
    """Segment both arches, refine their borders, and keep annotated pixels.

    Return the coverage of both arches, shape (2, h, w), and the pixels with visible borders, shape (h, w).
    """
    shares = cut_arches(window.rgb, expected, colours, config, px_per_mm, reach_mm, seeds)
    shares, clear = refine_borders(shares, window.rgb, config, px_per_mm)
    shares = separate_arches(shares, window.rgb, expected, config, px_per_mm)
    shares = _widened(shares, config.wider)
    return (shares if seeds is None else seeds.pinned(shares)), clear


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
