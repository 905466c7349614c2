"""Plots of a take: mask coverage of tracked poses, or the solved jaw with its error bands."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.evaluator.verdicts import place as place_of
from jawusd.formats.performance import STATE_COLOURS, STATE_WORDS, SolvedJaw, SolveState
from jawusd.formats.tracks import LOST, PARTIAL, RECOVERED, TRACKED, Tracks, uncovered_percent, worst_frames
from jawusd.viewer.plots import (
    BLUE,
    CURVE_COLORS,
    GREY,
    ORANGE,
    VERMILION,
    Plot,
    drawn,
    framed,
    path_through,
    place,
    svg_definition,
    with_playhead,
)

_MOST_WORST = 12
_WIDTH, _HEIGHT = 330, 170
_LEFT, _RIGHT, _TOP, _BOTTOM = 30, 8, 20, 26
_COVERAGE_TEXT = 'font-family="sans-serif" font-size="11" fill="currentColor"'
_STATUS: dict[int, str] = {
    LOST: "lost",
    TRACKED: "tracked",
    RECOVERED: "recovered",
    PARTIAL: "tracked without one camera",
}
_COLORS = (ORANGE, BLUE)  # upper, lower; same as the outlines in the pictures
_NAMES = ("d1 opening", "d2 laterotrusion", "d3 protrusion")
_BAND = 2.0  # sigmas: 95 % of normal errors
_MOST_SAMPLES = 400
_STRIP_PX = 6


def frames_to_inspect(tracks: Tracks, fps: float) -> list[int]:
    """Return frames to inspect, worst first and at least half a second apart: lost frames, then by coverage.

    Frames of a solve are ordered by `severity`.
    """
    if tracks.solved is not None:
        badness = severity(tracks.solved)
    else:
        badness = np.where(tracks.tracked(), np.fmax.reduce(uncovered_percent(tracks), axis=1), np.inf)
    return [int(tracks.frames[index]) for index in worst_frames(badness, tracks.frames, fps, _MOST_WORST)]


def frame_words(tracks: Tracks, frame: int) -> str:
    """Return HTML that describes the tracking or the solve of a frame."""
    if tracks.solved is not None:
        return solve_words(tracks, tracks.solved, frame)
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


class CoveragePlot:
    """Uncovered mask area of both arches over the frames: a static plot with a moving playhead.

    Attributes:
        definition: hidden HTML that defines the plot.
        across: start and end of the axis as fractions of the plot's width.
    """

    across = (_LEFT / _WIDTH, 1 - _RIGHT / _WIDTH)

    def __init__(self, tracks: Tracks, span: tuple[int, int], worst: list[int]) -> None:
        """Plot tracks over a range of frames and mark the worst ones."""
        self._span = span
        percent = uncovered_percent(tracks)
        self._top = max(float(np.nanmax(percent, initial=0.1)) * 1.08, 0.1)
        bottom = _HEIGHT - _BOTTOM
        parts = [
            f'<rect x="{_LEFT}" y="{_TOP}" width="{_WIDTH - _LEFT - _RIGHT}" height="{bottom - _TOP}" fill="none" '
            f'stroke="{GREY}"/>',
            f'<text x="{_LEFT}" y="13" {_COVERAGE_TEXT} font-weight="bold">uncovered mask area [%]</text>',
        ]
        lost = f'stroke="{VERMILION}" stroke-opacity=".4"'
        parts += [self._vertical(int(frame), lost) for frame in tracks.frames[~tracks.tracked()]]
        parts += [self._curve(tracks.frames, percent[:, k], color) for k, color in enumerate(_COLORS)]
        for value in np.linspace(0, self._top / 1.08, 3):
            y = self._y(value)
            parts.append(f'<text x="{_LEFT - 4}" y="{y + 4:.1f}" text-anchor="end" {_COVERAGE_TEXT}>{value:.1f}</text>')
        for frame in (span[0], (span[0] + span[1]) // 2, span[1]):
            anchor = "start" if frame == span[0] else "end" if frame == span[1] else "middle"
            place = f'x="{self._x(frame):.1f}" y="{bottom + 13}" text-anchor="{anchor}"'
            parts.append(f"<text {place} {_COVERAGE_TEXT}>{frame}</text>")
        for frame in worst:
            x = self._x(frame)
            parts.append(f'<path d="M{x:.1f} {_TOP}l-3 -5h6z" fill="{VERMILION}"/>')
        self.definition = svg_definition("jaw-coverage", "".join(parts))

    def with_playhead(self, frame: int) -> str:
        """Return the SVG of the plot with a line at the current frame."""
        line = self._vertical(frame, 'stroke="currentColor" stroke-width="1.5"')
        box = f'viewBox="0 0 {_WIDTH} {_HEIGHT}" width="100%" style="display:block"'
        return f'<svg {box}><use href="#jaw-coverage"/>{line}</svg>'

    def _x(self, frame: float) -> float:
        first, last = self._span
        return _LEFT + (frame - first) / max(last - first, 1) * (_WIDTH - _LEFT - _RIGHT)

    def _y(self, percent: float) -> float:
        return _HEIGHT - _BOTTOM - percent / self._top * (_HEIGHT - _TOP - _BOTTOM)

    def _vertical(self, frame: int, style: str) -> str:
        return f'<path d="M{self._x(frame):.1f} {_TOP}V{_HEIGHT - _BOTTOM}" {style}/>'

    def _curve(self, frames: NDArray[np.int64], percent: Array, color: str) -> str:
        """Return a curve with gaps where values are missing."""
        steps, pen = [], "M"
        for frame, value in zip(frames, percent, strict=True):
            if np.isfinite(value):
                steps.append(f"{pen}{self._x(frame):.1f} {self._y(value):.1f}")
            pen = "L" if np.isfinite(value) else "M"
        return f'<path d="{"".join(steps)}" fill="none" stroke="{color}" stroke-width="1.2"/>'


class SolvePlot:
    """d of a solved take with its expected error: a static plot with a moving playhead.

    Attributes:
        definition: hidden HTML that defines the plot.
        across: start and end of the axis as fractions of the plot's width.
    """

    across = Plot.across

    def __init__(self, tracks: Tracks, solved: SolvedJaw, span: tuple[int, int]) -> None:
        """Plot a solved take over a range of frames, with bands of two sigma and a strip for the states."""
        step = max(1, -(-len(tracks.frames) // _MOST_SAMPLES))
        frames = tracks.frames[::step].astype(np.float64)
        d, sigma = solved.d[::step], solved.sigma_mm[::step]
        values = np.concatenate([d - _BAND * sigma, d + _BAND * sigma])
        first, last = float(span[0]), float(max(span[1], span[0] + 1))
        corners = np.array([[first, values.min(initial=0.0)], [last, values.max(initial=1.0)]])
        plot = framed("jaw-solve", corners, "solved jaw", "frame", "mm", pad_x=False)
        parts = [self._band(plot, frames, d[:, k], sigma[:, k], color) for k, color in enumerate(CURVE_COLORS)]
        for k, color in enumerate(CURVE_COLORS):
            line = path_through(place(plot, np.stack([frames, d[:, k]], axis=1)))
            parts.append(f'<path d="{line}" fill="none" stroke="{color}" stroke-width="1.5"/>')
            label = f'<text x="{98 + 57 * k}" y="14" font-size="10" fill="{color}" font-weight="bold">'
            parts.append(f"{label}{_NAMES[k]}</text>")
        parts += [self._strip(plot, tracks, solved, state) for state in SolveState]
        self._plot = drawn(plot, parts)
        self.definition = self._plot.definition()

    def with_playhead(self, frame: int) -> str:
        """Return the SVG of the plot with a line at the current frame."""
        return with_playhead(self._plot, frame)

    @staticmethod
    def _band(plot: Plot, frames: Array, d: Array, sigma: Array, color: str) -> str:
        above = place(plot, np.stack([frames, d + _BAND * sigma], axis=1))
        below = place(plot, np.stack([frames, d - _BAND * sigma], axis=1))
        return f'<path d="{path_through(np.concatenate([above, below[::-1]]))}Z" fill="{color}" fill-opacity=".2"/>'

    @staticmethod
    def _strip(plot: Plot, tracks: Tracks, solved: SolvedJaw, state: SolveState) -> str:
        """Return a bar along the axis for the frames in a state."""
        rows = np.flatnonzero(solved.state == state)
        runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else []
        ends = [(float(tracks.frames[run[0]]) - 0.5, float(tracks.frames[run[-1]]) + 0.5) for run in runs]
        pixels = [place(plot, np.array([[a, plot.low[1]], [b, plot.low[1]]])) for a, b in ends]
        steps = "".join(f"M{a[0]:.1f} {a[1] - _STRIP_PX / 2:.1f}H{b[0]:.1f}" for a, b in pixels)
        return f'<path d="{steps}" stroke="{_css(state)}" stroke-width="{_STRIP_PX}"/>'


def solve_words(tracks: Tracks, solved: SolvedJaw, frame: int) -> str:
    """Return HTML that describes the solve of a frame, in the colours of its outlines."""
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
    verdict = "" if solved.valid[row] else ": <b>the rig does not allow this pose</b>"
    where = place_of(margin, float(tracks.meta.get("tolerance_mm", 0.0)))
    parts.append(f"bound: {where}, margin {margin:.2f} mm{verdict}")
    return "<br>".join(parts)


def severity(solved: SolvedJaw) -> Array:
    """Return the priority of each frame for inspection, shape (F,): invalid poses first, then by expected error."""
    worst = solved.sigma_mm.max(axis=1)
    return np.where(solved.valid, worst, worst + 1e3 - np.minimum(solved.margin_mm, 0.0))


def _css(state: SolveState) -> str:
    return "#{:02x}{:02x}{:02x}".format(*STATE_COLOURS[state])
