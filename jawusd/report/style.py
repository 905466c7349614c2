"""How figures look: one palette that colour-blind people can tell apart, quiet axes, PNG and SVG."""

from __future__ import annotations

import io
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jawusd.formats.atomic import write_bytes_atomic

# Okabe & Ito, "Color Universal Design" (2008).
BLACK, ORANGE, SKY, GREEN, BLUE, VERMILION = "#000000", "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00"
GREY, PALE = "#777777", "#C8C8C8"

#: What figures are made and saved with.
SETTINGS = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "jawusd",  # the same picture gives the same file
}
_DPI = 150


def new_figure(
    width_in: float, height_in: float, rows: int, columns: int, **options: object
) -> tuple[Figure, list[Axes]]:
    """Return a figure outside any window system, and its axes row by row.

    Args:
        width_in, height_in: size [inches].
        rows, columns: of axes.
        options: of `Figure.subplots`.
    """
    with matplotlib.rc_context(SETTINGS):
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, **options)
    return figure, list(axes.ravel())


def save_figure(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as PNG and SVG, atomically, and return the files.

    Raises:
        OutputError: a file cannot be written.
    """
    files = []
    with matplotlib.rc_context(SETTINGS):
        for suffix, metadata in (("png", {"Software": None}), ("svg", {"Date": None})):
            drawn = io.BytesIO()
            figure.savefig(drawn, format=suffix, dpi=_DPI, metadata=metadata)
            files.append(folder / f"{name}.{suffix}")
            write_bytes_atomic(files[-1], drawn.getvalue())
    return files
