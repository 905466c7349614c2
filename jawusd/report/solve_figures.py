"""Figures of a solved performance over its frames: d with sigma, the margin, and what could be seen."""

from __future__ import annotations

from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import ArrayLike, NDArray

from jawusd.base.arrays import Array
from jawusd.evaluator.verdicts import is_inside
from jawusd.formats.performance import STATE_WORDS, SolveState
from jawusd.formats.solved import SolvedJaw
from jawusd.formats.tracks import LOST, Tracks
from jawusd.report.style import BLACK, BLUE, GREEN, GREY, MAGENTA, ORANGE, VERMILION, new_figure
from jawusd.report.timeline import farther, legend_beside, runs, thinned

#: Of the states, as near to the colours in the pictures as figures in light and dark pages allow.
STATE_INKS = {SolveState.SOLVED: GREEN, SolveState.CARRIED: ORANGE, SolveState.LOST: MAGENTA}
_NAMES = ("d1 opening", "d2 laterotrusion,\nleft is positive", "d3 protrusion,\nforward is positive")
_INKS = (BLACK, BLUE, VERMILION)
_STYLES = ("-", "--", ":")
_BAND = 2.0  # sigmas: 95 % of normal errors
_UNSEEN = (SolveState.CARRIED, SolveState.LOST)


def jaw_figure(tracks: Tracks, solved: SolvedJaw, fps: float) -> Figure:
    """Draw d with a band of two sigmas, its sigma and the margin of every frame; what was not seen is shaded."""
    frames = tracks.frames
    figure, axes = new_figure(11.0, 9.6, 5, 1, sharex=True, height_ratios=[1.4, 1, 1, 0.8, 1])
    for axis, name, ink, value, sigma in zip(axes, _NAMES, _INKS, solved.d.T, solved.sigma_mm.T, strict=False):
        at, low = thinned(frames, value - _BAND * sigma, np.fmin)
        high = thinned(frames, value + _BAND * sigma, np.fmax)[1]
        axis.fill_between(at, low, high, color=ink, alpha=0.25, linewidth=0, label="95 % (2 sigma)")
        axis.plot(*thinned(frames, value, farther), color=ink, lw=1.2, label="solved")
        axis.set_ylabel(f"{name} [mm]")
    for name, ink, style, sigma in zip(("d1", "d2", "d3"), _INKS, _STYLES, solved.sigma_mm.T, strict=True):
        axes[3].plot(*thinned(frames, np.maximum(sigma, 1e-4), np.fmax), style, color=ink, lw=1.1, label=name)
    axes[3].set_yscale("log")
    axes[3].yaxis.set_major_formatter("{x:g}")
    axes[3].set_ylabel("expected error,\n1 sigma [mm]")
    _draw_margin(axes[4], tracks, solved)
    for axis in axes:
        _shade(axis, frames, solved)
        legend_beside(axis)
    _label_frames(axes[0], axes[-1], fps)
    shades = [Patch(color=STATE_INKS[state], alpha=0.3, label=STATE_WORDS[state]) for state in _UNSEEN]
    figure.legend(handles=shades, loc="outside upper right", ncols=2, frameon=False)
    return figure


def seen_figure(tracks: Tracks, solved: SolvedJaw, fps: float) -> Figure:
    """Draw the state and verdict of every frame, and which masks of each camera took part, arch by arch."""
    frames, names = tracks.frames, tracks.camera_names
    lanes = [(str(state), solved.state == state, ink) for state, ink in STATE_INKS.items()]
    lanes.append(("within tolerance", solved.valid & ~is_inside(solved.margin_mm), GREY))
    lanes.append(("outside", ~solved.valid, VERMILION))
    height = 0.36 * (len(lanes) + len(names)) + 1.5
    figure, axes = new_figure(11.0, height, 2, 1, sharex=True, height_ratios=[len(lanes), max(len(names), 1)])
    for lane, (_, has, ink) in enumerate(lanes):
        axes[0].broken_barh(runs(frames, has), (-lane - 0.4, 0.8), facecolors=ink, edgecolors=ink, linewidth=0.8)
    _name_lanes(axes[0], [f"{name}  {int(has.sum())}" for name, has, _ in lanes])
    axes[0].set_title("frames in each state", loc="left")
    for lane in range(len(names)):
        for arch, low in ((0, 0.02), (1, -0.4)):
            spans = runs(frames, tracks.masks_used[:, arch, lane] & (tracks.status[:, arch] != LOST))
            axes[1].broken_barh(spans, (low - lane, 0.38), facecolors=BLUE, edgecolors=BLUE, linewidth=0.8)
    used = tracks.masks_used.any(axis=1).sum(axis=0) if len(names) else []
    _name_lanes(axes[1], [f"{name}  {count}" for name, count in zip(names, used, strict=True)])
    axes[1].set_title("masks that took part (upper half of a bar: upper teeth, lower half: lower teeth)", loc="left")
    _label_frames(axes[0], axes[1], fps)
    return figure


def _draw_margin(axis: Axes, tracks: Tracks, solved: SolvedJaw) -> None:
    at, margin = thinned(tracks.frames, solved.margin_mm, np.fmin)
    axis.plot(at, margin, color=BLUE, lw=1.1, label="margin to the bound")
    axis.fill_between(at, np.fmin(margin, 0.0), 0.0, color=VERMILION, linewidth=0, alpha=0.6, label="outside")
    axis.axhline(0.0, color=GREY, lw=0.8)
    if "tolerance_mm" in tracks.meta:
        tolerance = -tracks.meta["tolerance_mm"]
        axis.axhline(tolerance, color=VERMILION, lw=1, ls="--", label="tolerance of measured poses")
    axis.set_ylabel("margin [mm],\ninside is positive")


def _shade(axis: Axes, frames: NDArray[np.int64], solved: SolvedJaw) -> None:
    for state in _UNSEEN:
        spans = runs(frames, solved.state == state)
        over = axis.get_xaxis_transform()
        axis.broken_barh(spans, (0, 1), transform=over, facecolors=STATE_INKS[state], alpha=0.22, linewidth=0, zorder=0)


def _name_lanes(axis: Axes, names: list[str]) -> None:
    axis.set_yticks([-lane for lane in range(len(names))], names)
    axis.set_ylim(0.5 - len(names), 0.5)
    for lane in range(len(names)):
        axis.axhline(-lane - 0.5, color=GREY, lw=0.4)


def _label_frames(top: Axes, bottom: Axes, fps: float) -> None:
    """Write frames below and seconds above."""
    bottom.set_xlabel("frame of the reference camera")
    seconds = top.secondary_xaxis("top", functions=(partial(_scaled, factor=1 / fps), partial(_scaled, factor=fps)))
    seconds.set_xlabel("time [s]")


def _scaled(value: ArrayLike, factor: float) -> Array:
    return np.asarray(value, np.float64) * factor
