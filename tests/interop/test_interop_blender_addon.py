"""The Blender add-on, installed from its zip: playback, sliders, bound, handle, export."""

import json

import numpy as np
import pytest
from example_rig import (
    FPS,
    assert_valid_usd,
    choose_variants,
    example_meshes,
    example_motion,
    example_rig,
    mandible_vertices,
    moved,
)
from foreign import run_in

from jawusd.plugins.extension import build_extension
from jawusd.rig.animation import write_animation
from jawusd.rig.bake import bake_rig
from jawusd.rig.motion_read import read_parameters_of_stage
from jawusd.rig.table import sample_valid

BLENDERS = ["blender45", "blender50"]
EXACT_MM = 1e-4


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """Return the zip of the extension."""
    return build_extension(tmp_path_factory.mktemp("zip") / "jawusd_blender.zip")


@pytest.fixture(scope="module", params=["anchored", "additive"])
def actor(request, tmp_path_factory):
    """Return a rig and its folder."""
    rig, (frames, d) = example_rig(request.param), example_motion()
    folder = tmp_path_factory.mktemp(request.param)
    bake_rig(folder, rig, example_meshes(), name="x", fps=FPS, frames=frames, d=d, table_size=17)
    return rig, folder


def distance_mm(matrices, rig, d):
    """Return the largest distance of the mandible's vertices from their positions by the evaluator."""
    points = mandible_vertices()
    return np.linalg.norm(moved(np.array(matrices), points) - moved(rig.pose(d), points), axis=-1).max()


@pytest.mark.slow
@pytest.mark.parametrize("blender", BLENDERS)
def test_takes_play_as_the_evaluator_says(tmp_path, archive, actor, blender):
    """Imported at 59.94 fps, and keyed; frames in any order; saved on any frame and reopened."""
    rig, folder = actor
    frames, d = example_motion()
    write_animation(tmp_path / "anim.usdc", folder / "actor.usda", frames, d, 60000 / 1001)
    keyed = []
    for seed in range(30):
        times = np.cumsum(np.random.default_rng(seed).integers(2, 9, 6))
        # 0, 6, 0 was once shown as 0, 2.83, 0; values beyond the slider limits must not be clamped either
        keyed.append(np.column_stack([times, sample_valid(rig, 6, seed=seed)]).tolist())
    (tmp_path / "keyed.json").write_text(json.dumps(keyed))
    arguments = (archive, tmp_path, tmp_path / "anim.usdc", tmp_path / "keyed.json", "30,42,69")
    found = run_in(blender, "blender_playback.py", *arguments)
    for take, values, keys in zip(found["takes"], found["d"], [None, *keyed], strict=True):
        shown, played = np.array([values[frame] for frame in take]), np.array(list(take.values()))
        assert played.shape == (len(take), 5, 4, 4)
        assert np.max([distance_mm(played[:, way], rig, shown) for way in range(5)]) < EXACT_MM
        if keys is None:
            np.testing.assert_allclose(shown, d[np.array(list(take), int) - frames[0]], atol=1e-5)
        for frame, *wanted in keys or ():
            np.testing.assert_allclose(values[str(int(frame))], wanted, atol=1e-5)
    assert found["scene"] == [pytest.approx(60000 / 1001, rel=1e-6), "MILLIMETERS"]


@pytest.mark.slow
@pytest.mark.parametrize("blender", BLENDERS)
def test_sliders_bound_handle_export_and_two_actors(tmp_path, archive, actor, blender):
    rig, folder = actor
    frames, d = example_motion()
    poses = {
        # also near the closed bite, where quaternions are nearly integers
        "inside": np.concatenate([sample_valid(rig, 30, seed=5), 0.1 * sample_valid(rig, 10, seed=6)]),
        "outside": np.array([[20.0, 9.0, 1.0], [0.0, 6.0, 0.0], [60.0, 0.0, 0.0], [5.0, -8.0, -5.0]]),
    }
    (tmp_path / "poses.json").write_text(json.dumps({name: rows.tolist() for name, rows in poses.items()}))
    bones = choose_variants(folder / "anim_capture.usdc", folder / f"bones_{blender}.usda", motion="skeleton")
    arguments = (archive, tmp_path, folder / "anim_capture.usdc", tmp_path / "poses.json", bones)
    found = run_in(blender, "blender_addon.py", *arguments)
    assert found["keys"] == 3 * len(frames) and found["frames"] == [frames[0], frames[-1]]
    for name in ("inside", "outside"):
        assert distance_mm(found["poses" if name == "inside" else name], rig, poses[name]) < EXACT_MM
    for (hard_low, low, high, hard_high), limits in zip(found["limits"], rig.d_range):
        np.testing.assert_allclose([low, high], limits)
        assert hard_low <= low - 1 and hard_high >= high + 1
    inside, outside = found["readout"]
    assert inside[0].startswith("inside") and outside[0].startswith("OUTSIDE") and len(inside) == 2
    ranges = np.array([rig.ranges(*row) for row in poses["inside"]])
    np.testing.assert_allclose(found["ranges"], ranges, atol=1e-6)
    line = "here: d2 {:.1f} .. {:.1f}, d3 {:.1f} .. {:.1f} mm"
    assert found["shown_ranges"] == [line.format(*row) for row in found["ranges"]]
    kept = np.array([rig.keep_inside([0.0], row[None]).d[0] for row in poses["outside"]])
    assert distance_mm(found["kept"], rig, kept) < EXACT_MM
    np.testing.assert_allclose(found["sliders"], poses["outside"][-1])  # only the displayed pose is moved inside
    check_two_actors(rig, found["two"], poses["inside"])
    disabled, enabled = (distance_mm([found["enabled"][k]], rig, poses["inside"][[1]]) for k in (0, 1))
    assert disabled > 0.1 and enabled < EXACT_MM
    # rigs moved by bones get no sliders
    assert found["bones"]["actors"] == []
    expected = moved(rig.pose(d[[42 - frames[0]]]), example_meshes()["mandible"].vertices)[0]
    assert np.linalg.norm(np.array(found["bones"]["places"]) - expected, axis=1).max() < EXACT_MM
    dragged = found["dragged"]
    expected = rig.ik(rig.landmarks[0], dragged["target"], start=poses["inside"][0])
    np.testing.assert_allclose(dragged["d"], expected.d, atol=1e-3)
    reached = moved(rig.pose(np.array(dragged["d"]))[None], rig.landmarks[:1])[0, 0]
    np.testing.assert_allclose([dragged["at"], dragged["played"]], [reached, reached], atol=1e-4)
    assert distance_mm([found["older"]], rig, poses["inside"][[1]]) < EXACT_MM
    for name in ("exported.usdc", "kept.usdc"):
        assert_valid_usd(tmp_path / name)
    times, exported, fps = read_parameters_of_stage(tmp_path / "exported.usdc")
    np.testing.assert_array_equal(times, frames)
    np.testing.assert_allclose(exported, d, atol=1e-5)
    assert fps == FPS
    assert "there is no such file" in found["gone"] and not (tmp_path / "groundless.usdc").exists()
    assert found["overridden"]["override"]
    assert distance_mm([found["overridden"]["pose"]], rig, kept[:1]) < EXACT_MM


def check_two_actors(rig, two, inside):
    """Check that two imports of one actor are separate: each is posed by its own sliders, and the second plays."""
    frames, d = example_motion()
    assert two["names"] == ["Actor", "Actor.001"]
    assert distance_mm(two["played"][1:], rig, d[[42 - frames[0]]]) < EXACT_MM
    for place, wanted in ((0, inside), (1, inside[::-1])):
        assert distance_mm([matrices[place] for matrices in two["posed"]], rig, wanted) < EXACT_MM
