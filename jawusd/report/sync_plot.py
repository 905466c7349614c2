"""Draw the alignment of cameras in time: brightness against frames, as recorded and aligned."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jawusd.formats.atomic import write_bytes_atomic
from jawusd.formats.light_curve import LightCurve
from jawusd.report.style import BLACK, BLUE, DPI, GREEN, GREY, ORANGE, SKY, VERMILION, figure_bytes, new_figure

_COLOURS = (BLUE, ORANGE, GREEN, VERMILION, SKY, BLACK, GREY)
_AROUND_FRAMES = 12  # shown before and after a flash
_APART_FRAMES = 48  # steps farther apart belong to different flashes


def draw_sync(curves: Mapping[str, LightCurve], offsets: Mapping[str, int] | None, title: str, path: Path) -> None:
    """Draw the brightness of all clips to a PNG or SVG file, whole and around the first and last flash.

    Args:
        offsets: frame k of a camera shows the instant of frame k + offset of the reference camera; None if they are not
            known, for a picture of the clips as recorded only.

    Raises:
        OutputError: the file cannot be written.
    """
    kind = path.suffix.lower().lstrip(".")
    write_bytes_atomic(path, figure_bytes(sync_figure(curves, offsets, title), kind, DPI))


def sync_figure(curves: Mapping[str, LightCurve], offsets: Mapping[str, int] | None, title: str) -> Figure:
    """Return the figure of `draw_sync`: a row as recorded and, with offsets, one after alignment."""
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
    """Draw one line per camera, with a mark where its light went off or on."""
    for k, (name, curve) in enumerate(curves.items()):
        colour = _COLOURS[k % len(_COLOURS)]
        frames = curve.frames + shifts[name]
        axis.plot(frames, curve.brightness, color=colour, lw=1.0, label=name, marker="." if close else "", ms=4)
        for steps, mark in ((curve.off_frames, "v"), (curve.on_frames, "^")):
            height = np.interp(steps, curve.frames, curve.brightness)
            axis.plot(steps + shifts[name], height, mark, color=colour, ms=7, mec="white", mew=0.6)
    # One entry for each kind of mark, whatever the camera.
    axis.plot([], [], "v", color=GREY, label="light off")
    axis.plot([], [], "^", color=GREY, label="light on")
    axis.set_ylim(0, 255)


def _flashes(curves: Mapping[str, LightCurve], shifts: Mapping[str, int]) -> list[tuple[float, float]]:
    """Return the spans of the first and the last flash of all cameras [frames]; none without a sudden change."""
    steps = np.sort(np.concatenate([np.append(c.off_frames, c.on_frames) + shifts[name] for name, c in curves.items()]))
    if not len(steps):
        return []
    parts = np.split(steps, np.flatnonzero(np.diff(steps) > _APART_FRAMES) + 1)
    ends = [parts[0]] if len(parts) == 1 else [parts[0], parts[-1]]
    return [(float(part[0]) - _AROUND_FRAMES, float(part[-1]) + _AROUND_FRAMES) for part in ends]
