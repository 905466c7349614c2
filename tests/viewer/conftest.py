"""A served example actor, and a browser that looks at it."""

import os
import shutil
from pathlib import Path

import pytest
from example_rig import FPS, example_meshes, example_motion, example_rig

from jawusd.pipeline.view import open_viewer
from jawusd.rig.bake import bake_rig

CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "chrome")
# Software GL, so that machines without a graphics card show the page too.
ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@pytest.fixture(scope="session")
def _baked(tmp_path_factory):
    folder = tmp_path_factory.mktemp("viewed")
    frames, d = example_motion()
    bake_rig(folder, example_rig(), example_meshes(), name="someone", fps=FPS, frames=frames, d=d, table_size=17)
    return folder


@pytest.fixture
def folder(_baked, tmp_path):
    """Return a fresh copy of the baked rig folder."""
    return shutil.copytree(_baked, tmp_path / "actor")


@pytest.fixture
def viewer(folder):
    """Serve the rig on a free port of this machine."""
    running = open_viewer(folder, "127.0.0.1", 0)
    yield running
    running.stop()


@pytest.fixture(scope="module")  # while it runs, playwright's event loop is in the way of others
def chromium():
    """Return a running headless Chromium; skips where there is none."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, CHROMIUM)), None)
    if path is None or not Path(path).is_file():
        pytest.skip("there is no Chromium; install one or name it in the variable CHROMIUM")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=ARGUMENTS)
        yield browser
        browser.close()
