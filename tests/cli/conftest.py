"""A baked rig for the tests of commands, made once."""

import pytest
from example_rig import FPS, example_meshes, example_motion, example_rig

from jawusd.rig.bake import bake_rig


@pytest.fixture(scope="session")
def actor(tmp_path_factory):
    """Return the file of the rig; tests write other files beside it."""
    folder = tmp_path_factory.mktemp("actor")
    frames, d = example_motion()
    bake_rig(folder, example_rig(), example_meshes(), name="someone", fps=FPS, frames=frames, d=d, table_size=17)
    return folder / "actor.usda"
