"""The ranges of many actors, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from jawusd.report.style import BLACK, BLUE, GREEN, SKY, new_figure, save_figure

RANGES = "ranges"  # name of the files

_PARAMETERS = {
    "opening": ("opening d1", BLUE),
    "laterotrusion": ("laterotrusion d2, + left", GREEN),
    "protrusion": ("protrusion d3, + forward", SKY),
}
_ROW_IN, _MARGINS_IN = 0.22, 0.9
_MOST_ROWS = 400  # a taller picture cannot be opened


def draw_ranges(people: Sequence[tuple[str, dict[str, list[float]]]], folder: Path) -> list[Path]:
    """Draw the ranges of actors into a folder, as PNG and SVG.

    Args:
        people: see `ranges_figure`.
        folder: where the files go; made if missing.

    Returns:
        The files written.

    Raises:
        OutputError: a file cannot be written.
    """
    return save_figure(ranges_figure(people), folder, RANGES)


def ranges_figure(people: Sequence[tuple[str, dict[str, list[float]]]]) -> Figure:
    """Draw the ranges of actors as bars, one row per actor, one column per parameter.

    Args:
        people: name of each actor, and lowest and highest value [mm] by "opening", "laterotrusion", "protrusion"; the
            first 400 are drawn.

    Returns:
        The figure.
    """
    shown = list(people)[:_MOST_ROWS]
    figure, axes = new_figure(9.0, _MARGINS_IN + _ROW_IN * max(len(shown), 2), 1, 3, sharey=True)
    rows = range(len(shown))
    for axis, (key, (title, color)) in zip(axes, _PARAMETERS.items(), strict=True):
        ends = [ranges[key] for _, ranges in shown]
        axis.barh(rows, [high - low for low, high in ends], left=[low for low, _ in ends], color=color, height=0.7)
        axis.axvline(0.0, color=BLACK, lw=0.8)
        axis.set(title=title, xlabel="[mm]")
    axes[0].set_yticks(rows, [_literal(name) for name, _ in shown])
    axes[0].invert_yaxis()
    return figure


def _literal(name: str) -> str:
    """Return a name as matplotlib shows it letter by letter: a dollar sign would start a formula."""
    return name[:30].replace("$", r"\$")
