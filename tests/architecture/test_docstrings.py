"""Docstrings of everything public, checked on the source.

Everywhere: an imperative first line that ends with a period; an Args section, where there is one, names every parameter
and nothing else; what is returned is said, by words or by a class of ours, and what the function itself raises. At the
front doors, which people import (what packages export, and all of formats, pipeline and library), every parameter is
explained, in an Args section or by its name in the sentences.
"""

import ast
import re

import pytest
from package_copy import ROOT

PACKAGE = ROOT / "jawusd"
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if "blender" not in path.parts)
OPEN_LAYERS = ("formats", "pipeline", "library")
SECTIONS = ("Args", "Returns", "Raises", "Yields", "Attributes")
# First words that are no imperatives: articles, third persons and nouns that such sentences begin with.
NO_IMPERATIVE = re.compile(r"(The|A|An|This|It|Function|Method|Helper|Utility|Simple|Returns|(?!Bring|String)\w+ing)\b")
PLAIN = re.compile(r"(Array|NDArray|dict|list|tuple|int|float|str|bool|bytes|object|Any|Callable|Iterator|set)\b")


def exported():
    """Return the modules' names that packages export, as (module path from the package, name)."""
    found = set()
    for init in [PACKAGE / "__init__.py", *PACKAGE.glob("*/__init__.py")]:
        for node in ast.walk(ast.parse(init.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("jawusd."):
                path = "/".join(node.module.split(".")[1:]) + ".py"
                found |= {(path, alias.name) for alias in node.names}
    return found | {("__init__.py", "load")}


def public(tree, prefix=""):
    """Yield names and nodes of public classes, functions and methods."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield prefix + node.name, node
            if isinstance(node, ast.ClassDef):
                yield from public(node, f"{prefix}{node.name}.")


def own(node):
    """Yield the nodes of a function without those of functions and classes inside it."""
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda | ast.ClassDef):
            yield child
            yield from own(child)


def sections(text):
    """Return the text of each section of a docstring by its name."""
    parts = re.split(rf"^({'|'.join(SECTIONS)}):[ ]*$", text, flags=re.M)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def documented(section):
    """Return the names an Args section explains: `a:`, `a, b:`, `*args:`."""
    heads = re.findall(r"^    ((?:\*{0,2}`?\w+`?(?:, )?)+):", section, flags=re.M)
    return {name.strip("*` ") for head in heads for name in head.split(",")}


def parameters(node):
    """Return the names of a function's parameters besides self and cls."""
    given = node.args
    every = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
    return {one.arg for one in every if one is not None} - {"self", "cls"}


def raised(node):
    """Return the names of the exceptions a function raises itself."""
    found = set()
    for inner in own(node):
        if isinstance(inner, ast.Raise) and inner.exc is not None:
            name = ast.unparse(inner.exc.func if isinstance(inner.exc, ast.Call) else inner.exc).split(".")[-1]
            found |= {name} if name[0].isupper() else set()
    return found


def faults_of_function(node, front_door):
    """Return what is missing in a function's docstring."""
    text, found = ast.get_docstring(node), []
    parts = sections(text)
    named, explained = parameters(node), documented(parts.get("Args", ""))
    if front_door and named and "Args" not in parts and not explained_inline(named, text):
        found.append(f"no Args: {', '.join(sorted(named))}")
    if "Args" in parts and explained != named:
        found.append(f"Args and parameters differ: {', '.join(sorted(explained ^ named))}")
    is_property = any("property" in ast.unparse(decorator) for decorator in node.decorator_list)
    returns = any(isinstance(n, ast.Return) and n.value and ast.unparse(n.value) != "None" for n in own(node))
    # A function that builds, reads or fits a class of ours says with its annotation what comes back.
    told = "Returns" in parts or re.search(r"\b[Rr]eturn|\b[Tt]ell\b|^Say\b", text) or not PLAIN.match(annotation(node))
    if returns and not is_property and not told:
        found.append("says nothing of what it returns")
    found += [f"raises {name}" for name in sorted(raised(node)) if name not in parts.get("Raises", "")]
    return found


def annotation(node):
    """Return the annotated type of what a function returns, "object" without one."""
    return "object" if node.returns is None else ast.unparse(node.returns).strip("'")


def explained_inline(named, text):
    """Tell whether a short docstring explains all parameters in its sentences: each is named there."""
    sentences = re.split(rf"^(?:{'|'.join(SECTIONS)}):[ ]*$", text, flags=re.M)[0]
    return all(re.search(rf"(?<!\w){re.escape(name)}(?!\w)", sentences) for name in named)


def faults(source, path, exports=frozenset()):
    """Return what is wrong with the docstrings of a module, one line each."""
    found, tree = [], ast.parse(source)
    module = ast.get_docstring(tree)
    if module and module.split("\n\n")[0].rstrip()[-1] not in ".?":
        found.append(f"{path}: the first sentence does not end")
    for name, node in public(tree):
        text = ast.get_docstring(node)
        if not text:
            found.append(f"{path}:{name}: no docstring")
            continue
        first = text.splitlines()[0]
        if not first.endswith("."):
            found.append(f"{path}:{name}: no period: {first}")
        if isinstance(node, ast.ClassDef):
            continue
        is_property = any("property" in ast.unparse(decorator) for decorator in node.decorator_list)
        if NO_IMPERATIVE.match(first) and not is_property:
            found.append(f"{path}:{name}: not imperative: {first}")
        if not path.startswith("cli/"):  # docstrings of commands are their help
            door = path.split("/")[0] in OPEN_LAYERS or (path, name.split(".")[0]) in exports
            found += [f"{path}:{name}: {fault}" for fault in faults_of_function(node, door)]
    return found


def test_the_front_doors_are_found():
    assert {("evaluator/rig.py", "JawRig"), ("rig/animation.py", "write_animation")} <= exported()


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_docstrings_are_complete(path):
    name = path.relative_to(PACKAGE).as_posix()
    assert faults(path.read_text(), name, exported()) == []


GOOD = '''"""Modules say what they hold."""


def scaled(points: Array, factor: float) -> Array:
    """Return points scaled.

    Args:
        points: places [mm], shape (N, 3).
        factor: by which.

    Raises:
        ValueError: a factor of 0.
    """
    if not factor:
        raise ValueError("0")
    return points * factor
'''


def test_a_complete_module_passes():
    assert faults(GOOD, "formats/x.py") == []


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("they hold.", "they hold", "does not end"),
        ('"""Return points scaled.', '"""The points scaled.', "not imperative"),
        ("points scaled.", "points scaled", "no period"),
        ("        factor: by which.\n", "", "differ: factor"),
        ("        factor: by which.\n", "        factor: by which.\n        extra: none.\n", "differ: extra"),
        ("Return points scaled", "Scale points", "says nothing of what it returns"),
        ("        ValueError: a factor of 0.\n", "        TypeError: never.\n", "raises ValueError"),
        (GOOD[GOOD.index("    Args:") : GOOD.index("    Raises")], "", "no Args: factor, points"),
    ],
)
def test_what_is_missing_is_found(old, new, words):
    assert old in GOOD
    assert any(words in fault for fault in faults(GOOD.replace(old, new, 1), "formats/x.py"))
