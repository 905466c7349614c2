"""House rules a machine can check: sizes, docstrings, no validation by assert, no stubs."""

import ast

import pytest
from package_copy import ROOT

PACKAGE = ROOT / "jawusd"
MODULES = sorted(PACKAGE.rglob("*.py"))
MAX_MODULE_LINES = 400
MAX_FUNCTION_LINES = 60
# Longer on purpose; each with its reason.
LONG_FUNCTIONS: dict[str, str] = {}


def faults(source: str, name: str) -> list[str]:
    """Return the rules a module's source breaks."""
    tree = ast.parse(source)
    found = []
    if len(source.splitlines()) > MAX_MODULE_LINES:
        found.append(f"{name}: {len(source.splitlines())} lines")
    if source.strip() and not ast.get_docstring(tree):
        found.append(f"{name}: no module docstring")
    for node in ast.walk(tree):
        if isinstance(node, ast.Assert):
            found.append(f"{name}:{node.lineno}: assert in the package")
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = node.end_lineno - node.lineno + 1 - len((ast.get_docstring(node) or "").splitlines())
            if length > MAX_FUNCTION_LINES and f"{name}:{node.name}" not in LONG_FUNCTIONS:
                found.append(f"{name}:{node.name}: {length} lines of code")
    found += [f"{name}:{path}: no docstring" for path in undocumented(tree)]
    return found


def undocumented(node: ast.AST, prefix: str = "") -> list[str]:
    """Return public classes, functions and methods without a docstring."""
    out = []
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            continue
        if child.name.startswith("_"):
            continue
        if not ast.get_docstring(child):
            out.append(prefix + child.name)
        if isinstance(child, ast.ClassDef):
            out += undocumented(child, f"{prefix}{child.name}.")
    return out


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_module_keeps_the_house_rules(path):
    assert faults(path.read_text(), str(path.relative_to(PACKAGE))) == []


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ('"""m"""\ndef f():\n    x = 1\n', "no docstring"),
        ('"""m"""\nclass A:\n    """A."""\n    def f(self):\n        pass\n', "A.f: no docstring"),
        ('"""m"""\nassert True\n', "assert"),
        ("x = 1\n", "no module docstring"),
        ('"""m"""\n' + "x = 1\n" * 400, "lines"),
        ('"""m"""\ndef f():\n    """F."""\n' + "    x = 1\n" * 61, "lines of code"),
    ],
)
def test_the_rules_catch_what_they_are_for(source, words):
    assert any(words in fault for fault in faults(source, "m.py"))
