"""The output folder of a build while its stages run: inputs, lock, resume, records and progress."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic

from jawusd.base.errors import AnyPath, CaptureError, JawusdError, OutputError
from jawusd.base.guard import trim_memory
from jawusd.base.version import __version__
from jawusd.cameras.files import calibration_files
from jawusd.formats.capture import Capture, load_capture
from jawusd.formats.file_names import is_pattern, numbered_files
from jawusd.formats.mesh import labels_path
from jawusd.pipeline.state import (
    BUILD_FILE,
    LOCK_FILE,
    BuildState,
    Progress,
    R,
    R_co,
    StageRecord,
    hash_files,
    hash_value,
    no_progress,
)
from jawusd.pipeline.subject import BONES, TEETH


def open_capture(capture: Capture | AnyPath, *, allow_outside: bool = False) -> Capture:
    """Return a capture, loading it from capture.toml or its folder if needed; see `formats.capture.load_capture`."""
    return capture if isinstance(capture, Capture) else load_capture(capture, allow_outside=allow_outside)


def input_files(capture: Capture, names: Iterable[str]) -> dict[str, list[Path]]:
    """Return the input files of each part of a capture, for hashing.

    `names` are any of "teeth", "mandible", "skull", "boards", "calibration", "masks", "videos".
    """
    parts: dict[str, list[Path]] = {}
    for name in names:
        if name == "teeth":
            scans = {key: getattr(capture.scans, key) for key in TEETH.values()}
            parts |= {key: [path] for key, path in scans.items()}
            parts |= {f"{key} labels": [labels_path(path, capture.scans.labels)] for key, path in scans.items()}
        elif name in BONES and (path := getattr(capture.scans, name)) is not None:
            parts[name] = [path]
        elif name == "calibration" and capture.calibration is not None:
            parts[name] = calibration_files(capture.calibration)
        elif name == "boards" and capture.boards is not None:
            parts |= {f"boards {k}": _sequence_files(path) for k, path in enumerate(capture.boards.videos)}
        elif name == "videos":
            clips = {camera.name: camera.video for camera in capture.cameras if camera.video is not None}
            parts |= {f"video {camera}": _sequence_files(path) for camera, path in clips.items()}
        elif name == "masks":
            for camera in capture.cameras:
                arches = {camera.masks.upper: "upper", camera.masks.lower: "lower"} if camera.masks else {}
                parts |= {f"masks {camera.name} {arch}": _sequence_files(path) for path, arch in arches.items()}
    return {part: [path for path in files if path.is_file()] for part, files in parts.items()}


def input_hashes(
    capture: Capture, names: Iterable[str], hashed: Callable[[list[Path]], str] = hash_files
) -> dict[str, str]:
    """Return the content hash of each part of a capture; `hashed` returns one hash of a list of files.

    Raises CaptureError if a file cannot be read.
    """
    try:
        names = list(names)
        found = {part: hashed(files) for part, files in input_files(capture, names).items()}
    except OSError as error:
        raise CaptureError(f"cannot be read: {error.strerror}.", path=error.filename) from error
    if "videos" in names:  # settings that affect the decoding of footage are hashed too
        keys = {"timecode", "start_frame", "fps", "colour_space", "pixel_aspect"}
        found["footage as read"] = hash_value([camera.model_dump(include=keys) for camera in capture.cameras])
        if capture.colour_config is not None:
            found["colour config"] = hashed([capture.colour_config])
    return found


def _sequence_files(path: Path) -> list[Path]:
    """Return the numbered files of an image pattern, or the path itself for a video."""
    if not is_pattern(path):
        return [path]
    try:
        return list(numbered_files(path).values())
    except CaptureError:  # the error is reported when the clip is opened
        return []


@dataclass(frozen=True)
class Stage(Generic[R_co]):
    """One stage of a build."""

    name: str  # name in build.json and in progress messages
    result: type[R_co]  # type of the stage's result in build.json
    seconds: float  # estimate for `--dry-run` on one core of 2.5 GHz, measured on two captures of three cameras
    seconds_per_picture: float = 0.0  # the same, for each image of 1280 x 720 to 1920 x 1080 pixels


class StageMissing(Exception):
    """Raised in a dry run when a stage cannot be reused."""


class Workspace:
    """Runs the stages of a build and records them; stages whose inputs have not changed are `reused`.

    `capture` has the scan labels and the calibration from earlier stages.
    """

    def __init__(
        self, folder: Path, capture: Capture, read_capture: Callable[[], Capture], progress: Progress = no_progress
    ) -> None:
        """Open a folder without locking it; `read_capture` is called again after each stage."""
        self._read_capture = read_capture
        self._opened = self.capture = capture
        self._hashed: list[tuple[Capture, list[str], dict[str, str]]] = []
        self._known: dict[tuple[object, ...], str] = {}  # hashes of files by their names, sizes and timestamps
        self.folder, self.progress = folder, progress
        self.state = BuildState(folder)
        self.reused: list[str] = []

    def hashes(self, parts: Iterable[str]) -> dict[str, str]:
        """Return content hashes of parts of the capture (see `input_hashes`), which are checked for later changes."""
        names = list(parts)
        found = input_hashes(self.capture, names, self._hash)
        self._hashed.append((self.capture, names, found))
        return found

    def changed_inputs(self) -> list[str]:
        """Return the names, as in `input_files`, of the parts that changed since they were hashed."""
        parts: set[str] = set()
        for capture, names, before in self._hashed:
            now = input_hashes(capture, names, self._hash)
            parts |= {part for part in before.keys() | now.keys() if before.get(part) != now.get(part)}
        return sorted(parts)

    def _hash(self, files: list[Path]) -> str:
        """Return the hash of files; those whose size and timestamps are unchanged are not read again."""
        states = [(path, path.stat()) for path in files]
        key = tuple((p, s.st_dev, s.st_ino, s.st_size, s.st_mtime_ns, s.st_ctime_ns) for p, s in states)
        if key not in self._known:
            self._known[key] = hash_files(files)
        return self._known[key]

    def run(
        self,
        stage: Stage[R],
        parts: Iterable[str],
        settings: Iterable[object],
        work: Callable[[], tuple[list[Path], R]],
    ) -> StageRecord[R]:
        """Run a stage, or reuse its record.

        Args:
            parts: parts of the capture that the stage reads, by the names of `input_files`.
            settings: everything else that determines the result, such as options and the results of earlier stages.
            work: runs the stage; returns the files written, inside the folder, and the result for build.json.

        Raises:
            CaptureError: an input changed while the stage ran; the stage is not recorded.
        """
        inputs = hash_value([self.hashes(parts), *settings, __version__])
        record = self.state.valid(stage.name, inputs)
        result = None if record is None else self.state.result(stage.name, stage.result)
        if record is not None and result is not None:
            self.reused.append(stage.name)
            self.progress(stage.name, 1, 1)
            return StageRecord(record.inputs, record.outputs, record.seconds, result)
        return self._work(stage, inputs, work)

    def _work(self, stage: Stage[R], inputs: str, work: Callable[[], tuple[list[Path], R]]) -> StageRecord[R]:
        start = time.perf_counter()
        outputs, result = work()
        self._refuse_changes(stage.name)
        trim_memory()
        return self.state.finish(stage.name, inputs, outputs, time.perf_counter() - start, result)

    def _refuse_changes(self, stage: str) -> None:
        """Raise an error if inputs of a stage were edited while it ran: it is unknown which version was read."""
        changed = self.changed_inputs()
        try:
            same = self._read_capture() == self._opened
        except JawusdError:  # an editor may be saving the file
            same = False
        if changed or not same:
            raise CaptureError(
                f"changed while the stage {stage} ran: {', '.join([*changed, *([] if same else ['capture.toml'])])}. "
                "The stage is not recorded.",
                path=self._opened.folder,
                hint="Run the same command again with --resume: stages that do not depend on the change are reused.",
            )


class DryWorkspace(Workspace):
    """A workspace for dry runs: it reuses stages but runs none."""

    def _work(self, stage: Stage[R], inputs: str, work: Callable[[], tuple[list[Path], R]]) -> StageRecord[R]:
        raise StageMissing(stage.name)


def check_folder(folder: Path, *, resume: bool, fresh: bool) -> None:
    """Check that a build may write to a folder.

    Raises OutputError if the path is a file, or if the folder is not empty and holds no build to `resume` or replace
    (`fresh`).
    """
    if folder.is_file():
        raise OutputError("is a file; the rig needs a folder.", path=folder, hint="Choose a new folder.")
    if not folder.is_dir() or resume or fresh:
        return
    if (folder / BUILD_FILE).exists():
        raise OutputError(
            "contains an earlier build.", path=folder, hint="Continue it with --resume, or start over with --fresh."
        )
    if any(entry.name != LOCK_FILE for entry in folder.iterdir()):
        raise OutputError("exists and is not empty.", path=folder, hint="Choose a new folder.")
