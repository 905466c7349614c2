"""What a solve found, in the page: d over the frames with its expected error, and words about one frame."""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator.verdicts import place as place_of
from jawusd.formats.performance import STATE_COLOURS, STATE_WORDS, SolveState
from jawusd.formats.solved import SolvedJaw
from jawusd.formats.tracks import LOST, Tracks
from jawusd.viewer.plots import CURVE_COLORS, Plot, drawn, framed, path_through, place, with_playhead

_NAMES = ("d1 opening", "d2 laterotrusion", "d3 protrusion")
_BAND = 2.0  # sigmas: 95 % of normal errors
_MOST_SAMPLES = 400
_STRIP_PX = 6


class SolvePlot:
    """Draw the jaw of a solved take, once, and a playhead over it.

    Attributes:
        definition: HTML that defines the plot, invisibly.
        across: where the axis begins and ends, as shares of the plot's width.
    """

    across = Plot.across

    def __init__(self, tracks: Tracks, solved: SolvedJaw, span: tuple[int, int]) -> None:
        """Draw a solved take over a span of frames; bands are two sigmas, a strip below shows the states."""
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
        """Return the SVG of the plot with a line at the frame shown."""
        return with_playhead(self._plot, frame)

    @staticmethod
    def _band(plot: Plot, frames: Array, d: Array, sigma: Array, color: str) -> str:
        above = place(plot, np.stack([frames, d + _BAND * sigma], axis=1))
        below = place(plot, np.stack([frames, d - _BAND * sigma], axis=1))
        return f'<path d="{path_through(np.concatenate([above, below[::-1]]))}Z" fill="{color}" fill-opacity=".2"/>'

    @staticmethod
    def _strip(plot: Plot, tracks: Tracks, solved: SolvedJaw, state: SolveState) -> str:
        """Return a bar along the axis where the take is in a state."""
        rows = np.flatnonzero(solved.state == state)
        runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else []
        ends = [(float(tracks.frames[run[0]]) - 0.5, float(tracks.frames[run[-1]]) + 0.5) for run in runs]
        pixels = [place(plot, np.array([[a, plot.low[1]], [b, plot.low[1]]])) for a, b in ends]
        steps = "".join(f"M{a[0]:.1f} {a[1] - _STRIP_PX / 2:.1f}H{b[0]:.1f}" for a, b in pixels)
        return f'<path d="{steps}" stroke="{_css(state)}" stroke-width="{_STRIP_PX}"/>'


def solve_words(tracks: Tracks, solved: SolvedJaw, frame: int) -> str:
    """Return HTML about the solve of a frame, with the colours of its outlines."""
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


def doubt(solved: SolvedJaw) -> Array:
    """Return how doubtful each frame is, shape (F,): those the rig does not allow first, then by expected error."""
    worst = solved.sigma_mm.max(axis=1)
    return np.where(solved.valid, worst, worst + 1e3 - np.minimum(solved.margin_mm, 0.0))


def _css(state: SolveState) -> str:
    return "#{:02x}{:02x}{:02x}".format(*STATE_COLOURS[state])
