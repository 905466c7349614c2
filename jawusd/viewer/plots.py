"""Plots as SVG text: bounds, Posselt's figures, the curves of an animation, and those of a take.

The static part of a plot is sent once under an id. Updates refer to it with `<use>` and take a few hundred bytes. Text
inherits the page's colour, so that it is legible on light and dark pages.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array, Indices
from jawusd.evaluator import JawRig
from jawusd.evaluator.verdicts import place as place_of
from jawusd.formats.performance import STATE_COLOURS, STATE_WORDS, SolvedJaw, SolveState
from jawusd.formats.tracks import LOST, PARTIAL, RECOVERED, TRACKED, Tracks, uncovered_percent, worst_frames
from jawusd.viewer.motion import Clip, KeyTrack
from jawusd.viewer.readouts import INCISOR, border_path, landmark_places, rest_places

# Okabe and Ito's colour-blind safe palette, also used for the 3-D jaw.
BLUE, ORANGE, GREEN, VERMILION, GREY = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#888888"
CURVE_COLORS = (BLUE, VERMILION, GREEN)

_WIDTH, _HEIGHT = 300, 192
_LEFT, _RIGHT, _TOP, _BOTTOM = 36, 12, 22, 32
#: Start and end of the plotted area, as fractions of a plot's width.
ACROSS = (_LEFT / _WIDTH, 1 - _RIGHT / _WIDTH)
_MOST_POINTS = 300
_MOST_SAMPLES = 400
_TEXT = 'font-family="sans-serif" font-size="11" fill="currentColor"'


@dataclass(frozen=True)
class Plot:
    """A plot whose static part, the SVG of axes, outlines and points, has been drawn.

    `name` is the id of the static part in the page, `low` and `high` are the corners of the plotted area in data
    coordinates.
    """

    name: str
    static: str
    low: tuple[float, float]
    high: tuple[float, float]

    def definition(self) -> str:
        """Return hidden HTML that defines the static part; every page needs it once."""
        style = "position:absolute"
        return f'<svg width="0" height="0" style="{style}"><defs><g id="{self.name}">{self.static}</g></defs></svg>'

    def with_point(self, x: float, y: float, inside: bool) -> str:
        """Return the SVG of the plot with the current pose marked."""
        px, py = _at(self, x, y)
        mark = f'<circle cx="{px:.1f}" cy="{py:.1f}" r="5" fill="{GREEN if inside else VERMILION}" stroke="white"/>'
        return _svg(f'<use href="#{self.name}"/>{mark}')


def bound_plot(rig: JawRig, axis: int) -> Plot:
    """Plot the outline of the paper, a slice of the bound, and captured poses: d2 (axis 1) or d3 (axis 2) over d1."""
    name = ("", "d1d2", "d1d3")[axis]
    corners = rig.arrays[f"polygon_{name}"]
    rings = np.split(corners, np.cumsum(rig.arrays[f"polygon_{name}_counts"])[:-1].astype(int))
    border = border_path(rig, axis)[:, [0, axis]]
    captured = _thinned(rig.captured_d[:, [0, axis]])
    title = ("", "laterotrusion d2 over opening d1", "protrusion d3 over opening d1")[axis]
    plot = framed(f"jaw-{name}", np.vstack([corners, border, captured]), title, "opening d1 [mm]", "mm")
    parts = [_dots(plot, captured), *(_ring(plot, ring, GREY, "4 3") for ring in rings), _ring(plot, border, BLUE)]
    return drawn(plot, parts)


def posselt_plot(rig: JawRig, axis: int) -> Plot:
    """Plot Posselt's figure: the border movements of the lower incisal point.

    Axis 1 is the frontal plane (x to the left, d3 = 0), axis 2 the sagittal plane (x forward, d2 = 0).
    """
    origin = rest_places(rig)[INCISOR]
    columns = [0, 1] if axis == 1 else [2, 1]
    border = (landmark_places(rig, border_path(rig, axis))[:, INCISOR] - origin)[:, columns]
    captured = (landmark_places(rig, _thinned(rig.captured_d))[:, INCISOR] - origin)[:, columns]
    name, title, label = (
        ("jaw-frontal", "Posselt, frontal: up over left", "to the subject's left [mm]"),
        ("jaw-sagittal", "Posselt, sagittal: up over forward", "forward [mm]"),
    )[axis - 1]
    plot = framed(name, np.vstack([border, captured]), title, label, "mm")
    return drawn(plot, [_dots(plot, captured), _ring(plot, border, BLUE)])


def posselt_point(places: Array, rest: Array, axis: int) -> tuple[float, float]:
    """Return the point in Posselt's figure `axis` for landmarks (5, 3), given the landmarks at rest [mm]."""
    moved = places[INCISOR] - rest[INCISOR]
    return float(moved[0 if axis == 1 else 2]), float(moved[1])


def curve_plot(clip: Clip | None, keys: KeyTrack, span: tuple[float, float]) -> Plot:
    """Plot d1, d2 and d3 of a motion over a range of frames, with keys as dots."""
    name = "jaw-curves"
    if clip is None:
        empty = f'<text x="{_WIDTH / 2}" y="{_HEIGHT / 2}" text-anchor="middle" {_TEXT}>no keys yet</text>'
        return Plot(name, empty, (span[0], 0.0), (max(span[1], span[0] + 1.0), 1.0))
    first, last = span[0], max(span[1], span[0] + 1.0)
    frames = np.union1d(np.linspace(first, last, _MOST_SAMPLES), [key.frame for key in keys])
    values = clip.at(frames)
    corners = np.stack([np.repeat([first, last], 2), np.tile([values.min(), values.max()], 2)], axis=1)
    plot = framed(name, corners, "parameters over frames", "frame", "mm", pad=(False, True))
    parts = []
    for axis, color in enumerate(CURVE_COLORS):
        parts.append(_line(plot, frames, values[:, axis], color))
        parts.append(_label(_WIDTH - 70 + 24 * axis, 11, f"d{axis + 1}", color))
        for key in keys:
            px, py = _at(plot, key.frame, key.d[axis])
            parts.append(f'<circle cx="{px:.1f}" cy="{py:.1f}" r="3" fill="{color}"/>')
    return drawn(plot, parts)


def with_playhead(plot: Plot, frame: float) -> str:
    """Return the SVG of a curve plot with a line at the current frame."""
    frame = min(max(frame, plot.low[0]), plot.high[0])
    px, _ = _at(plot, frame, plot.low[1])
    line = f'<path d="M{px:.1f} {_TOP}V{_HEIGHT - _BOTTOM}" stroke="{ORANGE}" stroke-width="2"/>'
    return _svg(f'<use href="#{plot.name}"/>{line}')


def plot_seek(plot: Plot, frame: float, slider: str) -> str:
    """Return the HTML of a curve plot in which a click or drag sets a frame slider to the frame under the pointer.

    viser does not report clicks in a plot, so the page emulates keyboard input to the slider with the given id.
    """
    (low, high), first, last = ACROSS, plot.low[0], plot.high[0]
    share = f"((event.clientX-r.left)/r.width-{low:.5f})/{high - low:.5f}"
    box = f"document.getElementById('{slider}').parentElement.querySelector('input:not([type=hidden])')"
    script = (
        f"if(event.buttons&1){{const b={box},"
        f"r=this.firstElementChild.getBoundingClientRect(),s=Math.min(1,Math.max(0,{share}));"
        "Object.getOwnPropertyDescriptor(HTMLInputElement.prototype,'value').set.call(b,"
        f"Math.round({first:g}+s*{last - first:g}));"
        "b.dispatchEvent(new Event('input',{bubbles:true}))}"
    )
    style = "padding:0 6px;cursor:col-resize;touch-action:none;user-select:none"
    return f'<div style="{style}" onpointerdown="{script}" onpointermove="{script}">{with_playhead(plot, frame)}</div>'


def _svg(content: str) -> str:
    return f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" width="100%" style="display:block">{content}</svg>'


def _thinned(points: Array) -> Array:
    return points[:: max(1, -(-len(points) // _MOST_POINTS))]


def place(plot: Plot, points: Array) -> Array:
    """Return the pixels (n, 2) of data points (n, 2), clipped to the plotted area."""
    low, high = np.array(plot.low), np.array(plot.high)
    share = np.clip((points - low) / (high - low), 0.0, 1.0)
    x = _LEFT + share[:, 0] * (_WIDTH - _LEFT - _RIGHT)
    y = _HEIGHT - _BOTTOM - share[:, 1] * (_HEIGHT - _TOP - _BOTTOM)
    return np.stack([x, y], axis=1)


def _at(plot: Plot, x: float, y: float) -> Array:
    """Return the pixel (2,) of a data point."""
    return place(plot, np.array([[x, y]]))[0]


def framed(
    name: str, data: Array, title: str, x_label: str, y_label: str, pad: tuple[bool, bool] = (True, True)
) -> Plot:
    """Return a plot with axes, ticks and labels whose range contains data (n, 2), widened along x and y if `pad`."""
    low, high = data.min(axis=0), data.max(axis=0)
    room = np.maximum(0.06 * (high - low), 0.5) * pad
    low, high = low - room, high + room
    plot = Plot(name, "", (float(low[0]), float(low[1])), (float(high[0]), float(high[1])))
    area = (_WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM)
    parts = [
        f'<rect x="{_LEFT}" y="{_TOP}" width="{area[0]}" height="{area[1]}" fill="none" stroke="{GREY}"/>',
        f'<text x="{_LEFT}" y="14" {_TEXT} font-weight="bold">{title}</text>',
        f'<text x="{_LEFT + area[0] / 2}" y="{_HEIGHT - 4}" text-anchor="middle" {_TEXT}>{x_label}</text>',
        f'<text x="4" y="{_TOP - 8}" {_TEXT}>{y_label}</text>',
    ]
    for tick in _ticks(low[0], high[0]):
        px, _ = _at(plot, tick, low[1])
        parts.append(f'<text x="{px:.1f}" y="{_HEIGHT - _BOTTOM + 13}" text-anchor="middle" {_TEXT}>{tick:g}</text>')
    for tick in _ticks(low[1], high[1]):
        _, py = _at(plot, low[0], tick)
        parts.append(f'<text x="{_LEFT - 4}" y="{py + 4:.1f}" text-anchor="end" {_TEXT}>{tick:g}</text>')
        parts.append(f'<path d="M{_LEFT} {py:.1f}h{area[0]}" stroke="{GREY}" stroke-opacity=".25"/>')
    return drawn(plot, parts)


def drawn(plot: Plot, parts: list[str]) -> Plot:
    """Return a plot with SVG added to its static part."""
    return replace(plot, static=plot.static + "".join(parts))


def _ticks(low: float, high: float) -> list[float]:
    """Return about five round numbers between two values."""
    rough = (high - low) / 5
    power = 10.0 ** np.floor(np.log10(rough))
    step = power * next(factor for factor in (1, 2, 5, 10) if factor * power >= rough)
    return [round(step * k, 9) + 0.0 for k in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]


def path_through(pixels: Array) -> str:
    """Return the SVG path through pixels (n, 2)."""
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in pixels)


def _curve(steps: str, color: str, more: str = "", width: float = 1.5) -> str:
    return f'<path d="{steps}" fill="none" stroke="{color}" stroke-width="{width}"{more}/>'


def _line(plot: Plot, frames: Array, values: Array, color: str) -> str:
    return _curve(path_through(place(plot, np.stack([frames, values], axis=1))), color)


def _label(x: float, size: int, name: str, color: str) -> str:
    return f'<text x="{x}" y="14" font-size="{size}" fill="{color}" font-weight="bold">{name}</text>'


def _ring(plot: Plot, points: Array, color: str, dash: str = "") -> str:
    return _curve(f"{path_through(place(plot, points))}Z", color, f' stroke-dasharray="{dash}"' if dash else "")


def _dots(plot: Plot, points: Array) -> str:
    steps = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in place(plot, points))
    return f'<path d="{steps}" stroke="{GREY}" stroke-width="2.5" stroke-linecap="round" stroke-opacity=".7"/>'


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
_TAKE_SAMPLES = 400
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
        curve = np.stack([tracks.frames, percent[:, k]], axis=1)
        known = _runs(np.flatnonzero(np.isfinite(percent[:, k])))
        parts.append(_curve("".join(path_through(place(plot, curve[run])) for run in known), color, width=1.2))
    for x, y in place(plot, np.array([[frame, high] for frame in worst]).reshape(-1, 2)):
        parts.append(f'<path d="M{x:.1f} {y:.1f}l-3 -5h6z" fill="{VERMILION}"/>')
    return drawn(plot, parts)


def solve_plot(tracks: Tracks, solved: SolvedJaw, span: tuple[int, int]) -> Plot:
    """Plot d1, d2, d3 of a solved take over a range of frames, with bands of two sigma and a strip of frame states."""
    step = max(1, -(-len(tracks.frames) // _TAKE_SAMPLES))
    frames = tracks.frames[::step].astype(np.float64)
    d, sigma = solved.d[::step], solved.sigma_mm[::step]
    values = np.concatenate([d - _BAND * sigma, d + _BAND * sigma])
    corners = _corners(span, values.min(initial=0.0), values.max(initial=1.0))
    plot = framed("jaw-solve", corners, "solved jaw", "frame", "mm", pad=(False, True))
    parts = [_band(plot, frames, d[:, k], sigma[:, k], color) for k, color in enumerate(CURVE_COLORS)]
    for k, color in enumerate(CURVE_COLORS):
        parts += [_line(plot, frames, d[:, k], color), _label(98 + 57 * k, 10, _NAMES[k], color)]
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
    steps = ""
    for run in _runs(np.flatnonzero(solved.state == state)):
        x, y = _at(plot, float(tracks.frames[run[0]]) - 0.5, plot.low[1])
        end, _ = _at(plot, float(tracks.frames[run[-1]]) + 0.5, plot.low[1])
        steps += f"M{x:.1f} {y - _STRIP_PX / 2:.1f}H{end:.1f}"
    return f'<path d="{steps}" stroke="{_css(state)}" stroke-width="{_STRIP_PX}"/>'


def _runs(rows: Indices) -> list[Indices]:
    """Split increasing numbers where one is missing."""
    return np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else []


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
