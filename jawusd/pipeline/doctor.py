"""Check the installation: packages, OpenGL, codecs and limits."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.util import find_spec
from pathlib import Path
from typing import TypedDict

from jawusd.base.guard import machine_memory, memory_limit
from jawusd.base.version import __version__

_NEEDED_TO_BUILD = ("build",)
_NEEDED_CODECS = ("h264", "ffv1", "png")
_LEAST_FREE_GB = 1.0


class Examined(TypedDict):
    """Result of `jawusd doctor`.

    Attributes:
        versions: version of each package; "" if not installed.
        extras: missing packages by pip extra.
        graphics: OpenGL version, or the reason why OpenGL is not available.
        codecs: for each codec, whether it can be decoded.
        memory_limit_gb: memory limit of a command [GB]; 0: no limit.
        problems: reasons why a build would fail.
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
    """Check package versions, extras, OpenGL, codecs, CPU cores and the cache of compiled code."""
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
    problems += [f"images in {name} cannot be decoded" for name in lost]
    free_gb = shutil.disk_usage(Path.cwd()).free / 1e9
    if free_gb < _LEAST_FREE_GB:
        problems.append(f"{free_gb:.1f} GB of disk space are free; a build may need {_LEAST_FREE_GB:g} GB")
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
    """Return the names of the packages required by jawusd, or by one of its extras."""
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
        return "not checked: moderngl is not installed (extra: demo); only `demo` and `--backend gl` need it"
    from jawusd.paper.gl import describe_graphics

    return describe_graphics()


def _codecs() -> dict[str, bool]:
    if find_spec("av") is None:
        return {}
    from jawusd.media.containers import decodable

    return decodable()


def _cache() -> str:
    """Return a description of the folder in which numba caches compiled functions."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    if named:
        return f"{named}{'' if os.access(named, os.W_OK) else ' (not writable: every start compiles again)'}"
    package = Path(sys.modules["jawusd"].__file__ or ".").parent
    if os.access(package, os.W_OK):
        return f"{package} (__pycache__)"
    return f"in the home folder, because {package} is not writable"
