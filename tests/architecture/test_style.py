"""House rules a machine can check: ruff's and mypy's, shown to catch what they are for, and sizes of modules."""

import ast
import shutil
import subprocess
import sys

import pytest
from package_copy import ROOT

MODULES = sorted((ROOT / "jawusd").rglob("*.py"))
MAX_MODULE_LINES = 400
MAX_FUNCTION_LINES = 60


def oversized(source, name):
    """Return what is too long in a module: the module, or functions without their docstrings."""
    lines = len(source.splitlines())
    found = [f"{name}: {lines} lines"] if lines > MAX_MODULE_LINES else []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = node.end_lineno - node.lineno + 1 - len((ast.get_docstring(node) or "").splitlines())
            if length > MAX_FUNCTION_LINES:
                found.append(f"{name}:{node.name}: {length} lines")
    return found


def test_modules_and_functions_are_short():
    assert [fault for path in MODULES for fault in oversized(path.read_text(), path.relative_to(ROOT))] == []


@pytest.mark.parametrize("source", ["x = 1\n" * 401, 'def f():\n    """F."""\n' + "    x = 1\n" * 61])
def test_what_is_too_long_is_found(source):
    assert oversized(source, "m.py")


GOOD = '''"""What it owns."""


def scaled(x: float) -> float:
    """Return twice the length x [mm]."""
    return 2 * x
'''


def ruff(source):
    """Return what ruff says of a source as a module of the package."""
    command = [sys.executable, "-m", "ruff", "check", "--no-cache", "--stdin-filename", "jawusd/planted.py", "-"]
    return subprocess.run(command, cwd=ROOT, input=source, capture_output=True, text=True, check=False).stdout


def test_a_good_module_passes():
    assert "All checks passed" in ruff(GOOD)


@pytest.mark.parametrize(
    ("old", "new", "rule"),
    [
        ('"""What it owns."""\n', "", "D100"),
        ('    """Return twice the length x [mm]."""\n', "", "D103"),
        ("Return twice", "Returns twice", "D401"),
        ("[mm].", "[mm]", "D415"),
        ("    return 2", "    assert x > 0\n    return 2", "S101"),
        ("    return 2", "    x += 1\n" * 51 + "    return 2", "PLR0915"),
        ("    return 2", "    # TODO later\n    return 2", "FIX002"),
    ],
)
def test_ruff_catches_what_the_rules_are_for(old, new, rule):
    assert old in GOOD
    assert rule in ruff(GOOD.replace(old, new, 1))


@pytest.mark.parametrize(
    ("source", "code"),
    [
        ("def f(x):\n    return x\n", "no-untyped-def"),
        ("from typing import Any\ndef f(x: Any) -> None: ...\n", "explicit-any"),
        ("def f(x: dict) -> None: ...\n", "type-arg"),
        ("def f() -> int:\n    return ''\n", "return-value"),
    ],
)
def test_mypy_catches_what_the_rules_are_for(tmp_path, source, code):
    (tmp_path / "planted.py").write_text(source)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    command = [sys.executable, "-m", "mypy", "--cache-dir", str(tmp_path / "cache"), "planted.py"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert code in result.stdout
