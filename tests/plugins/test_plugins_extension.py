"""The Blender extension is one self-contained zip."""

import ast
import subprocess
import sys
import tomllib
import zipfile
from pathlib import PurePosixPath

import pytest

from jawusd.plugins.extension import build_extension, vendored_files


def test_zip_holds_manifest_modules_and_reader(tmp_path):
    first, second = (build_extension(tmp_path / f"{name}.zip") for name in ("a", "b"))
    assert first.read_bytes() == second.read_bytes()
    with zipfile.ZipFile(first) as archive:
        names = set(archive.namelist())
        own = {f"{name}.py" for name in ("__init__", "bake", "handle", "jaw", "panel")}
        own |= {"blender_manifest.toml", "vendored.py", "vendored_usd.py"}
        assert {name for name in names if "/" not in name} == own
        assert {"jawusd/evaluator/rig.py", "jawusd/rig/animation.py", "jawusd/plugins/jawusd_reader.py"} <= names
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
        assert manifest["type"] == "add-on" and manifest["schema_version"] == "1.0.0"
        for name in names - {"blender_manifest.toml"}:
            tree = ast.parse(archive.read(name))
            for node in ast.walk(tree):
                if isinstance(node, ast.ImportFrom) and node.level:
                    folder = PurePosixPath(name).parents[node.level - 1].joinpath(*(node.module or "").split("."))
                    modules = [folder] if node.module else []
                    below = [folder / alias.name for alias in node.names]
                    held = [m for m in modules if {f"{m}.py", f"{m}/__init__.py"} & names]
                    held += [m for m in below if node.names[0].name == "__version__"]
                    assert held or all({f"{m}.py", f"{m}/__init__.py"} & names for m in below), (name, ast.dump(node))
                elif isinstance(node, ast.ImportFrom | ast.Import):
                    modules = [node.module] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
                    found = {module.split(".")[0] for module in modules}
                    assert found <= {*sys.stdlib_module_names, "numpy", "pxr", "bpy", "bpy_extras"}, name


def test_vendored_modules_work_where_no_jawusd_is(tmp_path):
    """Inside another package, in an interpreter that cannot import jawusd."""
    build_extension(tmp_path / "a.zip")
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        archive.extractall(tmp_path / "inside")
    (tmp_path / "inside" / "__init__.py").write_text("")
    code = """
import sys
sys.modules["jawusd"] = None
from inside.jawusd.evaluator import JawRig
from inside.vendored_usd import rig_of, write_animation
assert not [name for name in sys.modules if name.startswith("jawusd.")]
print(JawRig.__module__, write_animation.__module__)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == "inside.jawusd.evaluator.rig inside.jawusd.rig.animation\n", done.stderr


def test_modules_that_cannot_be_vendored_are_rejected(tmp_path):
    (tmp_path / "stub.pyi").write_text("import jawusd.evaluator\n")
    with pytest.raises(ValueError, match="cannot be vendored"):
        vendored_files([tmp_path / "stub.pyi"])


def test_one_command_writes_it(tmp_path):
    out = tmp_path / "jawusd_blender.zip"
    subprocess.run([sys.executable, "-m", "jawusd.plugins", str(out)], check=True, capture_output=True)
    assert zipfile.is_zipfile(out)
    refused = subprocess.run([sys.executable, "-m", "jawusd.plugins"], capture_output=True, text=True)
    assert refused.returncode != 0 and "usage" in refused.stderr
