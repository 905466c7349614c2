"""A headless Chromium for tests of pages."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
# Software GL, so that machines without a graphics card show the pages too.
PATIENCE_MS = 120_000  # for one step of a page: software GL on a machine that does other work, too
_ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def keep_picture(page, name: str, **how: bool) -> None:
    """Save a screenshot in the folder that SCREENSHOTS names, as continuous integration does; else do nothing."""
    if "SCREENSHOTS" in os.environ:
        page.screenshot(path=Path(os.environ["SCREENSHOTS"]) / f"{name}.png", **how)


def open_page(chromium, width: int, height: int, **context: object):
    """Return an empty page of a size in px, in a context of its own, that waits for a slow machine."""
    opened = chromium.new_context(viewport={"width": width, "height": height}, **context)
    opened.set_default_timeout(PATIENCE_MS)
    return opened.new_page()


def headless_chromium() -> Iterator:
    """Yield a running headless Chromium and close it afterwards; skips where there is none.

    For fixtures of no more than module scope: while it runs, playwright's event loop is in the way of others.
    """
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, _NAMES)), None)
    if path is None or not Path(path).is_file():
        pytest.skip("there is no Chromium; install one or name it in the variable CHROMIUM")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=_ARGUMENTS)
        yield browser
        browser.close()
