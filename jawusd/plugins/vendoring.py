"""Copy modules of jawusd, with all jawusd modules that they import, into a package that must work without jawusd."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

_ROOT = Path(__file__).parents[1]
_OURS = re.compile(r"^(\s*)from jawusd((?:\.\w+)*) import", re.MULTILINE)
_VERSION = re.compile(r"^__version__ = .*$", re.MULTILINE)


def vendored_files(stubs: Iterable[Path]) -> dict[str, str]:
    """Return the contents of the files to be added to a package, by path in the package.

    Args:
        stubs: `.pyi` files that import the required names, each in the form `from jawusd.x import y as y`.

    Returns:
        A module for each stub and, below `jawusd/`, the modules that these modules import.

    Raises:
        ValueError: A module imports jawusd in a form other than `from jawusd.x import y`.
    """
    sources: dict[str, str] = {}
    version = _VERSION.search((_ROOT / "base" / "version.py").read_text(encoding="utf-8"))
    files = {"jawusd/__init__.py": version[0] + "\n" if version else ""}
    for stub in stubs:
        text = stub.read_text(encoding="utf-8")
        _collect(ast.parse(text), sources)
        files[stub.with_suffix(".py").name] = _OURS.sub(r"\1from .jawusd\2 import", text)
    for module, source in sources.items():
        files[_name(module)] = _relative(module, source)
        for parent in _parents(module):
            files.setdefault(_name(parent), "")
    return files


def _collect(tree: ast.Module, sources: dict[str, str]) -> None:
    """Add the modules of jawusd that a module imports, recursively."""
    for module in _imported(tree):
        if module == "jawusd" or module in sources:
            continue
        sources[module] = _file(module).read_text(encoding="utf-8")
        _collect(ast.parse(sources[module]), sources)


def _imported(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            if any(alias.name.split(".")[0] == "jawusd" for alias in node.names):
                raise ValueError(f"line {node.lineno}: {ast.unparse(node)!r} cannot be vendored")
        elif isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] == "jawusd":
            for alias in node.names:
                submodule = f"{node.module}.{alias.name}"
                is_module = _file(submodule).is_file() and _file(submodule).stem != "__init__"
                yield submodule if is_module else str(node.module)


def _relative(module: str, source: str) -> str:
    """Return the source of a module with its imports from jawusd made relative."""
    parts = module.split(".")[1:]
    dots = "." * (len(parts) + (_file(module).name == "__init__.py"))
    return _OURS.sub(lambda found: f"{found[1]}from {dots}{found[2][1:]} import", source)


def _file(module: str) -> Path:
    path = _ROOT.joinpath(*module.split(".")[1:])
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _name(module: str) -> str:
    return f"jawusd/{_file(module).relative_to(_ROOT).as_posix()}"


def _parents(module: str) -> list[str]:
    parts = module.split(".")
    return [".".join(parts[:end]) for end in range(2, len(parts))]
