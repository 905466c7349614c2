"""Baked example rigs, made once per run and copied to a new folder for every test."""

import shutil

import pytest
from example_rig import FPS, example_meshes, example_motion, example_rig

from jawusd.rig.bake import bake_rig


@pytest.fixture(scope="session")
def _baked(tmp_path_factory):
    folders = {}

    def bake(kind):
        if kind not in folders:
            folders[kind] = tmp_path_factory.mktemp(f"baked_{kind}")
            frames, d = example_motion()
            bake_rig(folders[kind], example_rig(kind), example_meshes(), name="example", fps=FPS, frames=frames, d=d)
        return folders[kind]

    return bake


@pytest.fixture(params=["anchored", "additive"])
def kind(request):
    """Run the test for both kinds of model."""
    return request.param


@pytest.fixture
def folder(_baked, kind, tmp_path):
    """Return a fresh copy of the baked rig folder of a kind."""
    return shutil.copytree(_baked(kind), tmp_path / "actor")


@pytest.fixture
def anchored_folder(_baked, tmp_path):
    """Return a fresh copy of the baked anchored rig folder."""
    return shutil.copytree(_baked("anchored"), tmp_path / "actor")
