"""The Blender file without add-on: Geometry Nodes pose the mandible with all scripts switched off."""

import json
import shutil

import numpy as np
import pytest
from example_rig import FPS, example_meshes, example_motion, example_rig, moved, touching_rig
from foreign import run_in

from jawusd.plugins.extension import copy_scripts
from jawusd.rig.bake import bake_rig
from jawusd.rig.sampling import sample_valid

MESHES = {"MandibleMesh": "mandible", "LowerTeethMesh": "lower_teeth"}


@pytest.fixture(scope="module", params=["anchored", "additive", "touching"])
def actor(request, tmp_path_factory):
    """Return a rig and its folder."""
    rig, (frames, d) = touching_rig() if request.param == "touching" else example_rig(request.param), example_motion()
    folder = tmp_path_factory.mktemp(request.param)
    bake_rig(folder, rig, example_meshes(), name="x", fps=FPS, frames=frames, d=d, table_size=17)
    return rig, folder


@pytest.mark.slow
@pytest.mark.parametrize("blender", ["blender45", "blender50"])
@pytest.mark.parametrize("file", ["anim_capture.usdc", "actor.usdz"])
def test_nodes_pose_the_mandible_without_scripts(tmp_path, blender, actor, file):
    rig, folder = actor
    meshes, (frames, d) = example_meshes(), example_motion()
    shutil.copytree(folder, tmp_path / "actor")
    # also at rest, and beyond the ends of the model's curves
    poses = np.concatenate([np.zeros((1, 3)), sample_valid(rig, 50, seed=6), [[-2, 3, 1], [70, 0, 0], [5, -14, -5]]])
    (tmp_path / "poses.json").write_text(json.dumps(poses.tolist()))
    copy_scripts(tmp_path / "scripts")
    run_in(blender, "blender_nodes.py", tmp_path / "scripts", "make", tmp_path / "actor" / file, tmp_path / "jaw.blend")
    (tmp_path / "actor").rename(tmp_path / "gone")  # the file stands alone
    shown = (30, 38, 55)
    arguments = ("reopen", tmp_path / "jaw.blend", tmp_path / "poses.json", ",".join(map(str, shown)), ",".join(MESHES))
    found = run_in(blender, "blender_nodes.py", tmp_path / "scripts", *arguments)
    for mesh, name in MESHES.items():
        places = np.array(found["poses"][mesh])
        distance = np.linalg.norm(places - moved(rig.pose(poses), meshes[name].vertices), axis=-1)
        assert distance.max() < 0.002
        for frame in shown:
            expected = moved(rig.pose(d[frame - frames[0]])[None], meshes[name].vertices)[0]
            assert np.linalg.norm(np.array(found["frames"][str(frame)][mesh]) - expected, axis=1).max() < 0.002
    np.testing.assert_allclose(found["limits"], rig.arrays["d_range"], atol=1e-5)
    assert found["fps"] == pytest.approx(FPS)
    assert found["texts"] == 0 and found["drivers"] == [["SUM", True]] * 3
