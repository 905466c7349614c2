"""Figures of a build over its frames, of the synchronisation, of ranges of motion, and of verdicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import shown
from jawusd.evaluator import JawRig
from jawusd.evaluator.motions import motions_of_poses
from jawusd.evaluator.verdicts import Verdicts
from jawusd.formats.clips import LightCurve
from jawusd.formats.model import JawModel
from jawusd.formats.tracks import LOST, PARTIAL, RECOVERED, TRACKED, Tracks, uncovered_percent
from jawusd.geometry import so3_log, transform_point, transform_points
from jawusd.report.style import BLACK, BLUE, GREEN, GREY, ORANGE, SKY, VERMILION, new_figure, write_figure
from jawusd.report.verdicts import GOOD, LOOK

_COLUMNS = 1200  # maximum number of points per curve; in longer takes, groups of frames are reduced to their extremes
_LANES = ("tracked", "recovered", "without a camera", "lost", "regularised")
_LANE_COLORS = (GREEN, SKY, ORANGE, VERMILION, BLUE)
_COLOURS = (BLUE, ORANGE, GREEN, VERMILION, SKY, BLACK, GREY)
_AROUND_FRAMES = 12  # number of frames drawn before and after a flash
_APART_FRAMES = 48  # maximum number of frames between the two light steps of one flash
_QUANTILE = 99.5  # percentile taken as the end of a range of motion, robust to single outliers
_NEAR_CLOSED_MM = 5.0  # maximum opening at which protrusion is measured, as in clinical practice


RANGES = "ranges"  # file name of the figure that compares several actors

_PARAMETERS = {
    "opening": ("opening d1", BLUE),
    "laterotrusion": ("laterotrusion d2, + left", GREEN),
    "protrusion": ("protrusion d3, + forward", SKY),
}
_ROW_IN, _MARGINS_IN = 0.22, 0.9
_MOST_ROWS = 400  # maximum number of actors in the figure; common programs cannot open taller images


def tracking_figure(tracks: Tracks) -> Figure:
    """Plot the state, outline distance, uncovered mask fraction and expected error of every frame."""
    figure, axes = new_figure(11.0, 7.4, 4, 1, sharex=True, height_ratios=[1.15, 1, 1, 1])
    _draw_state(axes[0], tracks)
    residual = np.where(tracks.status == LOST, np.nan, tracks.residual_px)
    coverage = uncovered_percent(tracks)
    for index, (name, color, style) in enumerate((("upper teeth", ORANGE, "-"), ("lower teeth", BLUE, "--"))):
        axes[1].plot(*thinned(tracks.frames, residual[:, index], np.fmax), style, color=color, lw=1, label=name)
        axes[2].plot(*thinned(tracks.frames, coverage[:, index], np.fmax), style, color=color, lw=1, label=name)
    axes[1].set_ylabel("outline\ndistance [px]")
    axes[2].set_ylabel("uncovered\nmask [%]")
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
    """Plot the jaw parameters of every frame, the distance of its poses from the model, and its margin to the bound."""
    rig = JawRig(model.arrays, model.meta)
    known = np.all(np.isfinite(model.d), axis=1)
    margin = np.full(len(model.d), np.nan)
    margin[known] = rig.margin(model.d[known])
    figure, axes = new_figure(11.0, 5.6, 3, 1, sharex=True, height_ratios=[1.5, 1, 1])
    shown = (("d1 opening", BLACK, "-"), ("d2 laterotrusion", BLUE, "--"), ("d3 protrusion", VERMILION, ":"))
    for index, (name, color, style) in enumerate(shown):
        axes[0].plot(*thinned(model.frames, model.d[:, index]), style, color=color, lw=1.2, label=name)
    axes[0].set_ylabel("parameter [mm]")
    axes[1].plot(*thinned(model.frames, model.residual_mm, np.fmax), color=BLUE, lw=1, label="distance from the model")
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
    """Draw one lane per tracking state, upper teeth above lower teeth, so that the plot is legible without colour."""
    states = [tracks.status == value for value in (TRACKED, RECOVERED, PARTIAL, LOST)]
    states.append(np.repeat(tracks.prior_aided[:, None], 2, axis=1))
    for lane, (has, color) in enumerate(zip(states, _LANE_COLORS, strict=True)):
        for arch, low in ((0, 0.04), (1, -0.4)):
            spans = runs(tracks.frames, has[:, arch])
            axis.broken_barh(spans, (low - lane, 0.36), facecolors=color, edgecolors=color, linewidth=0.8)
    name_lanes(axis, [f"{name}  {int(has.any(1).sum())}" for name, has in zip(_LANES, states, strict=True)])
    axis.set_title("frames in each state (upper half of a bar: upper teeth, lower half: lower teeth)", loc="left")


def name_lanes(axis: Axes, names: list[str]) -> None:
    """Name the lanes of a plot, which are one unit high, downwards from 0, and separate them by lines."""
    axis.set_yticks([-lane for lane in range(len(names))], names)
    axis.set_ylim(0.5 - max(len(names), 1), 0.5)
    for lane in range(len(names)):
        axis.axhline(-lane - 0.5, color=GREY, lw=0.4)


def runs(frames: NDArray[np.int64], has: Mask) -> list[tuple[float, float]]:
    """Return the ranges (start, width) of consecutive frames for which a mask is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], has, [False]]).astype(np.int8)))
    spans = zip(edges[::2], edges[1::2], strict=True)
    return [(float(frames[a]) - 0.5, float(frames[b - 1] - frames[a]) + 1.0) for a, b in spans]


def thinned(frames: NDArray[np.int64], values: Array, keep: np.ufunc | None = None) -> tuple[Array, Array]:
    """Return at most `_COLUMNS` points (frames, values); of several frames, the largest magnitude, or by `keep`."""
    step = -(-len(frames) // _COLUMNS)
    if step <= 1:
        return frames.astype(np.float64), values
    starts = np.arange(0, len(frames), step)
    if keep is None:
        low, high = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
        return frames[starts].astype(np.float64), np.where(-low > high, low, high)
    return frames[starts].astype(np.float64), keep.reduceat(values, starts)


def legend_beside(axis: Axes) -> None:
    """Place the legend to the right of a plot."""
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


def sync_figure(curves: Mapping[str, LightCurve], offsets: Mapping[str, int] | None, title: str) -> Figure:
    """Plot the brightness of all clips, in full and around the first and last flash, as recorded and aligned.

    Frame k of a camera is simultaneous with frame k + offset of the reference camera; without offsets, there is only
    the row of plots as recorded.
    """
    rows: list[tuple[str, str, Mapping[str, int]]] = [("as recorded", "frame of each camera", dict.fromkeys(curves, 0))]
    if offsets is not None:
        rows.append(("aligned", "frame of the reference camera", offsets))
    flashes = [_flashes(curves, shifts) for _, _, shifts in rows]
    columns = 1 + max(map(len, flashes))
    figure, axes = new_figure(4.5 + 3.2 * (columns - 1), 2.9 * len(rows), len(rows), columns, sharey=True)
    for r, (words, xlabel, shifts) in enumerate(rows):
        for c, axis in enumerate(axes[r * columns : (r + 1) * columns]):
            if c > len(flashes[r]):
                axis.set_axis_off()
                continue
            _draw_curves(axis, curves, shifts, close=c > 0)
            axis.set_xlabel(xlabel)
            axis.set_title(f"{words}, {('whole clips', 'first flash', 'last flash')[c]}")
            if c:
                axis.set_xlim(*flashes[r][c - 1])
        axes[r * columns].set_ylabel("mean brightness, 0 .. 255")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
    figure.suptitle(title, fontsize=10)
    return figure


def _draw_curves(axis: Axes, curves: Mapping[str, LightCurve], shifts: Mapping[str, int], close: bool) -> None:
    """Draw the brightness of each camera as a curve, with markers where the light went off or on."""
    for k, (name, curve) in enumerate(curves.items()):
        colour = _COLOURS[k % len(_COLOURS)]
        frames = curve.frames + shifts[name]
        axis.plot(frames, curve.brightness, color=colour, lw=1.0, label=name, marker="." if close else "", ms=4)
        for steps, mark in ((curve.off_frames, "v"), (curve.on_frames, "^")):
            height = np.interp(steps, curve.frames, curve.brightness)
            axis.plot(steps + shifts[name], height, mark, color=colour, ms=7, mec="white", mew=0.6)
    # One legend entry per kind of marker, shared by all cameras.
    axis.plot([], [], "v", color=GREY, label="light off")
    axis.plot([], [], "^", color=GREY, label="light on")
    axis.set_ylim(0, 255)


def _flashes(curves: Mapping[str, LightCurve], shifts: Mapping[str, int]) -> list[tuple[float, float]]:
    """Return the frame ranges of the first and last flash of all cameras; empty without flashes."""
    steps = np.sort(np.concatenate([np.append(c.off_frames, c.on_frames) + shifts[name] for name, c in curves.items()]))
    if not len(steps):
        return []
    parts = np.split(steps, np.flatnonzero(np.diff(steps) > _APART_FRAMES) + 1)
    ends = [parts[0]] if len(parts) == 1 else [parts[0], parts[-1]]
    return [(float(part[0]) - _AROUND_FRAMES, float(part[-1]) + _AROUND_FRAMES) for part in ends]


@dataclass(frozen=True)
class RangeRow:
    """Range of one jaw movement, compared with that of about 95 % of people; the grade is "good" or "look"."""

    name: str
    found: str
    usual: str
    source: str
    remark: str
    grade: str


# Usual minimum and maximum: mean -+ 2 SD, or the extremes over both sexes if they were published separately.
_REFERENCE = {
    "opening at the incisors": (
        36.0,
        70.0,
        "mm",
        "51.3 \u00b1 8.3 (men), 44.3 \u00b1 6.7 (women), n = 894, PMC3428458",
    ),
    "laterotrusion to the left": (6.0, 15.2, "mm", "10.6 \u00b1 2.3, n = 1011, Hirsch 2006"),
    "laterotrusion to the right": (5.8, 14.6, "mm", "10.2 \u00b1 2.2, n = 1011, Hirsch 2006"),
    "protrusion": (3.2, 13.2, "mm", "8.2 \u00b1 2.5, n = 1011, Hirsch 2006"),
    "rotation": (27.7, 50.9, "deg", "39.1 \u00b1 5.9 (men), 36.3 \u00b1 4.3 (women), Muto & Kanazawa 1996"),
    "travel of the left condyle": (12.5, 28.5, "mm", "20.5 \u00b1 4.0 (men), 18.1 \u00b1 2.5 (women), same"),
    "travel of the right condyle": (12.5, 28.5, "mm", "20.5 \u00b1 4.0 (men), 18.1 \u00b1 2.5 (women), same"),
}


def human_ranges(tracks: Tracks, model: JawModel) -> list[RangeRow]:
    """Return the ranges of motion in the poses used for the fit, one row per movement; empty without poses."""
    T = tracks.raw_T_upper_lower
    used = np.isin(tracks.frames, model.frames[model.trained]) & np.all(np.isfinite(T), axis=(1, 2))
    if not used.any():
        return []
    A, rest = model.arrays["T_anatomical_skull"], model.arrays["T_rest"]
    found = _measured(motions_of_poses(T[used], A, rest), transform_points(A @ rest, model.arrays["landmarks"]))
    return [_row(name, value) for name, value in zip(_REFERENCE, found, strict=True)]


def _measured(motion: Array, landmarks: Array) -> list[float]:
    u = transform_point(motion, landmarks[0]) - landmarks[0]
    near = u[-u[:, 1] < _NEAR_CLOSED_MM]
    turns = np.rad2deg(np.linalg.norm(so3_log(motion[:, :3, :3]), axis=-1))
    travels = [np.linalg.norm(transform_point(motion, point) - point, axis=-1) for point in landmarks[3:]]
    forward = near[:, 2] if len(near) else np.zeros(1)
    return [float(np.percentile(v, _QUANTILE)) for v in (-u[:, 1], u[:, 0], -u[:, 0], forward, turns, *travels)]


def _row(name: str, value: float) -> RangeRow:
    low, high, unit, source = _REFERENCE[name]
    if value < low:
        remark, grade = "less than usual: the take may not contain the full range", LOOK
    elif value > high:
        remark, grade = "more than usual", LOOK
    else:
        remark, grade = "usual", GOOD
    return RangeRow(name, f"{value:.1f} {unit}", f"{low:g} to {high:g} {unit}", source, remark, grade)


def ranges_figure(people: Sequence[tuple[str, dict[str, list[float]]]]) -> Figure:
    """Draw the ranges of motion of actors as bars, one row per actor and one column per parameter.

    `people` are the name of each actor, and lowest and highest value [mm] by the keys of `_PARAMETERS`; only the first
    400 are drawn.
    """
    drawn = list(people)[:_MOST_ROWS]
    figure, axes = new_figure(9.0, _MARGINS_IN + _ROW_IN * max(len(drawn), 2), 1, 3, sharey=True)
    rows = range(len(drawn))
    for axis, (key, (title, color)) in zip(axes, _PARAMETERS.items(), strict=True):
        ends = [ranges[key] for _, ranges in drawn]
        axis.barh(rows, [high - low for low, high in ends], left=[low for low, _ in ends], color=color, height=0.7)
        axis.axvline(0.0, color=BLACK, lw=0.8)
        axis.set(title=title, xlabel="[mm]")
    axes[0].set_yticks(rows, [shown(name)[:30] for name, _ in drawn])
    axes[0].invert_yaxis()
    return figure


_INKS = (GREEN, ORANGE, VERMILION)
_WORDS = ("inside", "within tolerance", "invalid")


def save_strip(path: Path, frames: Array, verdicts: Verdicts) -> None:
    """Write an image of verdicts on frames (F,): green is inside, amber within the tolerance, red invalid.

    Plots of the margin to the bound and of the distance from the model [mm] are below the strip. Raises OutputError.
    """
    kind = np.where(verdicts.valid, np.where(verdicts.inside(), 0, 1), 2)
    figure, (strip, lines) = new_figure(9.0, 2.6, 2, 1, sharex=True, height_ratios=[1.0, 3.0])
    for index, ink in enumerate(_INKS):
        strip.bar(frames[kind == index], 1.0, width=1.0, color=ink)
    strip.set_yticks([])
    strip.set_ylim(0.0, 1.0)
    counts = [f"{words} {int((kind == index).sum())}" for index, words in enumerate(_WORDS)]
    handles = [Patch(color=ink, label=label) for ink, label in zip(_INKS, counts, strict=True)]
    strip.legend(handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False)
    lines.plot(frames, verdicts.margin_mm, color="black", label="margin to the bound")
    lines.plot(frames, verdicts.residual_mm, color="grey", linestyle="--", label="distance from the model")
    lines.axhline(-verdicts.tolerance_mm, color="grey", linewidth=0.5)
    lines.set_xlabel("frame")
    lines.set_ylabel("mm")
    lines.legend(frameon=False)
    write_figure(path, figure, "png")
