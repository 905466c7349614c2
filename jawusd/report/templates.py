"""Jinja templates, style sheet and scripts of the pages."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Iterable
from importlib import resources

import jinja2
from markupsafe import Markup, escape

from jawusd.base.errors import shown


def rendered(template: str, scripts: Iterable[str] = (), **values: object) -> str:
    """Return a page of this package as HTML, with style sheet and scripts; text from files is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("jawusd.report", "page"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        # HTML from this package is of type Markup
        finalize=lambda value: shown(value) if type(value) is str else value,
    )
    environment.filters |= {"worded": worded, "figure": figure, "base64": base64_text}
    values |= {"style": package_file("report.css"), "script": Markup().join(map(package_file, scripts))}
    return environment.get_template(template).render(values)


def worded(text: str) -> Markup:
    """Return a sentence as HTML, with text in backticks marked as code."""
    parts = re.split(r"`([^`]*)`", shown(text))  # parts at odd indices were in backticks
    return Markup().join(Markup("<code>{}</code>").format(p) if k % 2 else escape(p) for k, p in enumerate(parts))


def figure(value: float) -> str:
    """Return a length in mm with three decimals, or a dash if it is unknown."""
    return f"{value:.3f}" if math.isfinite(value) else "\u2013"


def base64_text(data: bytes) -> str:
    """Return bytes as text for a page."""
    return base64.b64encode(data).decode("ascii")


def package_file(name: str) -> Markup:
    """Return a text file of this package as trusted HTML."""
    return Markup(resources.files("jawusd.report").joinpath("page", name).read_text(encoding="utf-8"))
