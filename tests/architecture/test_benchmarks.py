"""No test runs the benchmarks: what they import from the package must still be there."""

import ast
import importlib

import pytest
from package_copy import ROOT

SCRIPTS = sorted((ROOT / "tests" / "benchmarks").rglob("*.py"))


def names_of(module):
    """Return the names at the top of a module of the package, and its submodules; None if there is no such module."""
    path = ROOT.joinpath(*module.split("."))
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    if not file.exists():
        return None
    names = {child.stem for child in path.glob("*")} if path.is_dir() else set()
    statements = ast.parse(file.read_text()).body
    for node in statements:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.If):
            statements.extend(node.body + node.orelse)
        else:
            stored = (name for name in ast.walk(node) if isinstance(name, ast.Name))
            names |= {name.id for name in stored if isinstance(name.ctx, ast.Store)}
    return names


def unknown_imports(source):
    """Return the imports of a script, from the package, of what is not there."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            wanted = [(alias.name, None) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            wanted = [(node.module, alias.name) for alias in node.names]
        else:
            continue
        for module, name in wanted:
            if module.split(".")[0] == "jawusd":
                names = names_of(module)
                if names is None or (name is not None and name not in names):
                    found.append(module if name is None else f"{module}.{name}")
    return found


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_benchmarks_import_what_there_is(path):
    assert unknown_imports(path.read_text()) == []


@pytest.mark.parametrize(
    "source",
    [
        "import jawusd.pipeline.tracks",
        "from jawusd.pipeline.none import track",
        "from jawusd.pipeline.track import tracks",
        "def f():\n    from jawusd.geometry import no_such_thing",
    ],
)
def test_imports_of_what_is_not_there_are_found(source):
    assert unknown_imports(source) != []


def test_names_are_those_that_python_finds():
    module = importlib.import_module("jawusd.geometry")
    assert {name for name in vars(module) if name[0] != "_"} <= names_of("jawusd.geometry")
