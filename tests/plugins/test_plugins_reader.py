"""The single-file reader against the evaluator, in this Python and, packed, in one without packages."""

import ast
import io
import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from example_model import example_arrays, example_meta
from example_people import person, save
from example_rig import FPS, example_meshes, example_motion, example_rig
from key_sets import hollow_rig
from pxr import Sdf
from scipy.spatial.transform import Rotation

import jawusd
from jawusd.evaluator import JawRig, load
from jawusd.evaluator.arrays import flat_arrays
from jawusd.formats.model import JawModel, save_model
from jawusd.plugins import extension, jawusd_reader
from jawusd.plugins.extension import packed_reader
from jawusd.rig.bake import bake_rig
from jawusd.rig.table import sample_valid

PYTHONS = ("3.9", "3.10", "3.11", "3.12", "3.13", "3.14")


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


def test_model_file_gives_the_evaluators_poses(rig, model_file):
    read = jawusd_reader.load(model_file)
    assert read.kind == rig.meta["kind"]
    assert_same_jaw(read, rig)


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


BARE = """
import sys; sys.path.insert(0, {folder!r})
import json, jawusd_reader
assert "numpy" not in sys.modules and "jawusd" not in sys.modules
told = {{}}
for path, rows in json.load(open({asked!r})).items():
    rig = jawusd_reader.load(path)
    told[path] = [[rig.pose(*d), rig.margin(*d), rig.project(*d)] for d in rows]
try:
    jawusd_reader.load("actor.usda")
except jawusd_reader.ReaderError as error:
    told["usd"] = str(error)
print(json.dumps(told))
"""


def bare_python(version):
    """Return an interpreter of a version, from the system or pyenv; skip if there is none."""
    kept = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    places = [shutil.which(f"python{version}"), *sorted(kept.glob(f"{version}.*/bin/python"))]
    for place in filter(None, places):
        found = subprocess.run([place, "-I", "-S", "-c", "import sys; print(*sys.version_info[:2], sep='.')"],
                               capture_output=True, text=True)  # fmt: skip
        if found.stdout.strip() == version:
            return place
    pytest.skip(f"there is no Python {version}")


def assert_read_bare(python, files, folder):
    """Compare the reader in an interpreter without packages with the evaluator, everywhere and far outside."""
    (folder / "jawusd_reader.py").write_text(packed_reader())
    rigs = {str(path): load(path) for path in files}
    asked = {}
    for path, rig in rigs.items():
        low, high = rig.d_range.T
        wide = np.random.default_rng(4).uniform(low - 5.0, high + 5.0, (40, 3))
        asked[path] = [*sample_valid(rig, 20, seed=3).tolist(), *wide.tolist(), [0.0, 0.0, 0.0]]
    (folder / "asked.json").write_text(json.dumps(asked))
    code = BARE.format(folder=str(folder), asked=str(folder / "asked.json"))
    done = subprocess.run(
        [python, "-I", "-S", "-c", code], capture_output=True, text=True
    )  # isolated, no site packages
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert "pxr" in told["usd"]
    for path, rig in rigs.items():
        d = np.array(asked[path])
        poses, margins, inside = (list(column) for column in zip(*told[path]))
        vertices = rig.arrays["landmarks"]
        found, wanted = (T[:, :3, :3] @ vertices.T + T[:, :3, 3:] for T in (np.array(poses), rig.pose(d)))
        assert np.abs(found - wanted).max() < 1e-6  # mm
        np.testing.assert_allclose(margins, rig.margin(d), atol=1e-6)
        assert_projected(rig, d, np.array(inside))


def assert_projected(rig, d, found):
    """Valid parameters stay; others move to the bound, no farther than by the evaluator."""
    out = rig.margin(d) < 0
    assert out.any() and not out.all()
    np.testing.assert_array_equal(found[~out], d[~out])
    assert rig.is_inside(found).all()
    away, allowed = (np.linalg.norm(x - d, axis=1) for x in (found, rig.project(d)))
    assert (away - allowed).max() < 1e-6  # mm


@pytest.mark.slow
@pytest.mark.parametrize("version", PYTHONS)
def test_every_bare_python_reads_the_model_of_a_build_and_those_of_five_persons(version, example_build, tmp_path):
    people = [("a", 1.0, 1.0, 0.0), ("b", 0.7, 0.8, 3.0), ("c", 1.3, 1.2, -4.0), ("d", 1.1, 0.6, 8.0)]
    files = [example_build[0] / "model.npz", *(save(person(*who), tmp_path / f"{who[0]}.npz") for who in people)]
    files.append(save(person("e", kind="additive"), tmp_path / "e.npz"))
    assert_read_bare(bare_python(version), files, tmp_path)


@pytest.mark.slow
def test_usd_of_a_build_gives_the_evaluators_poses(example_build):
    rig = jawusd.load(example_build[0] / "actor.usda")
    for name in ("model.npz", "actor.usda", "anim_capture.usdc", "actor.usdz"):
        assert_same_jaw(jawusd_reader.load(example_build[0] / name), rig)


def test_this_python_reads_a_model_bare(model_file, tmp_path):
    assert_read_bare(sys.executable, [model_file], tmp_path)


@pytest.mark.parametrize("hollow", [False, True])
def test_the_nearest_valid_parameters_are_those_of_the_evaluator(rig, hollow):
    rig = hollow_rig() if hollow else rig  # a narrow waist: two valleys
    read = jawusd_reader.Rig(rig.kind, flat_arrays(rig.arrays))
    low, high = rig.d_range.T
    d = np.random.default_rng(7).uniform(low - 6.0, high + 6.0, (80, 3))
    d[:2] = [20.0, 7.6, 9.2], [20.0, 1.0, 0.5]
    assert_projected(rig, d, np.array([read.project(*row) for row in d.tolist()]))
    assert np.isnan(read.project(np.nan, 0.0, 0.0)).all() and np.isnan(read.project(np.inf, 0.0, 0.0)).all()


def test_a_bound_that_leaves_nothing_is_refused(rig):
    arrays = flat_arrays(rig.arrays) | {"slice_margin_mm": [-50.0]}
    with pytest.raises(jawusd_reader.ReaderError, match="allows no jaw parameters"):
        jawusd_reader.Rig(rig.kind, arrays).project(20.0, 0.0, 0.0)


@pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
@pytest.mark.parametrize("dtype", ["<f8", ">f8", ">f4", "<f4", "<f2"])
@pytest.mark.parametrize("packed", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_whatever_order_numpy_writes_is_read(model_file, tmp_path, version, dtype, packed):
    kept = dict(np.load(model_file, allow_pickle=False))
    with zipfile.ZipFile(tmp_path / "other.npz", "w", packed) as archive:
        for name, value in kept.items():
            number = value.dtype.kind == "f"
            written = np.asfortranarray(
                value.astype(dtype) if number else value.astype(value.dtype.newbyteorder(dtype[0]))
            )
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, written, version, allow_pickle=False)
    read = jawusd_reader.load(tmp_path / "other.npz")
    for name, values in read.arrays.items():
        np.testing.assert_array_equal(values, kept[name].astype(dtype).ravel())


def test_every_type_and_shape_of_numbers_is_read():
    for dtype in ("?", "i1", ">i2", "i4", ">i8", "u1", "u2", ">u4", "u8", "f2", "f4", ">f8"):
        for shape in ((), (0,), (3,), (2, 3), (2, 3, 4), (1, 4), (4, 1)):
            whole = (np.arange(np.prod(shape, dtype=int)) % 2).reshape(shape).astype(dtype)
            for values in (whole, np.asfortranarray(whole), whole.T):
                written = io.BytesIO()
                np.lib.format.write_array(written, values)
                assert list(jawusd_reader._npy("a", written.getvalue())) == values.ravel().tolist()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: data[:-3], "array incisor cannot be read"),
        (lambda data: b"nothing" + data, "has no .npy header"),
        (lambda data: data.replace(b"<f8", b"<c8"), "type <c8"),
        (lambda data: data.replace(b"'descr'", b"'other'"), "array incisor cannot be read"),
        (lambda data: data.replace(b"{", b"[", 1), "array incisor cannot be read"),
        (lambda data: data[:12], "array incisor cannot be read"),
    ],
)
def test_a_damaged_array_is_named(model_file, tmp_path, damage, message):
    with zipfile.ZipFile(model_file) as archive, zipfile.ZipFile(tmp_path / "other.npz", "w") as other:
        for name in archive.namelist():
            data = archive.read(name)
            other.writestr(name, damage(data) if name == "incisor.npy" else data)
    with pytest.raises(jawusd_reader.ReaderError, match=message):
        jawusd_reader.load(tmp_path / "other.npz")


def test_what_is_no_archive_is_refused(model_file, tmp_path):
    whole = model_file.read_bytes()
    for data in (b"", b"words", whole[:300], whole.replace(b"PK\1\2", b"PK\1\3")):
        (tmp_path / "other.npz").write_bytes(data)
        with pytest.raises(jawusd_reader.ReaderError, match="damaged or is not a jaw model"):
            jawusd_reader.load(tmp_path / "other.npz")
    (tmp_path / "other.usda").write_text("#usda 1.0\n(\n")
    with pytest.raises(jawusd_reader.ReaderError, match="cannot be opened"):
        jawusd_reader.load(tmp_path / "other.usda")


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
        ({"format": "jawusd-model/3"}, "supports versions up to 2"),
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
    with pytest.raises(jawusd_reader.ReaderError, match="the jaw rig is incomplete"):
        jawusd_reader.load(tmp_path / "actor.usda", "/Actor/geo")
    layer = Sdf.Layer.OpenAsAnonymous(str(tmp_path / "actor.usda"))
    layer.GetAttributeAtPath("/Actor.jaw:formatVersion").default = 3
    layer.Export(str(tmp_path / "actor.usda"))
    with pytest.raises(jawusd_reader.ReaderError, match="supports versions up to 2"):
        jawusd_reader.load(tmp_path / "actor.usda")


def test_ranges_reach_to_the_ends_of_the_opening():
    """As in the evaluator: where the bound is closed, the section at the last valid opening."""
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
        ("from jawusd.evaluator.kinds import arrays_of as wanted", "cannot be packed"),
        ("from . import extension", "cannot be packed"),
        ("def f():\n    from jawusd.evaluator.kinds import arrays_of", "only imports at the top"),
        ("def polynomial(): ...\nfrom jawusd.evaluator.kinds import MODELS", "defined in"),
    ],
)
def test_what_cannot_be_packed_is_refused(tmp_path, monkeypatch, line, message):
    monkeypatch.setattr(extension, "_READER", tmp_path / "jawusd_reader.py")  # an absolute path replaces the folder
    (tmp_path / "jawusd_reader.py").write_text(f'"""Reader."""\n{line}\n')
    with pytest.raises(ValueError, match=message):
        packed_reader()
