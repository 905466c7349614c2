"""State of a build: finished stages in `build.json`, content hashes, and the lock of the output folder."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import logging
import math
import os
import platform
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import Generic, NotRequired, TypeVar

from typing_extensions import TypedDict

from jawusd.base.errors import FormatError, OutputError
from jawusd.base.inputs import check_input, check_path
from jawusd.base.npz import check_format
from jawusd.base.version import __version__
from jawusd.formats.atomic import ELSEWHERE, clear_unfinished, destination, write_text_atomic
from jawusd.formats.finding import Finding
from jawusd.formats.report import BuildVerdict, Origin, verdict_sentence
from jawusd.formats.text import of_kind, read_json

FAMILY, VERSION = "jawusd-build", 1
BUILD_FILE = "build.json"
LOCK_FILE = ".jawusd-lock"
CALIBRATION = "calibration.toml"  # calibration that the build writes if the capture names none
LABELS = "labels"  # folder to which the build writes labels of scans that have neither paint nor labels
FIRST_PASS = "first_pass.npz"  # tracks without the model as a prior, to which the model is fitted
_ENDING_S = 2.0  # time to wait for a lock [s]; a killed build holds its lock until the system has freed its memory
_MOST_BYTES = 64 << 20  # maximum size of build.json [bytes]; it lists every mask file of a take
_SHA256 = re.compile(r"[0-9a-f]{64}")
# Values of errno that mean that another process holds the lock; other values mean that the file system has no locks.
_HELD = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK)
_MAKE_AGAIN = "Run `jawusd build ... --resume` to make it again, or restore the file that the build wrote."
_AGAIN = "Delete it, or build with --fresh into a new folder."

#: Called with (stage, done, total) as work proceeds; total is 0 when unknown.
Progress = Callable[[str, int, int], None]


def no_progress(stage: str, done: int, total: int) -> None:
    """Do nothing; the default progress callback."""


def hash_files(paths: Iterable[Path]) -> str:
    """Return the SHA-256 of the names and contents of files, in the given order; raises OSError if unreadable."""
    total = hashlib.sha256()
    for path in paths:
        check_input(path)
        total.update(os.fsencode(path.name) + b"\0")
        with open(path, "rb") as handle:
            hashlib.file_digest(handle, lambda: total)
        total.update(b"\1")
    return total.hexdigest()


def hash_value(value: object) -> str:
    """Return the SHA-256 of a JSON-serialisable value, independent of key order."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()


R = TypeVar("R", bound=Mapping[str, object])
R_co = TypeVar("R_co", bound=Mapping[str, object], covariant=True)


@dataclass(frozen=True)
class StageRecord(Generic[R_co]):
    """The record of one finished stage."""

    inputs: str  # hash of all inputs of the stage: files, configuration, results of earlier stages
    outputs: dict[str, str]  # hash of each output file, by its path relative to the folder
    seconds: float
    result: R_co  # small results needed by later stages or by reports


class BuildState:
    """The record of finished stages of one output folder, kept in build.json."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.stages: dict[str, StageRecord[Mapping[str, object]]] = {}
        path = folder / BUILD_FILE
        if path.exists():
            self.stages = _read(path)

    def valid(self, stage: str, inputs: str) -> StageRecord[Mapping[str, object]] | None:
        """Return the record of a stage if its inputs and its files on disk are unchanged, otherwise None."""
        record = self.stages.get(stage)
        if record is None or record.inputs != inputs:
            return None
        return None if any(self._changed(*output) for output in record.outputs.items()) else record

    def changed(self) -> list[Finding]:
        """Return an error for every file that is missing or differs from what the build wrote."""
        outputs = [output for record in self.stages.values() for output in record.outputs.items()]
        return [
            Finding("build_changed", "error", message, path=name, hint=_MAKE_AGAIN)
            for name, expected in sorted(outputs)
            if (message := self._changed(name, expected))
        ]

    def _changed(self, name: str, expected: str) -> str:
        path = self.folder / name
        try:
            if not path.is_file():
                return "is missing, although the build wrote it"
            return "" if hash_files([path]) == expected else "was modified or replaced after the build"
        except OSError as error:
            return f"cannot be read ({error.strerror})"

    def result(self, stage: str, kind: type[R]) -> R | None:
        """Return the result of a stage, None if it is not recorded; raises FormatError if it has another type."""
        record = self.stages.get(stage)
        return None if record is None else of_kind(record.result, kind, stage, self.folder / BUILD_FILE, _AGAIN)

    def finish(self, stage: str, inputs: str, outputs: Iterable[Path], seconds: float, result: R) -> StageRecord[R]:
        """Record a stage whose output files are complete, and write build.json; raises OutputError if that fails."""
        hashes = {str(path.relative_to(self.folder)): hash_files([path]) for path in outputs}
        record = StageRecord(inputs, hashes, round(seconds, 3), result)
        self.stages[stage] = record
        stages = json.loads(json.dumps({name: asdict(record) for name, record in self.stages.items()}))
        data = {"format": f"{FAMILY}/{VERSION}", "stages": stages, "sha256": hash_value(stages)}
        write_text_atomic(self.folder / BUILD_FILE, json.dumps(data, indent=1, sort_keys=True) + "\n")
        return record

    def clear(self) -> None:
        """Delete the files that earlier builds wrote to the folder, and nothing else."""
        for record in self.stages.values():
            for name in record.outputs:
                target = (self.folder / name).resolve()
                # build.json may have been edited: never follow a path out of the folder.
                if target.is_relative_to(self.folder.resolve()):
                    target.unlink(missing_ok=True)
        (self.folder / BUILD_FILE).unlink(missing_ok=True)
        self.stages = {}


def _read(path: Path) -> dict[str, StageRecord[Mapping[str, object]]]:
    try:
        data = read_json(path, _MOST_BYTES)
        if not isinstance(data, dict):
            raise ValueError("it is not a JSON object")
        check_format(data.get("format"), FAMILY, VERSION, path)
        # The hash detects accidental edits, but not forgery; types are checked in `BuildState.result`.
        if data["sha256"] != hash_value(data["stages"]):
            raise ValueError("it was modified after it was written")
        return {str(name): _record(found) for name, found in data["stages"].items()}
    except (ValueError, TypeError, AttributeError, KeyError, OverflowError, RecursionError) as error:
        raise FormatError(f"is damaged ({error}).", path=path, hint=_AGAIN) from error


def _record(found: Mapping[str, object]) -> StageRecord[Mapping[str, object]]:
    inputs, outputs, seconds, result = (found[name] for name in ("inputs", "outputs", "seconds", "result"))
    if not (isinstance(inputs, str) and isinstance(outputs, dict) and isinstance(result, dict)):
        raise ValueError("inputs must be text; outputs and result must be JSON objects")
    for name, value in outputs.items():
        place = PurePosixPath(name)
        if place.is_absolute() or ".." in place.parts or not _SHA256.fullmatch(str(value)):
            raise ValueError(f'outputs contain "{name}", which is outside the folder or has no valid hash')
    if not isinstance(seconds, int | float) or not math.isfinite(float(seconds)):
        raise ValueError("seconds must be a finite number")
    return StageRecord(inputs, outputs, float(seconds), result)


class ReportSummary(TypedDict):
    """Path of the capture relative to the rig, origin of the build, and the report's file or the missing packages."""

    capture: NotRequired[str]
    origin: NotRequired[dict[str, object]]
    file: NotRequired[str]
    verdict: NotRequired[BuildVerdict]
    missing: NotRequired[str]


def recorded_verdict(folder: Path) -> str | None:
    """Return the verdict on a build; None without a build or report, and if build.json is corrupt."""
    try:
        found = BuildState(folder).result("report", ReportSummary)
    except FormatError:
        return None
    return verdict_sentence(found["verdict"]) if found and "verdict" in found else None


def changed_files(folder: Path) -> list[Finding]:
    """Return errors for the files of a build that are missing or modified; an empty list if the folder has no build."""
    try:
        return BuildState(folder).changed()
    except FormatError as error:
        return [Finding("build_changed", "error", error.message, path=BUILD_FILE, hint=error.hint)]


def make_folder(path: Path) -> None:
    """Create a folder unless it exists; raises OutputError, also if OpenUSD could not open files at its path."""
    check_path(path, OutputError)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write here: {error.strerror}.", path=path, hint=ELSEWHERE) from error


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock the output folder for one build; the system releases the lock when the process ends, even if it is killed.

    Temporary files of a killed build are deleted. If the file system does not support locks, a warning is issued.
    Raises OutputError if the folder cannot be written, another build holds the lock, or its labels folder is a link.
    """
    make_folder(folder)
    try:
        handle = os.open(destination(folder / LOCK_FILE), os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise OutputError(f"cannot write here: {error.strerror}.", path=folder, hint=ELSEWHERE) from error
    try:
        if (folder / LABELS).is_symlink():
            raise OutputError("is a symbolic link; a build only writes inside its own folder.", path=folder / LABELS)
        if _lock(handle, folder):
            clear_unfinished(folder)
        yield
    finally:
        os.close(handle)


def _lock(handle: int, folder: Path) -> bool:
    """Lock an open file, or raises OutputError; return False, with a warning, if the file system has no locks."""
    deadline = time.monotonic() + _ENDING_S
    while True:
        try:
            _take(handle)
            return True
        except OSError as error:
            if error.errno not in _HELD:
                message = f"the file system has no locks ({error.strerror}); do not start a second build in this folder"
                logging.getLogger(__name__).warning(Finding("no_lock", "warning", message, path=str(folder)).line())
                return False
            if time.monotonic() > deadline:
                hint = "Wait until it ends, or choose another folder."
                raise OutputError("another jawusd build is running in this folder.", path=folder, hint=hint) from error
        time.sleep(0.05)


def _take(handle: int) -> None:
    """Lock an open file; raises OSError if it is locked."""
    if sys.platform == "win32":
        import msvcrt

        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


_PACKAGES = ("numpy", "scipy", "numba", "usd-core", "opencv-contrib-python-headless", "av")


def origin_now(command: str) -> Origin:
    """Return the origin of a build: the current time, package versions and the command line ("" if none)."""
    return Origin(datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC"), command, package_versions())


def recorded_origin(result: Mapping[str, object]) -> Origin:
    """Return the origin recorded by the report stage; empty for builds by versions that did not record it."""
    found = result.get("origin")
    if not isinstance(found, dict):
        return Origin("", "", {})
    versions = found.get("versions")
    named = {str(name): str(version) for name, version in versions.items()} if isinstance(versions, dict) else {}
    return Origin(str(found.get("finished", "")), str(found.get("command", "")), named)


def package_versions() -> dict[str, str]:
    """Return the versions of jawusd, of Python and of the packages that results depend on."""
    found = {name: installed_version(name) or "not installed" for name in _PACKAGES}
    return {"jawusd": __version__, "Python": platform.python_version(), **found}


def installed_version(name: str) -> str:
    """Return the version of a package; "" if it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""
