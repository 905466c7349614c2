"""Check a capture within seconds before a build: a few images of each file are decoded, and nothing is tracked."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from jawusd.base.errors import CaptureError, JawusdError
from jawusd.formats.capture import Capture, read_capture
from jawusd.formats.finding import Finding, Severity
from jawusd.pipeline.check_files import Parts, boards, bone_findings, calibration, clips, found_error, occlusion, scans
from jawusd.pipeline.check_views import frames, masks, picks, synchronisation, views
from jawusd.pipeline.state import Progress, no_progress

# Packages required by the stages, and packages required only by the report.
_NEEDED = ("av", "cv2", "numba", "scipy", "torch", "onnx", "shapely", "trimesh", "pyfqmr", "PIL")
_FOR_REPORT = ("matplotlib", "jinja2")
# Typical disk space of rig, tracks and report, and minimum free space to start a build [MB].
_RIG_MB, _LEAST_MB = 200.0, 20.0


@dataclass(frozen=True)
class _Check:
    """One check: what it checks, the loaded parts it needs, and its function."""

    what: str
    needs: tuple[str, ...]
    run: Callable[[Parts], Iterator[Finding]]


def _packages(parts: Parts) -> Iterator[Finding]:
    missing = [name for name in _NEEDED if find_spec(name) is None]
    if missing:
        names = ", ".join(missing)
        message = f"the packages {names} are not installed"
        yield Finding("packages_missing", "error", message, hint="Install them with: pip install 'jawusd[build]'")
    if lacking := [name for name in _FOR_REPORT if find_spec(name) is None]:
        message = f"the packages {', '.join(lacking)} are not installed; no report will be written"
        yield Finding("no_report", "warning", message, hint="Install them with: pip install 'jawusd[build]'")


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
    capture: Capture | str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    allow_outside: bool = False,
    progress: Progress | None = None,
) -> list[Finding]:
    """Return all errors and warnings that can be found in a capture within seconds; errors come first.

    Problems with the capture are returned, not raised. A check whose inputs are unreadable is skipped with a note.

    Args:
        capture: the capture, its capture.toml or the folder of that file.
        out: folder in which the rig will be built, for the check of disk space; default: the capture's folder.
        allow_outside: allow paths in the capture that point outside its folder.
        progress: called with (stage, done, total) as work proceeds.
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
    # If the caller passed a loaded capture, its paths have been checked already.
    with Parts(loaded, Path(out or folder).resolve(), allow_outside or isinstance(capture, Capture)) as parts:
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
        found.append(
            Finding("check_failed", "warning", message, hint="Inspect these files, and please report this as a bug.")
        )
    return found


def _without_duplicates(findings: Sequence[Finding]) -> list[Finding]:
    """Return findings without duplicates, i.e. findings with equal message, and equal file or camera."""
    unique: dict[tuple[str, str | None, str | None], Finding] = {}
    for finding in findings:
        key = (finding.message, finding.path, None if finding.path else finding.camera)
        unique.setdefault(key, finding)
    return list(unique.values())


def refuse_errors(findings: Sequence[Finding], capture: Capture) -> None:
    """Raise one exception that lists all findings that are errors.

    Raises:
        CaptureError: at least one finding is an error.
    """
    errors = [finding for finding in findings if finding.severity == "error"]
    if not errors:
        return
    path = capture.folder / "capture.toml"
    if len(errors) == 1:
        only = errors[0]
        raise CaptureError(only.message, path=only.path or path, camera=only.camera, frame=only.frame, hint=only.hint)
    listed = "".join(f"\n  {finding.line()}" for finding in errors)
    raise CaptureError(f"the check found {len(errors)} errors:{listed}", path=path)
