"""Both rows of teeth in one picture: colours, place and edges weighed against one another."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.segmentation.colours import ColourModel
from jawusd.segmentation.config import SegmentationConfig
from jawusd.segmentation.crowns import LOWER, OTHER, UPPER, Expectation
from jawusd.segmentation.cut import cut_three_ways

_NEVER = 30.0  # log-odds that no colour overcomes


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


def cut_rows(
    rgb: NDArray[np.uint8],
    expected: Expectation,
    model: ColourModel,
    config: SegmentationConfig,
    px_per_mm: float,
    reach_mm: float,
) -> NDArray[np.float32]:
    """Segment a picture.

    Args:
        rgb: the picture, shape (h, w, 3).
        expected: where the crowns are expected in it.
        model: the colours of this camera.
        config: the segmentation's numbers.
        px_per_mm: resolution of the picture.
        reach_mm: how far teeth may lie outside their projection.

    Returns:
        Shares of both rows, 0 .. 1, shape (2, h, w).
    """
    inside = expected.inside_px / px_per_mm
    odds = model.weigh(rgb) - np.clip(
        model.surroundings_reach(config.surroundings_share) + config.doubt, *config.doubt_range
    )
    cost = np.zeros((3, *rgb.shape[:2]), np.float32)
    apart = np.clip(config.rows_per_mm * (inside[0] - inside[1]) / 2, -3, 3)
    for label, row, sign in ((UPPER, 0, 1.0), (LOWER, 1, -1.0)):
        place = np.clip(config.place_per_mm * inside[row], -config.place_most[0], config.place_most[1])
        cost[label] = -odds - place - sign * np.minimum(sign * apart, 0.0)
        cost[label][inside[row] < -reach_mm] = _NEVER
    start = np.stack([expected.labels == label for label in (OTHER, UPPER, LOWER)]).astype(np.float32)
    free = (inside >= -reach_mm).any(0)
    shares = cut_three_ways(cost, _edge_prices(rgb, config), start, free, config.steps)
    return shares[1:]


def _edge_prices(rgb: NDArray[np.uint8], config: SegmentationConfig) -> NDArray[np.float32]:
    """Return what a border costs between each pixel and its right and lower neighbour, shape (2, h, w).

    The contrast that counts as an edge follows the picture's own (Boykov and Jolly 2001).
    """
    smooth = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB), (0, 0), 0.8).astype(np.float32)
    out = np.full((2, *rgb.shape[:2]), config.border, np.float32)
    squares = [((smooth[:, 1:] - smooth[:, :-1]) ** 2).sum(2), ((smooth[1:] - smooth[:-1]) ** 2).sum(2)]
    scale = 2 * (squares[0].mean() + squares[1].mean()) / 2 + 1e-6
    low = config.border_on_edge
    out[0, :, :-1] *= low + (1 - low) * np.exp(-squares[0] / scale)
    out[1, :-1] *= low + (1 - low) * np.exp(-squares[1] / scale)
    return out
