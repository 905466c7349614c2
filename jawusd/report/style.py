"""Style and output of figures: colour-blind safe palette, plain axes, files, and inline SVG."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from jawusd.base.errors import shown
from jawusd.formats.atomic import write_bytes_atomic

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

# Okabe & Ito, "Color Universal Design" (2008).
BLACK, ORANGE, SKY, GREEN, BLUE, VERMILION = "#000000", "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00"
GREY, PALE, MAGENTA = "#777777", "#C8C8C8", "#D6278F"

#: Matplotlib settings for making and saving figures.
SETTINGS: dict[RcKeyType, object] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "jawusd",  # makes the ids in SVG files reproducible
}
_DPI, _INLINE_DPI = 150, 110
_PX_PER_PT = 4 / 3
# Colours that are replaced by variables of the page's style sheet; white is the background of text.
_THEMED = {
    BLACK: "ink",
    "#ffffff": "paper",
    GREY: "grey",
    PALE: "pale",
    BLUE: "blue",
    SKY: "sky",
    GREEN: "green",
    ORANGE: "orange",
    VERMILION: "vermilion",
}


def new_figure(
    width_in: float,
    height_in: float,
    rows: int,
    columns: int,
    *,
    sharex: bool = False,
    sharey: bool = False,
    height_ratios: list[float] | None = None,
) -> tuple[Figure, list[Axes]]:
    """Return a figure that needs no GUI, and its axes in row-major order; options as in `Figure.subplots`."""
    with matplotlib.rc_context(SETTINGS):
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, sharex=sharex, sharey=sharey, height_ratios=height_ratios)
    return figure, list(axes.ravel())


def save_figure(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as PNG and SVG, atomically, and return the files; raises OutputError."""
    files = [folder / f"{name}.png", folder / f"{name}.svg"]
    for file in files:
        write_figure(file, figure)
    return files


def write_figure(path: Path, figure: Figure, kind: str = "") -> None:
    """Write a figure to a file, atomically, as a kind of file or by its suffix; raises OutputError."""
    write_bytes_atomic(path, figure_bytes(figure, kind or path.suffix.lower().lstrip("."), _DPI))


def figure_bytes(figure: Figure, kind: str, dpi: int, *, transparent: bool = False) -> bytes:
    """Return a figure encoded as a file type, without dates and versions, so that equal figures give equal bytes."""
    drawn = io.BytesIO()
    metadata = {"Software": None} if kind == "png" else {"Date": None}
    for text in figure.findobj(Text):  # draw names literally: remove control characters, and do not parse $ as math
        text.set_text("\n".join(map(shown, text.get_text().split("\n"))))
        text.set_parse_math("$" not in text.get_text())
    with matplotlib.rc_context(SETTINGS):
        figure.savefig(drawn, format=kind, dpi=dpi, transparent=transparent, metadata=metadata)
    return drawn.getvalue()


def inline_svg(figure: Figure, key: str, words: str) -> Markup:
    """Return a figure as an inline SVG element in the page's colours, with alternative text.

    The key becomes the prefix of all ids in the figure; it must be unique in the page.
    """
    text = figure_bytes(figure, "svg", _INLINE_DPI, transparent=True).decode()
    text = text[text.index("<svg") :]
    # Remove the metadata and the style element; the style would also apply outside the figure.
    text = re.sub(r"<metadata>.*?</metadata>|<style[^>]*>.*?</style>", "", text, flags=re.DOTALL)
    head, body = text.split(">", 1)
    width = float(head.split('width="', 1)[1].split('pt"', 1)[0])
    view = 'viewBox="' + head.split('viewBox="', 1)[1].split('"', 1)[0] + '"'
    body = body.replace("xlink:href=", "href=")
    body = re.sub(r'\bid="([^"]*)"', rf'id="{key}-\1"', body)
    body = re.sub(r"url\(#([^)]*)\)", rf"url(#{key}-\1)", body)
    body = re.sub(r'href="#([^"]*)"', rf'href="#{key}-\1"', body)
    for color, name in _THEMED.items():
        body = re.sub(re.escape(color), f"var(--{name})", body, flags=re.IGNORECASE)
    size = f'style="max-width: {_PX_PER_PT * width:.0f}px"'
    return Markup(f'<svg class="plot" role="img" aria-label="{escape(words)}" {size} {view}>{body}')
