"""What is installed here, and what works of it."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.util import find_spec
from pathlib import Path
from typing import TypedDict

from jawusd.base.guard import SETTING, machine_memory, memory_limit
from jawusd.base.version import __version__

_NEEDED_TO_BUILD = ("build",)
_NEEDED_CODECS = ("h264", "ffv1", "png")
_LEAST_FREE_GB = 1.0


class Examined(TypedDict):
    """Hold what was found.

    Attributes:
        versions: by package, "" where it is not installed.
        extras: packages that each extra lacks.
        graphics: of OpenGL, or why it is not there.
        codecs: what can be decoded, by name.
        memory_limit_gb: what a command may use of it, 0 for no limit.
        problems: what a build cannot do without.
    """

    jawusd: str
    python: str
    system: str
    cores: int
    memory_gb: float | None
    memory_limit_gb: float
    versions: dict[str, str]
    extras: dict[str, list[str]]
    graphics: str
    codecs: dict[str, bool]
    cache: str
    free_gb: float
    problems: list[str]


def examine() -> Examined:
    """Look at versions, extras, OpenGL, codecs, cores and cache."""
    extras = _extras()
    names = sorted({name for packages in extras.values() for name in packages} | set(_required("")))
    versions = {name: _version(name) for name in names}
    lacking = {extra: [name for name in packages if not versions[name]] for extra, packages in extras.items()}
    problems = [
        f"the extra {extra} lacks {', '.join(lacking[extra])}: pip install 'jawusd[{extra}]'"
        for extra in _NEEDED_TO_BUILD
        if lacking.get(extra)
    ]
    codecs = _codecs()
    lost = [name for name in _NEEDED_CODECS if codecs.get(name) is False]
    problems += [f"pictures in {name} cannot be decoded" for name in lost]
    free_gb = shutil.disk_usage(Path.cwd()).free / 1e9
    if free_gb < _LEAST_FREE_GB:
        problems.append(f"{free_gb:.1f} GB are free here; a build may need {_LEAST_FREE_GB:g}")
    return {
        "jawusd": __version__,
        "python": platform.python_version(),
        "system": platform.platform(),
        "cores": _cores(),
        "memory_gb": round(machine_memory() / 1e9, 1) or None,
        "memory_limit_gb": round(memory_limit() / 1e9, 1),
        "versions": versions,
        "extras": lacking,
        "graphics": _graphics(),
        "codecs": codecs,
        "cache": _cache(),
        "free_gb": round(free_gb, 1),
        "problems": problems,
    }


def _required(extra: str) -> list[str]:
    """Return the packages that jawusd, or one of its extras, asks for by name."""
    out = []
    for line in requires("jawusd") or ():
        name = line.partition(";")[0]
        for sign in "<>=!~[ (":
            name = name.partition(sign)[0]
        marker = line.partition(";")[2]
        wanted = f'extra == "{extra}"' in marker.replace("'", '"') if extra else "extra" not in marker
        if wanted and name.lower() != "jawusd":
            out.append(name)
    return out


def _extras() -> dict[str, list[str]]:
    from importlib.metadata import metadata

    names = metadata("jawusd").get_all("Provides-Extra") or []
    return {name: _required(name) for name in names if name not in ("all", "test")}


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _graphics() -> str:
    if find_spec("moderngl") is None:
        return "not looked for: moderngl is not installed (extra: demo); only `demo` and `--backend gl` need it"
    from jawusd.paper.gl import describe_graphics

    return describe_graphics()


def _codecs() -> dict[str, bool]:
    if find_spec("av") is None:
        return {}
    from jawusd.media.containers import decodable

    return decodable()


def _cache() -> str:
    """Return where numba keeps compiled functions."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    if named:
        return f"{named}{'' if os.access(named, os.W_OK) else ' (cannot be written: every start compiles again)'}"
    package = Path(sys.modules["jawusd"].__file__ or ".").parent
    if os.access(package, os.W_OK):
        return f"{package} (__pycache__)"
    return f"in the home folder, as {package} cannot be written"


def examined_lines(found: Examined) -> list[str]:
    """Return what was found as text."""
    memory = "" if found["memory_gb"] is None else f", {found['memory_gb']:g} GB of memory"
    limit = found["memory_limit_gb"]
    works = [name for name, ok in found["codecs"].items() if ok]
    fails = [name for name, ok in found["codecs"].items() if not ok]
    lines = [
        f"jawusd {found['jawusd']}, Python {found['python']}, {found['system']}",
        f"{found['cores']} cores{memory}, {found['free_gb']:g} GB free here",
        f"a command may use {f'{limit:g} GB of memory' if limit else 'all memory'} (set {SETTING} to change it)",
        "packages: " + ", ".join(f"{name} {number}" for name, number in found["versions"].items() if number),
    ]
    for extra, lacking in found["extras"].items():
        lines.append(f"extra {extra}: {'complete' if not lacking else 'lacks ' + ', '.join(lacking)}")
    lines.append(f"OpenGL: {found['graphics']}")
    lines.append(f"decodes: {', '.join(works) or 'nothing'}{'; not: ' + ', '.join(fails) if fails else ''}")
    lines.append(f"compiled code: {found['cache']}")
    return [*lines, *(f"problem: {line}." for line in found["problems"])]
