"""Write the files that run inside other programs: the Blender extension (zip), the reader and the recipes (scripts).

The extension includes copies of the modules of jawusd that it needs, with all jawusd modules that these import, in a
package that must work without jawusd. The reader is packed into one file.
"""

from __future__ import annotations

import ast
import re
import shutil
import sys
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path

_ROOT = Path(__file__).parents[1]
_OURS = re.compile(r"^(\s*)from jawusd((?:\.\w+)+) import", re.MULTILINE)
_WHOLE = re.compile(r"^\s*import .*\bjawusd\b.*$", re.MULTILINE)
_VERSION = re.compile(r"^__version__ = .*$", re.MULTILINE)


def vendored_files(stubs: Iterable[Path]) -> dict[str, str]:
    """Return the modules of a package by path: one for each stub and, below `jawusd/`, those that these modules import.

    The stubs import the required names, each in the form `from jawusd.x import y as y`.

    Raises:
        ValueError: A module imports jawusd in a form other than `from jawusd.x import y`.
    """
    sources: dict[str, str] = {}
    version = _VERSION.search((_ROOT / "base" / "version.py").read_text(encoding="utf-8"))
    files = {"jawusd/__init__.py": version[0] + "\n" if version else ""}
    for stub in stubs:
        text = stub.read_text(encoding="utf-8")
        _collect_imported(ast.parse(text), sources)
        files[stub.with_suffix(".py").name] = _with_imports_from(".jawusd", text)
    for module, source in sources.items():
        files[_name(module)] = _with_imports_from("." * (_name(module).count("/") - 1), source)
        for parent in _parents(module):
            files.setdefault(_name(parent), "")
    return files


def _collect_imported(tree: ast.Module, sources: dict[str, str]) -> None:
    """Add the modules of jawusd that a module imports, recursively, each after those that it imports."""
    for module in _imported(tree):
        if module != "jawusd" and module not in sources:
            sources[module] = _file(module).read_text(encoding="utf-8")
            _collect_imported(ast.parse(sources[module]), sources)
            sources[module] = sources.pop(module)


def _imported(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] == "jawusd":
            for alias in node.names:
                submodule = f"{node.module}.{alias.name}"
                is_module = _file(submodule).is_file() and _file(submodule).stem != "__init__"
                yield submodule if is_module else str(node.module)


def _with_imports_from(package: str, source: str) -> str:
    """Return the source of a module with its imports from jawusd replaced by those from a relative package."""
    if found := _WHOLE.search(source):
        raise ValueError(f"{found[0].strip()!r} cannot be vendored")
    return _OURS.sub(lambda found: f"{found[1]}from {package}{found[2]} import", source)


def _file(module: str) -> Path:
    path = _ROOT.joinpath(*module.split(".")[1:])
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _name(module: str) -> str:
    return f"jawusd/{_file(module).relative_to(_ROOT).as_posix()}"


def _parents(module: str) -> list[str]:
    parts = module.split(".")
    return [".".join(parts[:end]) for end in range(2, len(parts))]


_HERE = Path(__file__).parent
_READER = "jawusd_reader.py"
_SCRIPTS = ("jawusd_recipes.py",)
# time stamp of the files in the zip; constant, so that the zip is reproducible
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)


def build_extension(out: Path) -> Path:
    """Write the zip for Blender's "Install from Disk" (4.2 and later) and return its path.

    Raises:
        OSError: The zip cannot be written.
    """
    sources = [*sorted((_HERE / "blender").glob("*.py")), _HERE / "blender" / "blender_manifest.toml"]
    contents = {source.name: source.read_bytes() for source in sources}
    vendored = vendored_files(sorted((_HERE / "blender").glob("*.pyi")))
    contents |= {name: source.encode() for name, source in sorted(vendored.items())}
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            archive.writestr(zipfile.ZipInfo(name, _ZIP_TIME), content, zipfile.ZIP_DEFLATED)
    return out


def copy_scripts(folder: Path) -> list[Path]:
    """Write the reader and the scripts that use it to a folder, created if missing; return the paths of the files.

    Raises:
        OSError: A file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    reader = folder / _READER
    reader.write_text(packed_reader(), encoding="utf-8")
    return [reader, *(Path(shutil.copyfile(_HERE / name, folder / name)) for name in _SCRIPTS)]


def packed_reader() -> str:
    """Return the source of the reader as one file that needs only the standard library.

    Imports from jawusd are replaced by the contents of the imported modules.

    Raises:
        ValueError: A module has an unsupported import, or two modules define the same name.
    """
    sources: dict[str, str] = {}
    reader = (_HERE / _READER).read_text(encoding="utf-8")
    _collect_imported(ast.parse(reader), sources)
    imported: dict[str, set[str]] = {}
    defined: dict[str, str] = {}
    bodies = []
    for module, source in {**sources, "the reader": reader}.items():
        tree = ast.parse(source)
        for name in _defined_names(tree):
            if defined.setdefault(name, module) != module:
                raise ValueError(f"{name} is defined in {defined[name]} and in {module}")
        bodies.append(_body(module, source, tree, imported))
    header = [f"import {name}" for name, names in imported.items() if not names]
    header += [f"from {name} import {', '.join(sorted(names))}" for name, names in imported.items() if names]
    docstring = ast.get_docstring(tree, clean=False)
    start = f'"""{docstring}"""\n\nfrom __future__ import annotations\n\n' + "\n".join(sorted(header))
    return "\n\n\n".join([start, *bodies]) + "\n"


def _body(module: str, source: str, tree: ast.Module, imported: dict[str, set[str]]) -> str:
    """Return a module without docstring and imports; add imports from the standard library to `imported`."""
    lines: list[str | None] = [*source.splitlines()]
    for node in ast.walk(tree):
        if isinstance(node, (ast.Import, ast.ImportFrom)) and node not in tree.body and "jawusd" in ast.unparse(node):
            raise ValueError(f"{module}, line {node.lineno}: only imports at the top of a module can be packed")
    dropped = [node for node in tree.body if isinstance(node, (ast.Import, ast.ImportFrom))]
    for node in dropped:
        _add_import(module, node, imported)
    docstring = tree.body[0] if ast.get_docstring(tree) else None
    for node in (*dropped, *([docstring] if docstring else [])):
        lines[node.lineno - 1 : node.end_lineno] = [None] * (int(node.end_lineno or node.lineno) - node.lineno + 1)
    return "\n".join(line for line in lines if line is not None).strip()


def _add_import(source: str, node: ast.Import | ast.ImportFrom, imported: dict[str, set[str]]) -> None:
    """Add an import from the standard library to the header of the packed file."""
    names = {alias.name for alias in node.names}
    modules = [str(node.module)] if isinstance(node, ast.ImportFrom) else sorted(names)
    renamed = any(alias.asname or alias.name == "*" for alias in node.names)
    relative = isinstance(node, ast.ImportFrom) and node.level
    for module in modules:
        top = module.split(".")[0]
        if renamed or relative or top not in {*sys.stdlib_module_names, "jawusd"} or module == "jawusd":
            raise ValueError(f"{source}, line {node.lineno}: {ast.unparse(node)!r} cannot be packed")
        if top != "jawusd" and module != "__future__":
            imported.setdefault(module, set()).update(names if isinstance(node, ast.ImportFrom) else ())


def _defined_names(tree: ast.Module) -> Iterator[str]:
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            yield node.name
        for target in getattr(node, "targets", []) or [getattr(node, "target", None)]:
            yield from (name.id for name in ast.walk(target) if isinstance(name, ast.Name)) if target else ()
