"""The Blender add-on: sliders, live ranges, keys; saved and reopened."""

import json

import numpy as np
import pytest
from example_rig import FPS, example_meshes, example_motion, example_rig, moved
from foreign import run_in

from jawusd.plugins.extension import build_extension
from jawusd.rig.bake import bake_rig
from jawusd.rig.sampling import sample_valid


@pytest.mark.parametrize("blender", ["blender45", "blender50"])
@pytest.mark.parametrize("kind", ["anchored", "additive"])
def test_sliders_ranges_and_keys_survive_saving(tmp_path, blender, kind):
    rig, vertices = example_rig(kind), example_meshes()["mandible"].vertices
    frames, d = example_motion()
    bake_rig(tmp_path / "actor", rig, example_meshes(), name="x", fps=FPS, frames=frames, d=d)
    archive = build_extension(tmp_path / "jawusd_blender.zip")
    # near the closed bite as well: its quaternions are nearly whole numbers
    poses = np.concatenate([sample_valid(rig, 50, seed=5), 0.1 * sample_valid(rig, 20, seed=6)])
    (tmp_path / "poses.json").write_text(json.dumps(poses.tolist()))
    (tmp_path / "work").mkdir()
    for arguments in (["import", tmp_path / "actor" / "anim_capture.usdc"], ["reopen"]):
        found = run_in(blender, "blender_addon.py", archive, tmp_path / "work", *arguments, tmp_path / "poses.json")
        distance = np.linalg.norm(np.array(found["poses"]) - moved(rig.pose(poses), vertices), axis=-1)
        assert distance.max() < 0.001
        expected = np.array([rig.ranges(*row) for row in poses])
        np.testing.assert_allclose(np.array(found["ranges"]).reshape(-1, 4), expected, atol=1e-6)
        for frame, shown in found["frames"].items():
            k = int(frame) - frames[0]
            np.testing.assert_allclose(shown["d"], d[k], atol=1e-5)
            assert np.abs(np.array(shown["places"]) - moved(rig.pose(d[k])[None], vertices)[0]).max() < 0.01
        assert all(found["drivers"]) and len(found["drivers"]) == 7
        if arguments[0] == "import":
            assert found["keys"] == 3 * len(frames)
            assert found["second"] == ["Actor", "Actor.001"]
