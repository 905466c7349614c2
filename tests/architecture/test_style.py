"""House rules a machine can check: ruff's and mypy's, shown to catch what they are for, and sizes of modules."""

import ast
import shutil
import subprocess
import sys

import pytest
from package_copy import ROOT

MODULES = sorted((ROOT / "jawusd").rglob("*.py"))
MAX_MODULE_LINES = 385
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


@pytest.mark.parametrize("source", ["x = 1\n" * 386, 'def f():\n    """F."""\n' + "    x = 1\n" * 61])
def test_what_is_too_long_is_found(source):
    assert oversized(source, "m.py")


def unnamed_exceptions(source, name):
    """Return the exceptions that public functions raise themselves and do not name in their docstrings."""
    found = []
    for node in public_functions(ast.parse(source)):
        for raised in own_raises(node):
            kind = ast.unparse(raised.func if isinstance(raised, ast.Call) else raised).split(".")[-1]
            if kind[0].isupper() and kind not in (ast.get_docstring(node) or ""):
                found.append(f"{name}:{node.name}: {kind}")
    return found


def public_functions(node):
    """Yield the public functions of a module and of its public classes."""
    for child in ast.iter_child_nodes(node):
        public = not getattr(child, "name", "_").startswith("_")
        if public and isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            yield child
        elif public and isinstance(child, ast.ClassDef):
            yield from public_functions(child)


def own_raises(node):
    """Yield what a function raises itself, without the functions and classes inside it."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Raise) and child.exc is not None:
            yield child.exc
        if not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda | ast.ClassDef):
            yield from own_raises(child)


def test_public_functions_name_the_exceptions_they_raise():
    commands = ROOT / "jawusd" / "cli"  # docstrings of commands are their help
    found = [unnamed_exceptions(p.read_text(), p.relative_to(ROOT)) for p in MODULES if commands not in p.parents]
    assert [fault for faults in found for fault in faults] == []


def test_an_exception_that_is_not_named_is_found():
    assert unnamed_exceptions('def f(x):\n    """Return x."""\n    if x:\n        raise ValueError("x")\n', "m.py")


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
