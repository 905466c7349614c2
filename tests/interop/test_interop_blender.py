"""Blender imports rigs without any add-on: the baked ops as a cache, the skeleton as bones with editable keys."""

import numpy as np
import pytest
from example_rig import (
    FPS,
    choose_variants,
    example_meshes,
    example_motion,
    example_proxies,
    example_rig,
    moved,
    scanned_meshes,
)
from foreign import run_in

from jawusd.rig.bake import bake_rig
from jawusd.rig.geo import linear_from_srgb
from jawusd.rig.glb import write_glb
from jawusd.rig.stage_poses import fit_poses_of_stage

MESHES = {"MandibleMesh": "mandible", "LowerTeethMesh": "lower_teeth", "SkullMesh": "skull"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a baked example rig whose scans are not quite in occlusion."""
    frames, d = example_motion()
    made = tmp_path_factory.mktemp("actor")
    options = {"name": "example", "fps": FPS, "proxies": example_proxies()}
    bake_rig(made, example_rig(), scanned_meshes(), frames=frames, d=d, **options)
    choose_variants(made / "anim_capture.usdc", made / "skeleton.usda", motion="skeleton")
    choose_variants(made / "anim_capture.usdc", made / "both.usda", detail="both")
    return made


@pytest.mark.parametrize("blender", ["blender45", "blender50"])
@pytest.mark.parametrize("name", ["anim_capture.usdc", "actor.usdz", "actor_skel.usdc", "skeleton.usda", "both.usda"])
def test_vertices_are_where_the_model_puts_them(folder, blender, name):
    frames, d = example_motion()
    shown = np.arange(0, len(frames), 2)
    found = run_in(blender, "blender_import.py", folder / name, ",".join(map(str, frames[shown])), ",".join(MESHES))
    for k in shown:
        pose = example_rig().pose(d[k])
        for mesh, key in MESHES.items():
            T = np.eye(4) if key == "skull" else pose
            expected = moved(T[None], example_meshes()[key].vertices)[0]
            places = np.array(found["frames"][str(frames[k])][mesh])
            assert np.linalg.norm(places - expected, axis=1).max() < 0.01
    if name in ("actor_skel.usdc", "skeleton.usda"):
        assert found["bones"] == ["Actor_skull", "Actor_jaw"] and max(found["actions"].values()) == len(frames)
    else:
        assert not found["bones"]
    if name != "actor_skel.usdc":
        assert {"jaw:d1", "jaw:d1:range", "jaw:formatVersion", "jaw:modelHash"} <= set(found["properties"])


@pytest.mark.parametrize("blender", ["blender45", "blender50"])
def test_glb_moves_as_the_model_does(folder, tmp_path, blender):
    frames, d = example_motion()
    glb = write_glb(tmp_path / "take.glb", folder / "actor.usda", example_rig(), frames, d, FPS)
    shown = np.arange(0, len(frames), 4)
    at = ",".join(str(frames[k]) for k in shown)
    found = run_in(blender, "blender_gltf.py", glb, int(FPS), at, "MandibleMesh")
    vertices = example_meshes()["mandible"].vertices
    for k in shown:
        expected = moved(example_rig().pose(d[k])[None], vertices)[0]
        places = np.array(found["frames"][str(frames[k])])
        assert np.linalg.norm(places - expected, axis=1).max() < 1e-3
    assert found["looks"]["UpperTeethMesh"] == [1, 1] and found["looks"]["MandibleMesh"] == [0, 0]


def test_a_selected_proxy_moves_like_the_scan(folder, tmp_path):
    proxies, (frames, d) = example_proxies(), example_motion()
    crowd = choose_variants(folder / "anim_capture.usdc", folder / "crowd.usda", detail="proxy")
    found = run_in("blender45", "blender_import.py", crowd, str(frames[20]), "LowerTeethMesh,SkullMesh")
    shown = found["frames"][str(frames[20])]
    expected = moved(example_rig().pose(d[20])[None], proxies["lower_teeth"].vertices)[0]
    assert np.linalg.norm(np.array(shown["LowerTeethMesh"]) - expected, axis=1).max() < 0.01
    assert np.linalg.norm(np.array(shown["SkullMesh"]) - proxies["skull"].vertices, axis=1).max() < 0.01


@pytest.mark.parametrize("blender", ["blender45", "blender50"])
def test_colours_and_texture_coordinates_arrive(folder, blender):
    arguments = (folder / "actor.usdz", "30", "UpperTeethMesh,LowerTeethMesh")
    looks, upper = run_in(blender, "blender_import.py", *arguments)["looks"], scanned_meshes()["upper_teeth"]
    np.testing.assert_allclose(looks["UpperTeethMesh"]["colors"], linear_from_srgb(upper.colors), atol=1e-6)
    np.testing.assert_array_equal(np.float32(looks["UpperTeethMesh"]["uv"]), upper.uv.reshape(-1, 2))
    assert looks["LowerTeethMesh"]["uv"] is None


@pytest.mark.parametrize("blender", ["blender45", "blender50"])
@pytest.mark.parametrize("name", ["anim_capture.usdc", "actor_skel.usdc", "skeleton.usda"])
def test_what_blender_exports_comes_back_to_d(folder, tmp_path, blender, name):
    frames, d = example_motion()
    run_in(blender, "blender_export.py", folder / name, tmp_path / "out.usdc", frames[0], frames[-1])
    found = fit_poses_of_stage(tmp_path / "out.usdc", folder / "actor.usda")
    np.testing.assert_array_equal(found.frames, frames)
    back, residual_mm = example_rig().encode(found.T)
    np.testing.assert_allclose(back, d, atol=1e-3)
    assert residual_mm.max() < 1e-3
