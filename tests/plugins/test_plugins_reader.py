"""The single-file reader against the evaluator, in this Python and, as one file, in a bare one."""

import ast
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from example_model import example_arrays, example_meta
from example_rig import FPS, example_meshes, example_motion, example_rig
from pxr import Sdf
from scipy.spatial.transform import Rotation

from jawusd.evaluator import JawRig
from jawusd.evaluator.formula import MODELS
from jawusd.evaluator.schema import KINDS
from jawusd.formats.model import JawModel, save_model
from jawusd.plugins import extension, jawusd_reader
from jawusd.plugins.extension import packed_reader
from jawusd.rig.bake import bake_rig
from jawusd.rig.sampling import sample_valid


@pytest.fixture(params=["anchored", "additive"])
def rig(request):
    """Return the example rig of both kinds."""
    return example_rig(request.param)


@pytest.fixture
def model_file(rig, tmp_path):
    """Return a model.npz of the example rig."""
    none = np.zeros(0)
    model = JawModel(dict(rig.arrays), none.astype(int), np.zeros((0, 3)), none, none.astype(bool), dict(rig.meta))
    save_model(tmp_path / "model.npz", model)
    return tmp_path / "model.npz"


def assert_same_jaw(read, rig):
    """Compare poses and margins at valid parameters, far outside, and at the closed bite."""
    d = np.concatenate([sample_valid(rig, 150, seed=3), [[0, 0, 0], [-9, 4, -6], [70, -20, 15], [1e-9, 0, 0]]])
    poses = np.array([read.pose(*row) for row in d.tolist()])
    points = rig.arrays["landmarks"] @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    expected = rig.pose(d)
    wanted = rig.arrays["landmarks"] @ np.swapaxes(expected[:, :3, :3], 1, 2) + expected[:, None, :3, 3]
    np.testing.assert_allclose(points, wanted, atol=1e-9)
    np.testing.assert_allclose([read.margin(*row) for row in d.tolist()], rig.margin(d), atol=1e-9)


def test_every_kind_of_the_schema_has_a_formula():
    assert tuple(MODELS) == KINDS


def test_model_file_gives_the_evaluators_poses(rig, model_file):
    read = jawusd_reader.load(model_file)
    assert read.kind == rig.meta["kind"]
    assert_same_jaw(read, rig)
    assert_same_jaw(jawusd_reader.from_json(read.to_json()), rig)


def test_usd_gives_the_evaluators_poses(rig, tmp_path):
    frames, d = example_motion()
    bake_rig(tmp_path, rig, example_meshes(), name="x", fps=FPS, frames=frames, d=d)
    for name in ("actor.usda", "anim_capture.usdc", "actor.usdz"):
        assert_same_jaw(jawusd_reader.load(tmp_path / name), rig)
    assert jawusd_reader.load(tmp_path / "actor.usda", "/Actor").d_range[0] == tuple(rig.arrays["d_range"][0])


@pytest.mark.parametrize("d1", [0.0, 10.0, 30.0])
def test_ranges_end_on_the_bound(rig, model_file, d1):
    read = jawusd_reader.load(model_file)
    (low2, high2), (low3, high3) = read.ranges(d1, 0.2, 0.1)
    np.testing.assert_allclose((low2, high2, low3, high3), rig.ranges(d1, 0.2, 0.1), atol=1e-9)
    assert all(np.isnan(x) for pair in read.ranges(90.0) for x in pair)


def test_bare_interpreter_reads_the_model(rig, model_file):
    """Isolated, without site packages: neither numpy nor pxr is there."""
    (model_file.parent / "jawusd_reader.py").write_text(packed_reader())
    code = f"""
import sys; sys.path.insert(0, {str(model_file.parent)!r})
import jawusd_reader, json
assert "numpy" not in sys.modules and "jawusd" not in sys.modules
rig = jawusd_reader.load({str(model_file)!r})
print(json.dumps([rig.pose(20.0, 2.0, 0.5), rig.margin(20.0, 2.0, 0.5)]))
try:
    jawusd_reader.load("actor.usda")
except jawusd_reader.ReaderError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-I", "-S", "-c", code], capture_output=True, text=True, env={**os.environ})
    assert done.returncode == 0, done.stderr
    values, message = done.stdout.splitlines()
    pose, margin = json.loads(values)
    np.testing.assert_allclose(pose, rig.pose([20.0, 2.0, 0.5]), atol=1e-11)
    assert margin == pytest.approx(rig.margin([20.0, 2.0, 0.5]), abs=1e-11)
    assert "pxr" in message


def test_decompose_agrees_with_scipy():
    rng = np.random.default_rng(2)
    for rotation in [*Rotation.random(200, random_state=4), *Rotation.from_euler("xyz", np.pi * np.eye(3))]:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation.as_matrix(), rng.normal(size=3)
        translation, wxyz = jawusd_reader.decompose(T.tolist())
        np.testing.assert_array_equal(translation, T[:3, 3])
        again = Rotation.from_quat(wxyz, scalar_first=True)
        assert wxyz[0] >= 0 and (again.inv() * rotation).magnitude() < 1e-12


def test_other_files_are_refused(rig, model_file, tmp_path):
    arrays = dict(np.load(model_file, allow_pickle=False))
    for change, message in (
        ({"format": "jawusd-model/3"}, "knows up to 2"),
        ({"format": "jawusd-tracks/1"}, "expected jawusd-model"),
        ({"kind": "magic"}, "magic"),
    ):
        meta = {**json.loads(str(arrays["meta"])), **change}
        np.savez(tmp_path / "other.npz", **{**arrays, "meta": np.array(json.dumps(meta))})
        with pytest.raises(jawusd_reader.ReaderError, match=message):
            jawusd_reader.load(tmp_path / "other.npz")
    np.savez(tmp_path / "other.npz", **{name: value for name, value in arrays.items() if name != "incisor"})
    with pytest.raises(jawusd_reader.ReaderError, match="incisor"):
        jawusd_reader.load(tmp_path / "other.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(jawusd_reader.ReaderError, match="no meta"):
        jawusd_reader.load(tmp_path / "other.npz")


def test_newer_and_missing_rigs_in_usd_are_refused(tmp_path):
    bake_rig(tmp_path, example_rig(), example_meshes(), name="x", fps=FPS)
    with pytest.raises(jawusd_reader.ReaderError, match="0 jaw rigs"):
        jawusd_reader.load(tmp_path / "geo.usdc")
    with pytest.raises(jawusd_reader.ReaderError, match="no complete jaw rig"):
        jawusd_reader.load(tmp_path / "actor.usda", "/Actor/geo")
    layer = Sdf.Layer.OpenAsAnonymous(str(tmp_path / "actor.usda"))
    layer.GetAttributeAtPath("/Actor.jaw:formatVersion").default = 3
    layer.Export(str(tmp_path / "actor.usda"))
    with pytest.raises(jawusd_reader.ReaderError, match="knows up to 2"):
        jawusd_reader.load(tmp_path / "actor.usda")


def test_ranges_reach_to_the_ends_of_the_opening():
    """As the evaluator's: where the bound has closed already, the section at the last opening inside."""
    wider = example_arrays() | {"d_range": example_arrays()["d_range"] + [[-0.8, 0.8], [0, 0], [0, 0]]}
    expected = JawRig(wider, example_meta())
    flat = {name: np.ravel(value).tolist() for name, value in wider.items()}
    read = jawusd_reader.Rig("anchored", flat)
    for d1 in (-0.8, -0.3, 0.0, 20.0, 42.0, 42.8):
        np.testing.assert_allclose(np.ravel(read.ranges(d1)), expected.ranges(d1), atol=1e-3)  # flat at the tips
    assert np.isnan(read.ranges(43.0)).all() and np.isnan(expected.ranges(43.0)).all()


def test_packed_reader_imports_nothing_but_the_standard_library():
    tree = ast.parse(packed_reader(), feature_version=(3, 9))
    names = [node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    names += [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    assert {name.split(".")[0] for name in names} - set(sys.stdlib_module_names) == {"pxr"}
    assert "match" not in {type(node).__name__.lower() for node in ast.walk(tree)}
    assert packed_reader().count("from __future__") == 1 and packed_reader().startswith('"""Read and evaluate jaw rigs')


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("import numpy as np", "cannot be packed"),
        ("import numpy", "cannot be packed"),
        ("import jawusd", "cannot be packed"),
        ("from jawusd.evaluator.schema import arrays_of as wanted", "cannot be packed"),
        ("from . import extension", "cannot be packed"),
        ("def f():\n    from jawusd.evaluator.schema import arrays_of", "only imports at the top"),
        ("def polynomial(): ...\nfrom jawusd.evaluator.formula import MODELS", "defined in"),
    ],
)
def test_what_cannot_be_packed_is_refused(tmp_path, monkeypatch, line, message):
    monkeypatch.setattr(extension, "_READER", tmp_path / "jawusd_reader.py")  # an absolute path replaces the folder
    (tmp_path / "jawusd_reader.py").write_text(f'"""Reader."""\n{line}\n')
    with pytest.raises(ValueError, match=message):
        packed_reader()
