"""Figures as SVG inside a page: no outside reference, and colours that follow the page's light or dark theme."""

from __future__ import annotations

import io
import re

import matplotlib
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from jawusd.report.style import BLACK, BLUE, GREEN, GREY, ORANGE, PALE, SETTINGS, SKY, VERMILION

_PX_PER_PT = 4 / 3
# What the page's style sheet calls the colours; white is what is drawn under text.
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


def inline_svg(figure: Figure, key: str, words: str) -> Markup:
    """Return a figure as an SVG element for a page.

    Args:
        figure: what to draw.
        key: begins all ids of this figure; unique in the page.
        words: says what the figure shows, to people who do not see it.
    """
    drawn = io.BytesIO()
    with matplotlib.rc_context(SETTINGS):
        figure.savefig(drawn, format="svg", dpi=110, transparent=True, metadata={"Date": None})
    text = drawn.getvalue().decode()
    text = text[text.index("<svg") :]
    # Not needed inside a page, and the style would reach out of the figure.
    text = re.sub(r"<metadata>.*?</metadata>|<style[^>]*>.*?</style>", "", text, flags=re.DOTALL)
    head, body = text.split(">", 1)
    width, view = float(re.search(r'width="([\d.]+)pt"', head)[1]), re.search(r'viewBox="[^"]*"', head)[0]
    body = body.replace("xlink:href=", "href=")
    body = re.sub(r'\bid="([^"]*)"', rf'id="{key}-\1"', body)
    body = re.sub(r"url\(#([^)]*)\)", rf"url(#{key}-\1)", body)
    body = re.sub(r'href="#([^"]*)"', rf'href="#{key}-\1"', body)
    for color, name in _THEMED.items():
        body = re.sub(re.escape(color), f"var(--{name})", body, flags=re.IGNORECASE)
    size = f'style="max-width: {_PX_PER_PT * width:.0f}px"'
    return Markup(f'<svg class="plot" role="img" aria-label="{escape(words)}" {size} {view}>{body}')
