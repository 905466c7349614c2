"""An example actor served by the viewer, and a browser."""

import shutil

import pytest
from browser import headless_chromium
from example_rig import FPS, example_meshes, example_motion, example_rig

from jawusd.pipeline.view import open_viewer
from jawusd.rig.bake import bake_rig


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
    """Serve the rig, its jaw at rest, on a free port of this machine."""
    running = open_viewer(folder, "127.0.0.1", 0, play=False)
    yield running
    running.stop()


@pytest.fixture
def playing(folder):
    """Serve the rig as the command does: pages begin by playing the captured take."""
    running = open_viewer(folder, "127.0.0.1", 0)
    yield running
    running.stop()


chromium = pytest.fixture(headless_chromium, scope="module")
