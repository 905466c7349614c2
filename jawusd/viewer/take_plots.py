"""Plots of a take: mask coverage of tracked poses, or the solved jaw with its error bands."""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator.verdicts import place as place_of
from jawusd.formats.performance import STATE_COLOURS, STATE_WORDS, SolvedJaw, SolveState
from jawusd.formats.tracks import LOST, PARTIAL, RECOVERED, TRACKED, Tracks, uncovered_percent, worst_frames
from jawusd.viewer.plots import (
    BLUE,
    CURVE_COLORS,
    ORANGE,
    VERMILION,
    Plot,
    drawn,
    framed,
    path_through,
    place,
)

_MOST_WORST = 12
_STATUS: dict[int, str] = {
    LOST: "lost",
    TRACKED: "tracked",
    RECOVERED: "recovered",
    PARTIAL: "tracked without one camera",
}
_COLORS = (ORANGE, BLUE)  # colours of the upper and lower arch, as in the outlines drawn into the images
_NAMES = ("d1 opening", "d2 laterotrusion", "d3 protrusion")
_BAND = 2.0  # half width of the bands [sigma]: 95 % of normally distributed errors
_MOST_SAMPLES = 400
_STRIP_PX = 6


def frames_to_inspect(tracks: Tracks, fps: float) -> list[int]:
    """Return frames to inspect, worst first and at least half a second apart.

    Lost frames come first, then frames by uncovered mask area; frames of a solve are ordered by `severity`.
    """
    if tracks.solved is not None:
        badness = severity(tracks.solved)
    else:
        badness = np.where(tracks.tracked(), np.fmax.reduce(uncovered_percent(tracks), axis=1), np.inf)
    return [int(tracks.frames[index]) for index in worst_frames(badness, tracks.frames, fps, _MOST_WORST)]


def frame_html(tracks: Tracks, frame: int) -> str:
    """Return HTML that describes how a frame was tracked or solved."""
    if tracks.solved is not None:
        return solve_html(tracks, tracks.solved, frame)
    index = tracks.row_of(frame)
    if index is None:
        return "not tracked"
    parts = []
    for arch, (name, color, code, percent) in enumerate(
        zip(("upper", "lower"), _COLORS, tracks.status[index], uncovered_percent(tracks)[index], strict=True)
    ):
        area = f", {percent:.2f} % uncovered" if np.isfinite(percent) else ", no mask"
        state = f"lost, {tracks.explain_loss(index, arch)}" if code == LOST else _STATUS.get(int(code), "?")
        parts.append(f'<span style="color:{color}">&#9632;</span> {name}: {state}{area}')
    if tracks.prior_aided[index]:
        parts.append("regularised by the jaw model")
    return "<br>".join(parts)


def coverage_plot(tracks: Tracks, span: tuple[int, int], worst: list[int]) -> Plot:
    """Plot the uncovered mask area of both arches over a range of frames, with lost and worst frames marked."""
    percent = uncovered_percent(tracks)
    top = max(float(np.nanmax(percent, initial=0.1)) * 1.08, 0.1)
    plot = framed("jaw-coverage", _corners(span, 0.0, top), "uncovered mask area", "frame", "%", pad=(False, False))
    high, low = plot.high[1], plot.low[1]
    parts = []
    for frame in tracks.frames[~tracks.tracked()]:
        ends = place(plot, np.array([[frame, low], [frame, high]]))
        parts.append(f'<path d="{path_through(ends)}" stroke="{VERMILION}" stroke-opacity=".4"/>')
    for k, color in enumerate(_COLORS):
        known = np.flatnonzero(np.isfinite(percent[:, k]))
        pieces = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1) if len(known) else []
        curve = np.stack([tracks.frames, percent[:, k]], axis=1)
        steps = "".join(path_through(place(plot, curve[piece])) for piece in pieces)
        parts.append(f'<path d="{steps}" fill="none" stroke="{color}" stroke-width="1.2"/>')
    for x, y in place(plot, np.array([[frame, high] for frame in worst]).reshape(-1, 2)):
        parts.append(f'<path d="M{x:.1f} {y:.1f}l-3 -5h6z" fill="{VERMILION}"/>')
    return drawn(plot, parts)


def solve_plot(tracks: Tracks, solved: SolvedJaw, span: tuple[int, int]) -> Plot:
    """Plot d1, d2, d3 of a solved take over a range of frames, with bands of two sigma and a strip of frame states."""
    step = max(1, -(-len(tracks.frames) // _MOST_SAMPLES))
    frames = tracks.frames[::step].astype(np.float64)
    d, sigma = solved.d[::step], solved.sigma_mm[::step]
    values = np.concatenate([d - _BAND * sigma, d + _BAND * sigma])
    corners = _corners(span, values.min(initial=0.0), values.max(initial=1.0))
    plot = framed("jaw-solve", corners, "solved jaw", "frame", "mm", pad=(False, True))
    parts = [_band(plot, frames, d[:, k], sigma[:, k], color) for k, color in enumerate(CURVE_COLORS)]
    for k, color in enumerate(CURVE_COLORS):
        line = path_through(place(plot, np.stack([frames, d[:, k]], axis=1)))
        parts.append(f'<path d="{line}" fill="none" stroke="{color}" stroke-width="1.5"/>')
        label = f'<text x="{98 + 57 * k}" y="14" font-size="10" fill="{color}" font-weight="bold">'
        parts.append(f"{label}{_NAMES[k]}</text>")
    return drawn(plot, [*parts, *(_strip(plot, tracks, solved, state) for state in SolveState)])


def _corners(span: tuple[int, int], low: float, high: float) -> Array:
    """Return two opposite corners (2, 2) of a plot of values over frames; it is at least one frame wide."""
    return np.array([[span[0], low], [max(span[1], span[0] + 1), high]], np.float64)


def _band(plot: Plot, frames: Array, d: Array, sigma: Array, color: str) -> str:
    above = place(plot, np.stack([frames, d + _BAND * sigma], axis=1))
    below = place(plot, np.stack([frames, d - _BAND * sigma], axis=1))
    return f'<path d="{path_through(np.concatenate([above, below[::-1]]))}Z" fill="{color}" fill-opacity=".2"/>'


def _strip(plot: Plot, tracks: Tracks, solved: SolvedJaw, state: SolveState) -> str:
    """Return SVG bars along the axis at the frames with a given state."""
    rows = np.flatnonzero(solved.state == state)
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else []
    ends = [(float(tracks.frames[run[0]]) - 0.5, float(tracks.frames[run[-1]]) + 0.5) for run in runs]
    pixels = [place(plot, np.array([[a, plot.low[1]], [b, plot.low[1]]])) for a, b in ends]
    steps = "".join(f"M{a[0]:.1f} {a[1] - _STRIP_PX / 2:.1f}H{b[0]:.1f}" for a, b in pixels)
    return f'<path d="{steps}" stroke="{_css(state)}" stroke-width="{_STRIP_PX}"/>'


def solve_html(tracks: Tracks, solved: SolvedJaw, frame: int) -> str:
    """Return HTML that describes the solution in a frame, in the colours of the frame's outlines."""
    row = tracks.row_of(frame)
    if row is None:
        return "not solved"
    whole = SolveState(int(solved.state[row]))
    parts = []
    for name, status in zip(("upper", "lower"), tracks.status[row], strict=True):
        state = whole if status == LOST else SolveState.SOLVED
        parts.append(f'<span style="color:{_css(state)}">&#9632;</span> {name}: {STATE_WORDS[state]}')
    for name, value, sigma in zip(_NAMES, solved.d[row], solved.sigma_mm[row], strict=True):
        parts.append(f"{name} {value:.2f} &plusmn; {sigma:.2f} mm (1 sigma)")
    margin = float(solved.margin_mm[row])
    verdict = "" if solved.valid[row] else ": <b>invalid for the rig</b>"
    where = place_of(margin, float(tracks.meta.get("tolerance_mm", 0.0)))
    parts.append(f"bound: {where}, margin {margin:.2f} mm{verdict}")
    return "<br>".join(parts)


def severity(solved: SolvedJaw) -> Array:
    """Return the priority of each frame for inspection, shape (F,): invalid poses first, then by expected error."""
    worst = solved.sigma_mm.max(axis=1)
    return np.where(solved.valid, worst, worst + 1e3 - np.minimum(solved.margin_mm, 0.0))


def _css(state: SolveState) -> str:
    return "#{:02x}{:02x}{:02x}".format(*STATE_COLOURS[state])
