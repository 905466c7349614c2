"""Figures over the frames of a take: its tracking, and the model's parameters and errors."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.evaluator import JawRig
from jawusd.formats.coverage import used_coverage
from jawusd.formats.model import JawModel
from jawusd.formats.tracks import LOST, PARTIAL, RECOVERED, TRACKED, Tracks
from jawusd.report.style import BLACK, BLUE, GREEN, GREY, ORANGE, SKY, VERMILION, new_figure

_COLUMNS = 1200  # points along the frames; longer takes show the extreme of every few frames
_LANES = ("tracked", "recovered", "without a camera", "lost", "aided by the model")
_LANE_COLORS = (GREEN, SKY, ORANGE, VERMILION, BLUE)


def tracking_figure(tracks: Tracks) -> Figure:
    """Draw state, distance of outlines, uncovered mask and expected error of every frame."""
    figure, axes = new_figure(11.0, 7.4, 4, 1, sharex=True, height_ratios=[1.15, 1, 1, 1])
    _draw_state(axes[0], tracks)
    residual = np.where(tracks.status == LOST, np.nan, tracks.residual_px)
    coverage = 100 * _mean_of_known(used_coverage(tracks), 2)
    for index, (name, color, style) in enumerate((("upper teeth", ORANGE, "-"), ("lower teeth", BLUE, "--"))):
        axes[1].plot(*thinned(tracks.frames, residual[:, index], np.fmax), style, color=color, lw=1, label=name)
        axes[2].plot(*thinned(tracks.frames, coverage[:, index], np.fmax), style, color=color, lw=1, label=name)
    axes[1].set_ylabel("distance of\noutlines [px]")
    axes[2].set_ylabel("mask left\nuncovered [%]")
    sigma = tracks.sigma_mm
    shown = (("incisor", 0, BLACK, "-"), ("left condyle", 3, VERMILION, "--"), ("right condyle", 4, GREEN, ":"))
    for name, index, color, style in shown:
        axes[3].plot(*thinned(tracks.frames, sigma[:, index], np.fmax), style, color=color, lw=1.1, label=name)
    axes[3].set_ylabel("expected error,\n1 sigma [mm]")
    axes[3].set_xlabel("frame of the reference camera")
    for axis in axes[1:]:
        axis.set_ylim(bottom=0)
        legend_beside(axis)
    return figure


def model_figure(model: JawModel) -> Figure:
    """Draw the parameters of every frame, their distances to the model and their margins."""
    rig = JawRig(model.arrays, model.meta)
    known = np.all(np.isfinite(model.d), axis=1)
    margin = np.full(len(model.d), np.nan)
    margin[known] = rig.margin(model.d[known])
    figure, axes = new_figure(11.0, 5.6, 3, 1, sharex=True, height_ratios=[1.5, 1, 1])
    shown = (("d1 opening", BLACK, "-"), ("d2 laterotrusion", BLUE, "--"), ("d3 protrusion", VERMILION, ":"))
    for index, (name, color, style) in enumerate(shown):
        axes[0].plot(*thinned(model.frames, model.d[:, index], farther), style, color=color, lw=1.2, label=name)
    axes[0].set_ylabel("parameter [mm]")
    axes[1].plot(*thinned(model.frames, model.residual_mm, np.fmax), color=BLUE, lw=1, label="pose to model")
    axes[1].axhline(rig.limits.residual_mm, color=VERMILION, lw=1, ls="--", label="limit of a valid pose")
    axes[1].set_ylabel("landmarks,\nrms [mm]")
    axes[1].set_ylim(bottom=0)
    axes[2].plot(*thinned(model.frames, margin, np.fmin), color=BLUE, lw=1, label="margin to the bound")
    axes[2].axhline(0.0, color=GREY, lw=0.8, label="the bound")
    axes[2].axhline(-rig.tolerance_mm, color=VERMILION, lw=1, ls="--", label="tolerance of measured poses")
    axes[2].set_ylabel("margin [mm]")
    axes[2].set_xlabel("frame of the reference camera")
    for axis in axes:
        legend_beside(axis)
    return figure


def _draw_state(axis: Axes, tracks: Tracks) -> None:
    """Draw a lane per state, in each the upper teeth above the lower, so that it is legible without colour."""
    states = [tracks.status == value for value in (TRACKED, RECOVERED, PARTIAL, LOST)]
    states.append(np.repeat(tracks.prior_aided[:, None], 2, axis=1))
    for lane, (has, color) in enumerate(zip(states, _LANE_COLORS, strict=True)):
        for arch, low in ((0, 0.04), (1, -0.4)):
            spans = runs(tracks.frames, has[:, arch])
            axis.broken_barh(spans, (low - lane, 0.36), facecolors=color, edgecolors=color, linewidth=0.8)
        axis.axhline(-lane - 0.5, color=GREY, lw=0.4)
    shares = [f"{name}  {int(has.any(1).sum())}" for name, has in zip(_LANES, states, strict=True)]
    axis.set_yticks([-lane for lane in range(len(_LANES))], shares)
    axis.set_ylim(0.5 - len(_LANES), 0.5)
    axis.set_title("frames in each state (upper half of a bar: upper teeth, lower half: lower teeth)", loc="left")


def runs(frames: NDArray[np.int64], has: Mask) -> list[tuple[float, float]]:
    """Return the spans (start, width) of consecutive frames with a property."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], has, [False]]).astype(np.int8)))
    spans = zip(edges[::2], edges[1::2], strict=True)
    return [(float(frames[a]) - 0.5, float(frames[b - 1] - frames[a]) + 1.0) for a, b in spans]


def _mean_of_known(values: Array, axis: int) -> Array:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # frames without any mask have no mean
        return np.nanmean(values, axis=axis)


def farther(a: Array, b: Array) -> Array:
    """Return the value of two that is farther from zero and not NaN."""
    return np.where(np.isnan(a) | (np.abs(b) > np.abs(a)), b, a)


def thinned(frames: NDArray[np.int64], values: Array, keep: Callable[[Array, Array], Array]) -> tuple[Array, Array]:
    """Return at most `_COLUMNS` points (frames, values), reducing every few frames by `keep`."""
    step = -(-len(frames) // _COLUMNS)
    if step <= 1:
        return frames.astype(np.float64), values
    starts = np.arange(0, len(frames), step)
    chosen = values[starts]
    for offset in range(1, step):
        later = np.full(len(starts), np.nan)
        inside = starts + offset < len(values)
        later[inside] = values[starts[inside] + offset]
        chosen = keep(chosen, later)
    return frames[starts].astype(np.float64), chosen


def legend_beside(axis: Axes) -> None:
    """Put the legend to the right of a plot."""
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
