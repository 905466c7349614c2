"""Check a capture within seconds before a build, and the installation.

A few images of each file are decoded, and nothing is tracked. The installation: packages, OpenGL, codecs and limits.
"""

from __future__ import annotations

import os
import platform
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from importlib.metadata import metadata, requires
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple, TypedDict

from jawusd.base.errors import AnyPath, CaptureError, JawusdError
from jawusd.base.guard import machine_memory, memory_limit
from jawusd.base.version import __version__
from jawusd.formats.capture import Capture, read_capture
from jawusd.formats.finding import Finding, Severity
from jawusd.pipeline.check_files import Parts, boards, bone_findings, calibration, clips, found_error, occlusion, scans
from jawusd.pipeline.check_views import frames, masks, picks, synchronisation, views
from jawusd.pipeline.state import Progress, installed_version, no_progress

# Packages required by the stages, and packages required only by the report.
_NEEDED = ("av", "cv2", "numba", "scipy", "torch", "onnx", "shapely", "trimesh", "pyfqmr", "PIL")
_FOR_REPORT = ("matplotlib", "jinja2")
# Typical disk space of rig, tracks and report, and minimum free space to start a build [MB].
_RIG_MB, _LEAST_MB = 200.0, 20.0


class _Check(NamedTuple):
    """One check: what it checks, the loaded parts it needs, and its function."""

    what: str
    needs: tuple[str, ...]
    run: Callable[[Parts], Iterator[Finding]]


def _packages(parts: Parts) -> Iterator[Finding]:
    hint = "Install them with: pip install 'jawusd[build]'"
    if missing := [name for name in _NEEDED if find_spec(name) is None]:
        yield Finding("packages_missing", "error", f"the packages {', '.join(missing)} are not installed", hint=hint)
    if lacking := [name for name in _FOR_REPORT if find_spec(name) is None]:
        message = f"the packages {', '.join(lacking)} are not installed; no report will be written"
        yield Finding("no_report", "warning", message, hint=hint)


def _disk(parts: Parts) -> Iterator[Finding]:
    place = next(folder for folder in (parts.out, *parts.out.parents) if folder.exists())
    free_mb = shutil.disk_usage(place).free / 1e6
    if free_mb < _RIG_MB:
        message = f"{free_mb:.0f} MB of disk space are free; a build may need {_RIG_MB:.0f} MB"
        severity: Severity = "error" if free_mb < _LEAST_MB else "warning"
        yield Finding("disk_space", severity, message, free_mb, _RIG_MB, path=str(place), hint="Free some space.")


_CHECKS = (
    _Check("the packages", (), _packages),
    _Check("the scans", ("capture",), scans),
    _Check("the bite", ("scans",), occlusion),
    _Check("bones and landmarks", ("meshes", "scans"), bone_findings),
    _Check("the clips", ("capture",), clips),
    _Check("the disk", (), _disk),
    _Check("the calibration", ("capture",), calibration),
    _Check("the boards", ("capture",), boards),
    _Check("the masks", ("capture",), masks),
    _Check("the time alignment", ("capture",), synchronisation),
    _Check("the frames", ("capture",), frames),
    _Check("the views", ("cameras", "samples"), views),
    _Check("the picks", ("cameras", "scans"), picks),
)


def check_capture(
    capture: Capture | AnyPath,
    out: AnyPath | None = None,
    *,
    allow_outside: bool = False,
    progress: Progress | None = None,
) -> list[Finding]:
    """Return all errors and warnings that can be found in a capture within seconds; errors come first.

    Problems with the capture are returned, not raised. A check whose inputs are unreadable is skipped with a note.

    Args:
        capture: the capture, its capture.toml or the folder of that file.
        out: folder in which the rig will be built, for the check of disk space; default: the capture's folder.
    """
    progress = progress or no_progress
    findings: list[Finding] = []
    loaded: Capture | None
    if isinstance(capture, Capture):
        loaded = capture
    else:
        loaded, problems = read_capture(capture, allow_outside=allow_outside)
        findings += [found_error("capture", problem) for problem in problems]
    folder = loaded.folder if loaded is not None else Path(str(capture))
    with ExitStack() as open_files:
        # If the caller passed a loaded capture, its paths have been checked already.
        allowed = allow_outside or isinstance(capture, Capture)
        parts = Parts(loaded, Path(out or folder).resolve(), allowed, open_files)
        for done, check in enumerate(_CHECKS):
            progress("check", done, len(_CHECKS))
            findings += _run(check, parts)
    progress("check", len(_CHECKS), len(_CHECKS))
    if loaded is None:  # one note instead of one per check
        findings = [finding for finding in findings if finding.kind != "not_checked"]
        findings.append(Finding("not_checked", "note", "nothing else was checked, because the capture cannot be read"))
    order = {"error": 0, "warning": 1, "note": 2}
    return sorted(_without_duplicates(findings), key=lambda finding: order[finding.severity])


def _run(check: _Check, parts: Parts) -> list[Finding]:
    lacking, capture = [name for name in check.needs if not getattr(parts, name)], parts.capture
    if "samples" in lacking and capture is not None and not any(c.masks for c in capture.cameras):
        return []  # this check applies only to captures with masks
    if lacking:
        boards = capture is not None and capture.calibration is None and capture.boards is not None
        later = boards and lacking == ["cameras"]
        why = "the cameras will be calibrated from the boards first" if later else "its inputs cannot be read"
        return [Finding("not_checked", "note", f"{check.what}: not checked, because {why}")]
    found: list[Finding] = []
    try:
        found.extend(check.run(parts))
    except JawusdError as error:
        found.append(found_error("capture", error))
    except Exception as error:  # a failing check must not hide the findings of others
        message = f"{check.what} could not be checked ({type(error).__name__}: {error})"
        hint = "Inspect these files, and please report this as a bug."
        found.append(Finding("check_failed", "warning", message, hint=hint))
    return found


def _without_duplicates(findings: Sequence[Finding]) -> list[Finding]:
    """Return the first of all findings with equal message, and equal file or camera."""
    unique: dict[tuple[str, str | None], Finding] = {}
    for finding in findings:
        unique.setdefault((finding.message, finding.path or finding.camera), finding)
    return list(unique.values())


def refuse_errors(findings: Sequence[Finding], capture: Capture) -> None:
    """Raise a CaptureError that lists all findings that are errors, if there are any."""
    errors = [finding for finding in findings if finding.severity == "error"]
    if not errors:
        return
    path = capture.file
    if len(errors) == 1:
        only = errors[0]
        raise CaptureError(only.message, path=only.path or path, camera=only.camera, frame=only.frame, hint=only.hint)
    listed = "".join(f"\n  {finding.line()}" for finding in errors)
    raise CaptureError(f"the check found {len(errors)} errors:{listed}", path=path)


_NEEDED_CODECS = ("h264", "ffv1", "png")
_LEAST_FREE_GB = 1.0


class Examined(TypedDict):
    """Result of `jawusd doctor`."""

    jawusd: str
    python: str
    system: str
    cores: int
    memory_gb: float | None
    memory_limit_gb: float  # memory limit of a command [GB]; 0: no limit
    versions: dict[str, str]  # version of each package; "" if not installed
    extras: dict[str, list[str]]  # missing packages by pip extra
    graphics: str  # OpenGL version, or the reason why OpenGL is not available
    codecs: dict[str, bool]  # for each codec, whether it can be decoded
    cache: str
    free_gb: float
    problems: list[str]  # reasons why a build would fail


def examine() -> Examined:
    """Check package versions, extras, OpenGL, codecs, CPU cores and the cache of compiled code."""
    given = metadata("jawusd").get_all("Provides-Extra") or []
    extras = {name: _required(name) for name in given if name not in ("all", "test")}
    names = sorted({name for packages in extras.values() for name in packages} | set(_required("")))
    versions = {name: installed_version(name) for name in names}
    lacking = {extra: [name for name in packages if not versions[name]] for extra, packages in extras.items()}
    problems = []
    if lacking.get("build"):
        problems.append(f"the extra build lacks {', '.join(lacking['build'])}: pip install 'jawusd[build]'")
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
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
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
        name, marker = re.split(r"[<>=!~\[ (;]", line, maxsplit=1)[0], line.partition(";")[2]
        wanted = f'extra == "{extra}"' in marker.replace("'", '"') if extra else "extra" not in marker
        if wanted and name.lower() != "jawusd":
            out.append(name)
    return out


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
