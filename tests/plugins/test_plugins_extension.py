"""The Blender extension is one zip with everything in it."""

import ast
import subprocess
import sys
import tomllib
import zipfile

from jawusd.plugins.extension import build_extension


def test_zip_holds_manifest_modules_and_reader(tmp_path):
    first, second = (build_extension(tmp_path / f"{name}.zip") for name in ("a", "b"))
    assert first.read_bytes() == second.read_bytes()
    with zipfile.ZipFile(first) as archive:
        names = set(archive.namelist())
        assert names == {"__init__.py", "jaw.py", "panel.py", "jawusd_reader.py", "blender_manifest.toml"}
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
        assert manifest["type"] == "add-on" and manifest["schema_version"] == "1.0.0"
        for name in names - {"blender_manifest.toml"}:
            for node in ast.walk(ast.parse(archive.read(name))):
                if isinstance(node, ast.ImportFrom) and node.level == 1:
                    modules = [node.module] if node.module else [alias.name for alias in node.names]
                    assert {f"{module}.py" for module in modules} <= names
                elif isinstance(node, ast.Import | ast.ImportFrom):
                    assert not (getattr(node, "module", None) or "").startswith("jawusd"), name


def test_one_command_writes_it(tmp_path):
    out = tmp_path / "jawusd_blender.zip"
    subprocess.run([sys.executable, "-m", "jawusd.plugins", str(out)], check=True, capture_output=True)
    assert zipfile.is_zipfile(out)
    refused = subprocess.run([sys.executable, "-m", "jawusd.plugins"], capture_output=True, text=True)
    assert refused.returncode != 0 and "usage" in refused.stderr
