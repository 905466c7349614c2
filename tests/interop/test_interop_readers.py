"""Programs without jawusd read its rigs: other OpenUSD versions, tinyusdz, three.js, NVIDIA's validator."""

import json
import shutil
import subprocess

import numpy as np
import pytest
from example_rig import (
    FPS,
    choose_variants,
    example_meshes,
    example_motion,
    example_proxies,
    example_rig,
    scanned_meshes,
)
from foreign import SCRIPTS, environment, run, run_in
from package_copy import ROOT
from scipy.spatial.transform import Rotation

from jawusd.evaluator import JawRig
from jawusd.geometry import Camera, make_transform
from jawusd.plugins.extension import copy_scripts
from jawusd.rig.bake import bake_rig
from jawusd.rig.cameras import write_cameras
from jawusd.rig.glb import write_glb
from jawusd.rig.validate import nvidia_findings

SHOWN = (0, 9, 17, 30, 39)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a baked example rig."""
    frames, d = example_motion()
    made = tmp_path_factory.mktemp("actor")
    options = {"name": "example", "fps": FPS, "proxies": example_proxies()}
    bake_rig(made, example_rig(), scanned_meshes(), frames=frames, d=d, **options)
    choose_variants(made / "anim_capture.usdc", made / "skeleton.usda", motion="skeleton")
    choose_variants(made / "anim_capture.usdc", made / "both.usda", motion="skeleton", detail="both")
    K = np.array([[2000.0, 0, 959.5], [0, 2000, 539.5], [0, 0, 1]])
    camera = Camera("cam0", (1920, 1080), K, np.array([-0.1, 0.02, 0, 0, 0]), make_transform(np.eye(3), [0, 0, 250]))
    heads = make_transform(np.eye(3), np.outer(np.arange(len(frames)), [0.1, 0, 0.05]))
    write_cameras(made / "cameras.usda", [camera], made / "anim_capture.usdc", frames, heads, FPS)
    return made


def expected_poses():
    """Return the tested frames and their poses by the evaluator."""
    frames, d = example_motion()
    rows = list(SHOWN)
    return frames[rows], example_rig().pose(d[rows])


def landmark_distance(T_a, T_b):
    """Return the largest distance [mm] of a landmark under two sets of poses."""
    landmarks = np.c_[example_rig().arrays["landmarks"], np.ones(5)]
    return np.linalg.norm(((T_a - T_b) @ landmarks.T)[:, :3], axis=1).max()


@pytest.mark.parametrize("name", ["usd2411", "usd255", "usd2611"])
def test_every_openusd_shows_the_same_poses(folder, name):
    frames, poses = expected_poses()
    for file in ("anim_capture.usdc", "actor.usdz"):
        found = run_in(name, "usd_read.py", folder / file, ",".join(map(str, frames)))
        assert landmark_distance(np.array(found["poses"]), poses) < 1e-6
        np.testing.assert_allclose(found["d"], example_motion()[1][list(SHOWN)], atol=1e-12)
        assert found["table"] == 33**3 * 6 and "JawRigAPI" in found["schemas"]


@pytest.mark.parametrize("name", ["usd2411", "usd255", "usd2611"])
def test_the_single_file_reader_reads_usd_with_every_openusd(folder, tmp_path, name):
    reader, *_ = copy_scripts(tmp_path)
    d = [[0.0, 0.0, 0.0], [20.0, 1.0, 0.5], [20.0, 7.6, 9.2]]
    code = f"import sys, json; sys.path.insert(0, {str(reader.parent)!r}); import jawusd_reader as r; "
    code += f"rig = r.load({str(folder / 'actor.usda')!r}); d = json.loads({json.dumps(d)!r}); "
    code += "found = [[rig.pose(*x) for x in d], [rig.project(*x) for x in d], 'numpy' in sys.modules]; "
    code += "print('RESULT', json.dumps(found))"
    poses, inside, numpy_loaded = run([environment(name) / "bin" / "python", "-c", code])
    np.testing.assert_allclose(poses, example_rig().pose(d), atol=1e-9)
    np.testing.assert_allclose(inside, example_rig().project(d), atol=1e-5)
    assert not numpy_loaded


@pytest.mark.parametrize("name", ["usd2411", "usd255"])
def test_jawusd_itself_runs_on_older_openusd(folder, tmp_path, name, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # the installed jawusd comes with another OpenUSD
    found = run_in(name, "jawusd_read.py", shutil.copytree(folder, tmp_path / "actor"))
    np.testing.assert_allclose(found["poses"], example_rig().pose([[10.0, 1.0, 0.5], [0.0, 0.0, 0.0]]), atol=1e-12)
    assert found["kind"] == "anchored"
    assert found["findings"] == found["bone_findings"] == [["info", "Onnx"], ["info", "Stock"]]
    assert landmark_distance(np.array(found["bones"]), example_rig().pose(example_motion()[1])) < 1e-4


def test_tinyusdz_reads_rig_and_motion(folder):
    found = run_in("tinyusdz", "tinyusdz_read.py", folder / "actor.usdz")
    assert found["shape"] == [33, 33, 33] and "JawRigAPI" in found["schemas"] and found["meshes"] == 4
    frames, poses = expected_poses()
    translation, rotation = found["channels"]["translation"], found["channels"]["rotation"]
    at = [translation["times"].index(frame) for frame in frames]
    xyzw = Rotation.from_quat(np.array(rotation["values"])[at])
    T = make_transform(xyzw.as_matrix(), np.array(translation["values"])[at])
    assert landmark_distance(T, poses) < 1e-3


def test_tinyusdz_reads_the_interface_layer(folder):
    """It ignores sublayers, but must parse the text."""
    environment("tinyusdz")
    code = "import sys, tinyusdz; p = tinyusdz.load(sys.argv[1]).get_prim_at_path('/Actor');"
    code += "import json; print('RESULT ' + json.dumps([p.api_schemas(), p.get_attribute('jaw:d1').value.as_scalar()]))"
    found = run([environment("tinyusdz") / "bin" / "python", "-c", code, folder / "actor.usda"])
    assert "JawRigAPI" in found[0] and found[1] == 0.0


def test_three_js_animates_the_mandible(folder):
    frames, poses = expected_poses()
    times = ",".join(str(frame / FPS) for frame in frames)
    modules = environment("threejs") / "node_modules"
    found = run(["node", SCRIPTS / "three_read.mjs", modules, folder / "actor.usdz", times, "MandibleMesh"])
    shown = np.array([found["matrices"][str(frame / FPS).removesuffix(".0")] for frame in frames]).reshape(-1, 4, 4)
    assert landmark_distance(shown, poses) < 0.01
    assert found["looks"]["UpperTeethMesh"] == ["normal", "position", "uv"]


def test_three_js_plays_glb(folder, tmp_path):
    """Frame 0 is at 0 s, lengths are metres."""
    all_frames, d = example_motion()
    frames, poses = expected_poses()
    glb = write_glb(tmp_path / "take.glb", folder / "actor.usda", example_rig(), all_frames, d, FPS)
    seconds = [frame / FPS for frame in frames.tolist()]
    modules, times = environment("threejs") / "node_modules", ",".join(map(str, seconds))
    found = run(["node", SCRIPTS / "three_read.mjs", modules, glb, times, "MandibleMesh"])
    shown = np.array([found["matrices"][str(time).removesuffix(".0")] for time in seconds]).reshape(-1, 4, 4)
    shown[:, :3, 3] *= 1000
    assert landmark_distance(shown, poses) < 1e-4
    assert {"color", "uv"} < set(found["looks"]["UpperTeethMesh"])


def test_three_js_reads_whole_numbers(tmp_path):
    """The closed bite of scans in occlusion is the identity: its translation is made of integers."""
    rig = JawRig({**example_rig().arrays, "T_rest": np.eye(4)}, example_rig().meta)
    d = np.array([[0.0, 0, 0], [8, 1, 0.5], [0, 0, 0]])
    bake_rig(tmp_path, rig, example_meshes(), name="x", fps=FPS, frames=[0, 1, 2], d=d, table_size=17)
    modules, times = environment("threejs") / "node_modules", [k / FPS for k in range(3)]
    arguments = (modules, tmp_path / "actor.usdz", ",".join(map(str, times)), "MandibleMesh")
    found = run(["node", SCRIPTS / "three_read.mjs", *arguments])
    shown = [found["matrices"][str(time).removesuffix(".0")] for time in times]
    assert landmark_distance(np.array(shown, dtype=float).reshape(-1, 4, 4), rig.pose(d)) < 0.01


@pytest.mark.parametrize(
    "name",
    [
        "actor.usda",
        "anim_capture.usdc",
        "skeleton.usda",
        "both.usda",
        "actor.usdz",
        "actor_skel.usdc",
        "cameras.usda",
        "cameras_motion.usdc",
    ],
)
def test_nvidia_validator_finds_nothing(folder, name):
    program = environment("nvidia") / "bin" / "nvidia_usd_validate"
    done = subprocess.run([program, folder / name], capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stdout + done.stderr
    assert nvidia_findings(folder / name, program) == []


def test_nvidia_validator_finds_a_missing_file(folder, tmp_path):
    program = environment("nvidia") / "bin" / "nvidia_usd_validate"
    copied = shutil.copytree(folder, tmp_path / "actor")
    (copied / "geo.usdc").unlink()
    assert "error" in {finding.severity for finding in nvidia_findings(copied / "actor.usda", program)}
