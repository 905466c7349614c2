"""How well tracked poses cover the masks: a plot over the frames, and the worst frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.formats.coverage import uncovered_percent, worst_frames
from jawusd.formats.tracks import LOST, PARTIAL, RECOVERED, TRACKED, Tracks
from jawusd.viewer.plots import BLUE, GREY, ORANGE, VERMILION, svg_definition
from jawusd.viewer.solve_plot import doubt, solve_words

_MOST_WORST = 12
_WIDTH, _HEIGHT = 330, 170
_LEFT, _RIGHT, _TOP, _BOTTOM = 30, 8, 20, 26
_TEXT = 'font-family="sans-serif" font-size="11" fill="currentColor"'
_STATUS: dict[int, str] = {
    LOST: "lost",
    TRACKED: "tracked",
    RECOVERED: "found again",
    PARTIAL: "tracked without one camera",
}
_COLORS = (ORANGE, BLUE)  # upper, lower, as the outlines in the pictures


def frames_to_inspect(tracks: Tracks, fps: float) -> list[int]:
    """Return frames to inspect, the worst first, no two within half a second: lost ones, then by coverage.

    Those of a solve are ordered by `solve_plot.doubt`.
    """
    if tracks.solved is not None:
        badness = doubt(tracks.solved)
    else:
        badness = np.where(tracks.tracked(), np.fmax.reduce(uncovered_percent(tracks), axis=1), np.inf)
    return [int(tracks.frames[index]) for index in worst_frames(badness, tracks.frames, fps, _MOST_WORST)]


def frame_words(tracks: Tracks, frame: int) -> str:
    """Return HTML about the tracking, or the solve, of a frame."""
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
        parts.append("the jaw model helped")
    return "<br>".join(parts)


class CoveragePlot:
    """Draw the uncovered area of both arches over the frames, once, and a playhead over it.

    Attributes:
        definition: HTML that defines the plot, invisibly.
        across: where the axis begins and ends, as shares of the plot's width.
    """

    across = (_LEFT / _WIDTH, 1 - _RIGHT / _WIDTH)

    def __init__(self, tracks: Tracks, span: tuple[int, int], worst: list[int]) -> None:
        """Draw tracks over a span of frames and mark the worst ones."""
        self._span = span
        percent = uncovered_percent(tracks)
        self._top = max(float(np.nanmax(percent, initial=0.1)) * 1.08, 0.1)
        bottom = _HEIGHT - _BOTTOM
        parts = [
            f'<rect x="{_LEFT}" y="{_TOP}" width="{_WIDTH - _LEFT - _RIGHT}" height="{bottom - _TOP}" fill="none" '
            f'stroke="{GREY}"/>',
            f'<text x="{_LEFT}" y="13" {_TEXT} font-weight="bold">mask area left uncovered [%]</text>',
        ]
        lost = f'stroke="{VERMILION}" stroke-opacity=".4"'
        parts += [self._vertical(int(frame), lost) for frame in tracks.frames[~tracks.tracked()]]
        parts += [self._curve(tracks.frames, percent[:, k], color) for k, color in enumerate(_COLORS)]
        for value in np.linspace(0, self._top / 1.08, 3):
            y = self._y(value)
            parts.append(f'<text x="{_LEFT - 4}" y="{y + 4:.1f}" text-anchor="end" {_TEXT}>{value:.1f}</text>')
        for frame in (span[0], (span[0] + span[1]) // 2, span[1]):
            anchor = "start" if frame == span[0] else "end" if frame == span[1] else "middle"
            place = f'x="{self._x(frame):.1f}" y="{bottom + 13}" text-anchor="{anchor}"'
            parts.append(f"<text {place} {_TEXT}>{frame}</text>")
        for frame in worst:
            x = self._x(frame)
            parts.append(f'<path d="M{x:.1f} {_TOP}l-3 -5h6z" fill="{VERMILION}"/>')
        self.definition = svg_definition("jaw-coverage", "".join(parts))

    def with_playhead(self, frame: int) -> str:
        """Return the SVG of the plot with a line at the frame shown."""
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
        """Return a curve that breaks where there is no value."""
        steps, pen = [], "M"
        for frame, value in zip(frames, percent, strict=True):
            if np.isfinite(value):
                steps.append(f"{pen}{self._x(frame):.1f} {self._y(value):.1f}")
            pen = "L" if np.isfinite(value) else "M"
        return f'<path d="{"".join(steps)}" fill="none" stroke="{color}" stroke-width="1.2"/>'
