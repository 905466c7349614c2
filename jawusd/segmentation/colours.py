"""Colour models."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.base.arrays import Array, Indices, Mask
from jawusd.base.npz import DAMAGED
from jawusd.formats.atomic import write_npz_atomic

_BINS = 32  # per channel
_FLOOR = 12.0  # added to every channel before ratios [8-bit steps]: noise of dark pixels has no colour
_RATIO_STEP = 0.03  # width of a bin of the log ratios [-]: from red over green 0.6 to 1.6 and beyond
_MOST = 6.0  # bound of the log-odds by colour alone [-]
_ROUNDS, _STEPS = 5, 8  # times hidden crowns are reclassified, and Newton steps each time
_LIGHT = 1  # the term of lightness
_RIDGE = 0.01  # keeps weights finite where colours do not overlap
# Alternating: a run may be killed between saving the colours of a frame and recording it.
_FILES = ("colours_0.npz", "colours_1.npz")


@dataclass(frozen=True)
class SegmentationConfig:
    """Set up the segmentation; px are pixels of the working picture."""

    # Working resolution at the teeth [px/mm]: that of the tracker.
    working_px_per_mm: float = 7.2
    # Surroundings looked at around the projected crowns [mm]: lips, gum and tongue, not the room behind.
    margin_mm: float = 4.0
    # Distance inside projected crowns from which colours are learned as crowns [mm]: above the error of the poses.
    inner_mm: float = 0.4
    # Distance outside all projected crowns from which colours are learned as surroundings [mm].
    outer_mm: float = 1.0
    # How far teeth may reach beyond their projection [mm]: in the first round, and once the poses have been aligned.
    reach_mm: tuple[float, ...] = (1.6, 1.0)
    # Frames over which colours are remembered [-]: light changes with the head, not from frame to frame.
    memory_frames: float = 24.0
    # Share of the surroundings below whose log-odds a colour cannot be tooth [-], and how much higher [-] its log-odds
    # must be where place gives no evidence: how well colours separate the two differs from person to person.
    surroundings_share: float = 0.95
    doubt: float = 1.5
    # Bounds of the log-odds demanded in all [-].
    doubt_range: tuple[float, float] = (-1.0, 1.0)
    # Log-odds of being tooth per mm inside the projected outline [1/mm], and the most that place alone may count
    # against and for it.
    place_per_mm: float = 2.0
    place_most: tuple[float, float] = (1.5, 1.0)
    # Price of a border in log-odds per pixel of its length [-], and the share left of it on the strongest edges.
    border: float = 4.0
    border_on_edge: float = 0.15
    # Log-odds between the arches per mm from their projected common border [1/mm]; segment.json has this name.
    rows_per_mm: float = 2.0
    # How far borders may move to where the picture changes [mm] and how far to either side colours are compared [mm].
    border_band_mm: float = 0.4
    border_side_mm: float = 0.8
    # Blur of the colours compared [px], and standard deviations the sides must differ by [-].
    border_blur_px: float = 0.7
    border_contrast: float = 2.0
    # Shares by which outlines of the upper and lower arch are moved outwards [-], as drawn masks teach: the soft border
    # from 0 to 1 is about 3 px wide.
    wider: tuple[float, float] = (0.0, 0.0)
    # Share of its outline that must show in the picture for a part to be tooth [-], and pixels below which it is none.
    founded_share: float = 0.5
    speck_px: int = 25
    # Iterations of the cut [-].
    steps: int = 40
    # How far from where it is expected the border between the arches is searched [mm], and iterations for that [-].
    arch_band_mm: float = 1.0
    arch_steps: int = 60
    # Weight of a person's mask in the colours [frames].
    key_weight: float = 12.0
    # Overlap with a finished mask below which a cut is wrong [-]: good ones reach 0.85 on the worst frames.
    key_overlap: float = 0.8
    # Fewest pixels that make a mask [px]: 4 square millimetres.
    least_px: int = 200


class ColourModel:
    """Learn the colours of teeth and of their surroundings, and rate colours by log-odds.

    What lies under projected crowns is teeth and, where lips, cheeks or tongue hide them, surroundings; what lies
    beyond them is surroundings. A logistic regression on the colours, their squares and products separates the two;
    what it finds to be surroundings under the crowns changes class, and it is fitted again. So few terms cannot follow
    colours of lips that happen to lie under crowns only.

    Colours are lightness and the logs of red and blue over green: shade scales all channels equally and leaves those
    (Finlayson et al. 2006), so that back teeth in the shade of the mouth look like the lit ones in front.
    """

    def __init__(self, memory: float) -> None:
        """Start without any colours; `memory` is the number of frames over which they are remembered."""
        self._keep = 1.0 - 1.0 / memory
        self._under = np.zeros((_BINS,) * 3)
        self._beyond = np.zeros((_BINS,) * 3)
        self._table: NDArray[np.float32] | None = None

    def learn(self, rgb: NDArray[np.uint8], under: Mask, beyond: Mask, weight: float = 1.0) -> None:
        """Update the histograms with a picture (h, w, 3): pixels (h, w) well inside and outside projected crowns."""
        index = _bins(rgb)
        for counts, where in ((self._under, under), (self._beyond, beyond)):
            new = np.bincount(index[where], minlength=_BINS**3).reshape(counts.shape)
            counts *= self._keep**weight
            counts += weight * new / max(1, where.sum())
        self._table = None

    def is_trained(self) -> bool:
        """Return whether any picture was seen."""
        return bool(self._under.any() and self._beyond.any())

    def counts(self) -> tuple[NDArray[np.int64], Array]:
        """Return all that was learned: colours seen, shape (N,), and their counts under and beyond, shape (2, N)."""
        both = np.stack([self._under.ravel(), self._beyond.ravel()])
        seen = np.flatnonzero(both.any(0))
        return seen, both[:, seen]

    def take_up(self, seen: NDArray[np.int64], counts: Array) -> None:
        """Restore what `counts` returned."""
        for into, known in zip((self._under, self._beyond), counts, strict=True):
            into.ravel()[:] = 0
            into.ravel()[seen] = known
        self._table = None

    def log_odds(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the log-odds of tooth against surroundings per pixel, shape (h, w)."""
        return self._odds()[_bins(rgb)]

    def surroundings_quantile(self, share: float) -> float:
        """Return the log-odds that the given share of the surroundings stays below."""
        odds, counts = self._odds(), self._beyond.ravel()
        order = np.argsort(odds)
        return float(odds[order[np.searchsorted(np.cumsum(counts[order]), share * counts.sum())]])

    def _odds(self) -> NDArray[np.float32]:
        if self._table is None:
            weights = _fitted_weights(self._under.ravel(), self._beyond.ravel())
            self._table = np.clip(_terms() @ weights, -_MOST, _MOST).astype(np.float32)
        return self._table


def shadeless(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the log of lightness and of red and blue over green of an 8-bit picture, shape (h, w, 3)."""
    red, green, blue = (_LOGS[rgb[..., k]] for k in range(3))
    return np.stack([(red + green + blue) / 3, red - green, blue - green], axis=-1)


_LOGS = np.log(np.arange(256, dtype=np.float32) + np.float32(_FLOOR))


def _bins(rgb: NDArray[np.uint8]) -> Indices:
    red, green, blue = (_LOGS[rgb[..., k]] for k in range(3))
    light = (rgb[..., 1].astype(np.intp) * _BINS) >> 8
    a, b = (
        np.clip((ratio * np.float32(1 / _RATIO_STEP)).astype(np.int32) + _BINS // 2, 0, _BINS - 1)
        for ratio in (red - green, blue - green)
    )
    return (light * _BINS + a) * _BINS + b


@cache
def _terms() -> Array:
    """Return the terms of the regression for the centre of every bin, shape (bins, 7).

    Lightness enters once: dark lips that happen to lie under crowns only must not teach that what is dark is tooth.
    """
    step = np.arange(_BINS) + 0.5
    light, ratio = np.log(step * 256 / _BINS + _FLOOR), (step - _BINS // 2) * _RATIO_STEP
    light, a, b = np.meshgrid(light, ratio, ratio, indexing="ij")
    # Brought to about unit spread.
    light, a, b = (light.ravel() - 4.6) / 0.5, (a.ravel() - 0.15) / 0.1, b.ravel() / 0.1
    return np.stack([np.ones_like(a), light, a, b, a**2, b**2, a * b], axis=1)


def _fitted_weights(under: Array, beyond: Array) -> Array:
    """Return the weights of the terms from the counts of every bin, shape (7,); darkness never counts for teeth."""
    seen = np.flatnonzero(under + beyond)
    x = _terms()[seen]
    under, beyond = (c[seen] / max(c.sum(), 1e-12) for c in (under, beyond))
    weights = _regress(x, under, beyond)
    if weights[_LIGHT] < 0:
        x[:, _LIGHT] = 0
        weights = _regress(x, under, beyond)
    return weights


def _regress(x: Array, under: Array, beyond: Array) -> Array:
    """Return the weights of terms (N, 7) that tell shares of two kinds (N,) apart, the first of them a mixture."""
    weights, ridge = np.zeros(x.shape[1]), _RIDGE * np.eye(x.shape[1])
    ridge[0, 0] = 1e-9
    tooth = np.ones(len(x))
    for _ in range(_ROUNDS):
        positive, negative = under * tooth, beyond + under * (1 - tooth)
        positive, negative = positive / max(positive.sum(), 1e-12), negative / max(negative.sum(), 1e-12)
        for _ in range(_STEPS):
            p = _logistic(x @ weights)
            gradient = x.T @ (positive * (1 - p) - negative * p) - ridge @ weights
            curvature = (x * ((positive + negative) * p * (1 - p))[:, None]).T @ x + ridge
            weights = weights + np.linalg.solve(curvature, gradient)
        tooth = _logistic(x @ weights)
    return weights


def _logistic(odds: Array) -> Array:
    return 1 / (1 + np.exp(-np.clip(odds, -30, 30)))


class ColourStates:
    """Save and restore the colours of all cameras."""

    def __init__(self, folder: Path, colours: Mapping[str, ColourModel]) -> None:
        """Take the folder of the files and the colours by camera."""
        self._folder, self._colours = folder, dict(colours)

    def keep(self, frame: int, step: int) -> None:
        """Write the colours after a frame.

        Raises:
            OutputError: the file cannot be written.
        """
        arrays: dict[str, ArrayLike] = {"frame": frame, "step": step}
        for name, model in self._colours.items():
            arrays[f"seen {name}"], arrays[f"counts {name}"] = model.counts()
        write_npz_atomic(self._folder / _FILES[frame % 2], arrays, packed=False)

    def take_up(self, done: int, step: int) -> int | None:
        """Restore the latest colours saved up to a frame that is done; step is 1 or -1, forwards or backwards.

        Returns the frame after which they were saved; None if there are none to resume from.
        """
        for frame in (done, done - step):
            path = self._folder / _FILES[frame % 2]
            kept = _stored(path)
            if kept is None or (int(kept["frame"]), int(kept["step"])) != (frame, step):
                continue
            for name, model in self._colours.items():
                model.take_up(np.asarray(kept[f"seen {name}"], np.int64), kept[f"counts {name}"])
            return frame
        return None


def _stored(path: Path) -> dict[str, Array] | None:
    """Return the arrays of a file; None where there is none, or it is damaged: the frames are then done again."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, *DAMAGED):
        return None


def state_files(folder: Path) -> list[Path]:
    """Return the files there may be in a folder."""
    return [folder / name for name in _FILES]
