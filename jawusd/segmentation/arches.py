"""Both arches in one picture: colours, place and edges weighted against one another."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Mask
from jawusd.segmentation.colours import ColourModel
from jawusd.segmentation.config import SegmentationConfig
from jawusd.segmentation.crowns import LOWER, OTHER, UPPER, Expectation
from jawusd.segmentation.cut import cut_three_ways

_NEVER = 30.0  # log-odds that no colour overcomes
_FEWEST_OPEN = 20  # pixels between the arches; with fewer the border stays
_ARCH_BLUR_PX = 0.8  # softens the border between the arches to fractions of a pixel


@dataclass(frozen=True, eq=False)
class Seeds:
    """Hold what a person drew in a working picture."""

    known: Mask  # where a person marked each arch as tooth or not, shape (2, h, w)
    share: NDArray[np.float32]  # of tooth there, shape (2, h, w)

    def pinned(self, shares: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return shares of both arches, shape (2, h, w), replaced by what a person drew where it is known."""
        shares = np.where(self.known, self.share, shares)
        other = self.known & (self.share > 0.5)
        return np.where(other[::-1] & ~self.known, 0, shares)


def learn_colours(
    model: ColourModel,
    rgb: NDArray[np.uint8],
    expected: Expectation,
    config: SegmentationConfig,
    px_per_mm: float,
    weight: float = 1.0,
) -> None:
    """Let a colour model see a picture, shape (h, w, 3), with the crowns where they are expected."""
    nearest = expected.inside_px.max(0) / px_per_mm
    model.learn(rgb, nearest > config.inner_mm, nearest < -config.outer_mm, weight)


def doubted_odds(rgb: NDArray[np.uint8], model: ColourModel, config: SegmentationConfig) -> NDArray[np.float32]:
    """Return the log-odds of being tooth by colours alone, less the log-odds demanded of them, shape (h, w)."""
    demanded = model.surroundings_quantile(config.surroundings_share) + config.doubt
    return model.log_odds(rgb) - np.float32(np.clip(demanded, *config.doubt_range))


def cut_arches(
    rgb: NDArray[np.uint8],
    expected: Expectation,
    model: ColourModel,
    config: SegmentationConfig,
    px_per_mm: float,
    reach_mm: float,
    seeds: Seeds | None = None,
) -> NDArray[np.float32]:
    """Segment a picture (h, w, 3); return the shares of both arches, 0 .. 1, shape (2, h, w).

    Args:
        reach_mm: how far teeth may lie outside their projection.
        seeds: what a person drew, which no colour overrides.
    """
    inside = expected.inside_px / px_per_mm
    odds = doubted_odds(rgb, model, config)
    cost = np.zeros((3, *rgb.shape[:2]), np.float32)
    apart = np.clip(config.rows_per_mm * (inside[0] - inside[1]) / 2, -3, 3)
    for label, arch, sign in ((UPPER, 0, 1.0), (LOWER, 1, -1.0)):
        place = np.clip(config.place_per_mm * inside[arch], -config.place_most[0], config.place_most[1])
        cost[label] = -odds - place - sign * np.minimum(sign * apart, 0.0)
        cost[label][inside[arch] < -reach_mm] = _NEVER
    free: Mask = np.any(inside >= -reach_mm, axis=0)
    if seeds is not None:
        tooth, other = seeds.known & (seeds.share > 0.5), seeds.known & (seeds.share <= 0.5)
        for label, arch in ((UPPER, 0), (LOWER, 1)):
            cost[label][tooth[arch]] = -_NEVER
            cost[label][other[arch]] = _NEVER
        free |= tooth.any(0)
    start = np.stack([expected.labels == label for label in (OTHER, UPPER, LOWER)]).astype(np.float32)
    shares = cut_three_ways(cost, _edge_prices(rgb, config), start, free, config.steps)
    return shares[1:]


def part_arches(
    shares: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    expected: Expectation,
    config: SegmentationConfig,
    px_per_mm: float,
) -> NDArray[np.float32]:
    """Return the shares of both arches, shape (2, h, w), with the border between them drawn by edges among teeth only.

    The sum of both is kept. Teeth over teeth show a far weaker edge than teeth over lips. Beside the latter it would
    count for nothing: the border would stay where it was expected, and poses would follow their own prediction.
    """
    inside = expected.inside_px / px_per_mm
    teeth = shares.sum(0)
    open_px = (teeth > 0.5) & (np.abs(inside[0] - inside[1]) < 2 * config.arch_band_mm)
    if open_px.sum() < _FEWEST_OPEN:
        return shares
    rows, columns = np.flatnonzero(open_px.any(1)), np.flatnonzero(open_px.any(0))
    box = (slice(max(0, rows[0] - 2), rows[-1] + 3), slice(max(0, columns[0] - 2), columns[-1] + 3))
    upper, open_px = (shares[0] >= shares[1])[box], open_px[box]
    apart = np.clip(config.rows_per_mm * (inside[0] - inside[1])[box] / 2, -3, 3)
    cost = np.full((3, *upper.shape), _NEVER, np.float32)
    for label, mine, sign in ((UPPER, upper, 1.0), (LOWER, ~upper, -1.0)):
        cost[label] = np.where(open_px, -sign * apart, np.where(mine, -_NEVER, _NEVER))
    start = np.stack([np.zeros_like(upper), upper, ~upper]).astype(np.float32)
    prices = _edge_prices(rgb[box], config, open_px)
    found = cut_three_ways(cost, prices, start, open_px, config.arch_steps)
    share = cv2.GaussianBlur(found[UPPER], (0, 0), _ARCH_BLUR_PX)
    out = shares.copy()
    near = cv2.dilate(open_px.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    for r, part in ((0, share), (1, 1 - share)):
        out[r][box] = np.where(near, teeth[box] * part, shares[r][box])
    return out


def _edge_prices(rgb: NDArray[np.uint8], config: SegmentationConfig, where: Mask | None = None) -> NDArray[np.float32]:
    """Return what a border costs between each pixel and its right and lower neighbour, shape (2, h, w).

    The contrast that counts as an edge follows the picture's own (Boykov and Jolly 2001), or that of a part of it,
    shape (h, w).
    """
    smooth = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB), (0, 0), 0.8).astype(np.float32)
    out = np.full((2, *rgb.shape[:2]), config.border, np.float32)
    squares = [((smooth[:, 1:] - smooth[:, :-1]) ** 2).sum(2), ((smooth[1:] - smooth[:-1]) ** 2).sum(2)]
    parts = squares if where is None else (squares[0][where[:, 1:]], squares[1][where[1:]])
    scale = 2 * sum(float(part.mean()) for part in parts) / 2 + 1e-6
    low = config.border_on_edge
    out[0, :, :-1] *= low + (1 - low) * np.exp(-squares[0] / scale)
    out[1, :-1] *= low + (1 - low) * np.exp(-squares[1] / scale)
    return out
