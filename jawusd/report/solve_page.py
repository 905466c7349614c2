"""Write the report on a solved performance as one self-contained HTML file with figures."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import ArrayLike, NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import FormatError
from jawusd.evaluator.verdicts import is_inside
from jawusd.formats.finding import Finding
from jawusd.formats.performance import STATE_WORDS, SolvedJaw, SolveState
from jawusd.formats.report import SolveReportData
from jawusd.formats.tracks import LOST, Tracks
from jawusd.report.figures import legend_beside, name_lanes, runs, thinned
from jawusd.report.style import BLACK, BLUE, GREEN, GREY, MAGENTA, ORANGE, SKY, VERMILION, inline_svg, new_figure
from jawusd.report.templates import rendered

#: Colours of the solve states: close to those of the outlines in the images, but legible on light and dark pages.
STATE_INKS = {SolveState.SOLVED: GREEN, SolveState.SKIN: SKY, SolveState.CARRIED: ORANGE, SolveState.LOST: MAGENTA}
_NAMES = ("d1 opening", "d2 laterotrusion,\nleft is positive", "d3 protrusion,\nforward is positive")
_INKS = (BLACK, BLUE, VERMILION)
_STYLES = ("-", "--", ":")
_BAND = 2.0  # half width of the error band [sigma]; it contains 95 % of normally distributed errors
_UNOBSERVED = (SolveState.SKIN, SolveState.CARRIED, SolveState.LOST)
_LISTED = 60  # maximum number of runs in the table


def jaw_figure(tracks: Tracks, solved: SolvedJaw, fps: float) -> Figure:
    """Plot d with a band of two sigma, sigma itself, and the margin to the bound, with unobserved frames shaded."""
    frames = tracks.frames
    figure, axes = new_figure(11.0, 9.6, 5, 1, sharex=True, height_ratios=[1.4, 1, 1, 0.8, 1])
    for axis, name, ink, value, sigma in zip(axes, _NAMES, _INKS, solved.d.T, solved.sigma_mm.T, strict=False):
        at, low = thinned(frames, value - _BAND * sigma, np.fmin)
        high = thinned(frames, value + _BAND * sigma, np.fmax)[1]
        axis.fill_between(at, low, high, color=ink, alpha=0.25, linewidth=0, label="95 % (2 sigma)")
        axis.plot(*thinned(frames, value), color=ink, lw=1.2, label="solved")
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
    shades = [Patch(color=STATE_INKS[state], alpha=0.3, label=STATE_WORDS[state]) for state in _UNOBSERVED]
    figure.legend(handles=shades, loc="outside upper right", ncols=3, frameon=False)
    return figure


def observation_figure(tracks: Tracks, solved: SolvedJaw, fps: float) -> Figure:
    """Plot the state and verdict of every frame, and the masks used per camera and arch."""
    frames, names = tracks.frames, tracks.camera_names
    lanes = [(str(state), solved.state == state, ink) for state, ink in STATE_INKS.items()]
    lanes.append(("within tolerance", solved.valid & ~is_inside(solved.margin_mm), GREY))
    lanes.append(("outside", ~solved.valid, VERMILION))
    height = 0.36 * (len(lanes) + len(names)) + 1.5
    figure, axes = new_figure(11.0, height, 2, 1, sharex=True, height_ratios=[len(lanes), max(len(names), 1)])
    for lane, (_, has, ink) in enumerate(lanes):
        axes[0].broken_barh(runs(frames, has), (-lane - 0.4, 0.8), facecolors=ink, edgecolors=ink, linewidth=0.8)
    name_lanes(axes[0], [f"{name}  {int(has.sum())}" for name, has, _ in lanes])
    axes[0].set_title("frames in each state", loc="left")
    for lane in range(len(names)):
        for arch, low in ((0, 0.02), (1, -0.4)):
            spans = runs(frames, tracks.masks_used[:, arch, lane] & (tracks.status[:, arch] != LOST))
            axes[1].broken_barh(spans, (low - lane, 0.38), facecolors=BLUE, edgecolors=BLUE, linewidth=0.8)
    used = tracks.masks_used.any(axis=1).sum(axis=0) if len(names) else []
    name_lanes(axes[1], [f"{name}  {count}" for name, count in zip(names, used, strict=True)])
    axes[1].set_title("masks used (upper half of a bar: upper teeth, lower half: lower teeth)", loc="left")
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
    for state in _UNOBSERVED:
        spans = runs(frames, solved.state == state)
        over = axis.get_xaxis_transform()
        axis.broken_barh(spans, (0, 1), transform=over, facecolors=STATE_INKS[state], alpha=0.22, linewidth=0, zorder=0)


def _label_frames(top: Axes, bottom: Axes, fps: float) -> None:
    """Label a time axis: frame numbers below the plots, seconds above."""
    bottom.set_xlabel("frame of the reference camera")
    seconds = top.secondary_xaxis("top", functions=(partial(_scaled, factor=1 / fps), partial(_scaled, factor=fps)))
    seconds.set_xlabel("time [s]")


def _scaled(value: ArrayLike, factor: float) -> Array:
    return np.asarray(value, np.float64) * factor


class UnobservedRun(NamedTuple):
    """A run of consecutive frames in which an arch was not found."""

    first: int
    last: int
    seconds: str
    cause: str
    arches: str
    sigma: str


def solve_page(data: SolveReportData) -> str:
    """Return the report as HTML, with text from files escaped; raises FormatError if the tracks have no solve."""
    solved = data.tracks.solved
    if solved is None:
        raise FormatError("has no solved performance.", hint="Pass the .npz written by `jawusd solve`.")
    findings = list(dict.fromkeys(Finding.from_json(one).line() for one in data.tracks.meta.get("findings", [])))
    unobserved = unobserved_runs(data, solved)
    return rendered(
        "solve.html.j2",
        data=data,
        counts=_counts(solved),
        sentence=_sentence(solved, bool(findings)),
        jaw=_jaw_rows(solved),
        figures=_figures(data, solved),
        unobserved=unobserved[:_LISTED],
        more=max(len(unobserved) - _LISTED, 0),
        cameras=_cameras(data),
        findings=findings,
    )


def unobserved_runs(data: SolveReportData, solved: SolvedJaw) -> list[UnobservedRun]:
    """Return the runs of consecutive frames in which an arch was not found; all frames of a run have the same state."""
    frames, found = data.tracks.frames, []
    breaks = np.flatnonzero((np.diff(solved.state) != 0) | (np.diff(frames) != 1)) + 1
    for rows in np.split(np.arange(len(frames)), breaks):
        if not len(rows) or solved.state[rows[0]] == SolveState.SOLVED:
            continue
        state = SolveState(int(solved.state[rows[0]]))
        lost = (data.tracks.status[rows] == LOST).any(axis=0)
        arches = [name for name, is_lost in zip(("upper", "lower"), lost, strict=True) if is_lost]
        first, last = int(frames[rows[0]]), int(frames[rows[-1]])
        worst = ", ".join(f"{value:.2f}" for value in solved.sigma_mm[rows].max(axis=0))
        seconds = f"{first / data.fps:.2f} to {(last + 1) / data.fps:.2f}"
        found.append(UnobservedRun(first, last, seconds, STATE_WORDS[state], " and ".join(arches), worst))
    return found


def _figures(data: SolveReportData, solved: SolvedJaw) -> dict[str, Markup]:
    if not len(data.tracks.frames):
        return {}
    return {
        "jaw": inline_svg(jaw_figure(data.tracks, solved, data.fps), "jaw", "d, sigma and margin of every frame."),
        "seen": inline_svg(
            observation_figure(data.tracks, solved, data.fps), "seen", "State of every frame and masks used."
        ),
    }


def _counts(solved: SolvedJaw) -> list[tuple[str, int, str, str]]:
    """Return (name, frames, percentage, meaning) of every state and verdict."""
    interpolated = "the pose is interpolated from neighbouring frames"
    tolerated = "the pose lies outside the rig's bound, but within the tolerance of measured poses"
    rows = (
        ("solved", solved.state == SolveState.SOLVED, "both arches were found in the masks"),
        ("skin", solved.state == SolveState.SKIN, "an arch was not found; d is estimated from facial skin"),
        ("carried", solved.state == SolveState.CARRIED, "an arch was hidden; its pose is interpolated"),
        ("lost", solved.state == SolveState.LOST, f"the masks match no pose; {interpolated}"),
        ("within tolerance", solved.valid & ~is_inside(solved.margin_mm), tolerated),
        ("outside", ~solved.valid, "the pose is invalid for the rig"),
    )
    total = max(len(solved.state), 1)
    return [(name, int(has.sum()), f"{100 * has.sum() / total:.1f} %", words) for name, has, words in rows]


def _sentence(solved: SolvedJaw, has_findings: bool) -> str:
    """Return a sentence on what to inspect, based only on the verdicts in the tracks."""
    outside = "some poses lie outside the rig's bound: the masks are wrong, or the subject exceeded the captured range"
    error, states = "see their sigma for the expected error", set(solved.state.tolist())
    said = (
        (SolveState.LOST in states, "some frames are lost: inspect their masks"),
        (SolveState.SKIN in states, f"some frames are estimated from facial skin: {error}"),
        (SolveState.CARRIED in states, f"some frames are interpolated from their neighbours: {error}"),
        (not solved.valid.all(), outside),
        (has_findings, "there are findings"),
    )
    text = "; ".join(words for holds, words in said if holds)
    if not text:
        return "Both arches were found in every frame, and every pose is valid for the rig."
    return f"{text[0].upper()}{text[1:]}."


def _jaw_rows(solved: SolvedJaw) -> list[tuple[str, str, str, str, str]]:
    """Return rows of (parameter, minimum, maximum, median sigma over solved frames, maximum sigma) in mm."""
    names = ("d1 opening", "d2 laterotrusion (left is positive)", "d3 protrusion (forward is positive)")
    seen = solved.state == SolveState.SOLVED
    rows = []
    for name, value, sigma in zip(names, solved.d.T, solved.sigma_mm.T, strict=True):
        typical = f"{np.median(sigma[seen]):.3f}" if seen.any() else ""
        if len(value):
            rows.append((name, f"{value.min():.2f}", f"{value.max():.2f}", typical, f"{sigma.max():.2f}"))
    return rows


def _cameras(data: SolveReportData) -> list[dict[str, str]]:
    """Return a table row per camera: footage, masks, number of frames used, and focal length."""
    tracks, known = data.tracks, {camera.name: camera for camera in data.cameras}
    rows = []
    for name in (*tracks.camera_names, *(name for name in known if name not in tracks.camera_names)):
        facts = known.get(name)
        used = ""
        if name in tracks.camera_names:
            counts = tracks.masks_used[:, :, tracks.camera_names.index(name)].sum(axis=0)
            used = f"{counts[0]} / {counts[1]}"
        focal = tracks.meta.get("focal", {}).get(name)
        rows.append(
            {
                "name": name,
                "video": facts.video if facts else "",
                "masks": facts.masks if facts else "",
                "size": f"{facts.size_px[0]} \u00d7 {facts.size_px[1]}" if facts else "",
                "used": used or "not used",
                "focal": "" if focal is None else f"{focal[0]:.4f} \u00b1 {focal[1]:.4f}",
            }
        )
    return rows
