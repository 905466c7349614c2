"""Meshes written into a rig come back as they were; a placeholder does not."""

import numpy as np
import pytest
from example_rig import FPS, example_meshes, example_motion, example_rig

from jawusd.errors import RigError
from jawusd.rig.bake import bake_rig
from jawusd.rig.geo import read_geometry


def bake(folder, meshes):
    frames, d = example_motion()
    bake_rig(folder, example_rig(), meshes, name="someone", fps=FPS, frames=frames, d=d, table_size=17)
    return folder / "geo.usdc"


def test_meshes_come_back_in_single_precision(tmp_path):
    meshes = example_meshes()
    found = read_geometry(bake(tmp_path, meshes))
    assert set(found) == set(meshes)
    for name, mesh in meshes.items():
        np.testing.assert_array_equal(found[name].vertices, mesh.vertices.astype(np.float32))
        np.testing.assert_array_equal(found[name].faces, mesh.faces)


def test_a_placeholder_is_no_bone(tmp_path):
    meshes = {name: mesh for name, mesh in example_meshes().items() if name != "mandible"}
    path = bake(tmp_path, meshes)
    assert "mandible" not in read_geometry(path) and set(read_geometry(path, placeholders=True)) == {"mandible"}


def test_what_is_no_geometry_is_refused(tmp_path):
    with pytest.raises(RigError, match="no such file"):
        read_geometry(tmp_path / "geo.usdc")
