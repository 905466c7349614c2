"""What a build has finished: `build.json`, content hashes, and the lock of the output folder."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Generic, TypeVar

from jawusd.errors import FormatError, OutputError
from jawusd.formats.atomic import ELSEWHERE, clear_unfinished, write_text_atomic
from jawusd.inputs import check_input, check_path
from jawusd.npz import check_format

FAMILY, VERSION = "jawusd-build", 1
BUILD_FILE = "build.json"
LOCK_FILE = ".jawusd-lock"
CALIBRATION = "calibration.toml"  # made from the boards when the capture names none
LABELS = "labels"  # folder of the labels of scans that are neither painted nor labelled
FIRST_PASS = "first_pass.npz"  # tracks without the model's help: what the model is fitted to
_CHUNK_BYTES = 1 << 20
_ENDING_S = 2.0  # a killed build holds its lock until the system has taken back its memory

#: Called with (stage, done, total) as work proceeds; total is 0 when unknown.
Progress = Callable[[str, int, int], None]


def no_progress(stage: str, done: int, total: int) -> None:
    """Ignore the progress of work."""


def hash_files(paths: Iterable[Path]) -> str:
    """Return the SHA-256 of files' names and contents, in the given order; raises OSError for an unreadable file."""
    total = hashlib.sha256()
    for path in paths:
        check_input(path)
        total.update(path.name.encode() + b"\0")
        with open(path, "rb") as handle:
            while chunk := handle.read(_CHUNK_BYTES):
                total.update(chunk)
        total.update(b"\1")
    return total.hexdigest()


def hash_value(value: object) -> str:
    """Return the SHA-256 of a JSON-able value, independent of key order."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()


R = TypeVar("R", bound=Mapping[str, object])
R_co = TypeVar("R_co", bound=Mapping[str, object], covariant=True)


@dataclass(frozen=True)
class StageRecord(Generic[R_co]):
    """Record one finished stage."""

    inputs: str  # hash of everything the stage read: files, configuration, results of earlier stages
    outputs: dict[str, str]  # hash by file name, relative to the folder
    seconds: float
    result: R_co  # small results that later stages or reports need


#: Finished stages by name.
Stages = Mapping[str, StageRecord[Mapping[str, object]]]


class BuildState:
    """Keep the record of finished stages of one output folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.stages: dict[str, StageRecord[Mapping[str, object]]] = {}
        path = folder / BUILD_FILE
        if path.exists():
            self.stages = _read(path)

    def valid(self, stage: str, inputs: str) -> StageRecord[Mapping[str, object]] | None:
        """Return the record of a stage if its inputs and its files on disk are unchanged."""
        record = self.stages.get(stage)
        if record is None or record.inputs != inputs:
            return None
        for name, expected in record.outputs.items():
            path = self.folder / name
            if not path.is_file() or hash_files([path]) != expected:
                return None
        return record

    def finish(self, stage: str, inputs: str, outputs: Iterable[Path], seconds: float, result: R) -> StageRecord[R]:
        """Record a stage whose output files are complete, and write build.json; see `StageRecord`.

        Raises:
            OutputError: build.json cannot be written.
        """
        hashes = {str(path.relative_to(self.folder)): hash_files([path]) for path in outputs}
        record = StageRecord(inputs, hashes, round(seconds, 3), result)
        self.stages[stage] = record
        stages = json.loads(json.dumps({name: asdict(record) for name, record in self.stages.items()}))
        data = {"format": f"{FAMILY}/{VERSION}", "stages": stages, "sha256": hash_value(stages)}
        write_text_atomic(self.folder / BUILD_FILE, json.dumps(data, indent=1, sort_keys=True) + "\n")
        return record

    def clear(self) -> None:
        """Delete what earlier builds wrote here, and nothing else."""
        for record in self.stages.values():
            for name in record.outputs:
                target = (self.folder / name).resolve()
                # build.json is only a file: never follow a name out of the folder.
                if target.is_relative_to(self.folder.resolve()):
                    target.unlink(missing_ok=True)
        (self.folder / BUILD_FILE).unlink(missing_ok=True)
        self.stages = {}


def _read(path: Path) -> dict[str, StageRecord[Mapping[str, object]]]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        check_format(data.get("format"), FAMILY, VERSION, path)
        # The values of results are not checked one by one; the hash shows that they are what jawusd wrote.
        if data["sha256"] != hash_value(data["stages"]):
            raise ValueError("changed since it was written")
        return {str(name): StageRecord(**record) for name, record in data["stages"].items()}
    except (OSError, ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
        raise FormatError(
            f"is damaged ({error}).", path=path, hint="Delete it, or build with --fresh into a new folder."
        ) from error


def make_folder(path: Path) -> None:
    """Make a folder that may exist.

    Raises:
        OutputError: it cannot be made, or OpenUSD could not follow its path.
    """
    check_path(path, OutputError)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write here: {error.strerror}.", path=path, hint=ELSEWHERE) from error


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the output folder for one build; the system releases the lock when the process ends, however it ends.

    What a killed build left unfinished is deleted.

    Raises:
        OutputError: the folder cannot be written, or another build holds it.
    """
    make_folder(folder)
    try:
        handle = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise OutputError(f"cannot write here: {error.strerror}.", path=folder, hint=ELSEWHERE) from error
    try:
        deadline = time.monotonic() + _ENDING_S
        while not (locked := _try_lock(handle)) and time.monotonic() < deadline:
            time.sleep(0.05)
        if not locked:
            raise OutputError(
                "another jawusd build is working in this folder.", path=folder, hint="Wait for it, or name another one."
            )
        clear_unfinished(folder)
        yield
    finally:
        os.close(handle)


def _try_lock(handle: int) -> bool:
    """Take the operating system's lock on an open file; the system frees it when the process dies."""
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
