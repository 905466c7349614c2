"""The output folder of a build while its stages run: lock, resume, input checks, records and progress."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from jawusd.base.errors import CaptureError, JawusdError, OutputError
from jawusd.base.guard import trim_memory
from jawusd.base.version import __version__
from jawusd.formats.capture import Capture
from jawusd.pipeline.capture_inputs import InputWatch
from jawusd.pipeline.state import (
    BUILD_FILE,
    LOCK_FILE,
    BuildState,
    Progress,
    StageRecord,
    hash_value,
    locked,
    no_progress,
)

R = TypeVar("R", bound=Mapping[str, object])
R_co = TypeVar("R_co", bound=Mapping[str, object], covariant=True)


@dataclass(frozen=True)
class Stage(Generic[R_co]):
    """One stage of a build.

    Attributes:
        name: name in build.json and in progress messages.
        result: type of the stage's result in build.json.
        seconds, seconds_per_picture: estimate for `--dry-run` on one core of 2.5 GHz, measured on two captures of three
            cameras at 1280 x 720 and 1920 x 1080.
    """

    name: str
    result: type[R_co]
    seconds: float
    seconds_per_picture: float = 0.0


class StageMissing(Exception):
    """Raised in a dry run when a stage cannot be reused."""


class Workspace:
    """Runs the stages of a build and records them; stages whose inputs have not changed are reused.

    Attributes:
        capture: the capture, with the scan labels and the calibration from earlier stages.
        folder: folder of the build.
        state: the record of finished stages, build.json.
        progress: called with (stage, done, total).
        reused: names of the stages that were reused.
    """

    def __init__(
        self,
        folder: Path,
        capture: Capture,
        read_capture: Callable[[], Capture],
        progress: Progress = no_progress,
    ) -> None:
        """Open a folder without locking it; `read_capture` is called again after each stage."""
        self._read_capture = read_capture
        self._opened = self.capture = capture
        self._watch = InputWatch()
        self.folder, self.progress = folder, progress
        self.state = BuildState(folder)
        self.reused: list[str] = []

    def hashes(self, parts: Iterable[str]) -> dict[str, str]:
        """Return content hashes of parts of the capture (see `capture_inputs.input_files`); raises CaptureError."""
        return self._watch.hashes(self.capture, parts)

    def run(
        self,
        stage: Stage[R],
        parts: Iterable[str],
        settings: Iterable[object],
        work: Callable[[], tuple[list[Path], R]],
    ) -> StageRecord[R]:
        """Run a stage, or reuse its record.

        Args:
            parts: parts of the capture that the stage reads, by the names of `capture_inputs.input_files`.
            settings: everything else that determines the result, such as options and the results of earlier stages.
            work: function that runs the stage; returns the files written, inside the folder, and the result for
                build.json.

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
        """Raise an error if inputs of a stage were edited while it ran: it is unknown which version the stage has read.

        Edits of capture.toml that change no value are ignored.
        """
        changed = self._watch.changed()
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


@contextlib.contextmanager
def opened(
    folder: Path, read_capture: Callable[[], Capture], *, resume: bool, fresh: bool, progress: Progress
) -> Iterator[Workspace]:
    """Open the folder of a build, and hold its lock for the duration of the context.

    Args:
        read_capture: function that reads the capture; called before the folder is created and after each stage.
        resume: continue an earlier build in the folder.
        fresh: delete an earlier build in the folder first.

    Raises:
        OutputError: see `check_folder` and `state.locked`.
    """
    capture = read_capture()
    check_folder(folder, resume=resume, fresh=fresh)
    with locked(folder):
        workspace = Workspace(folder, capture, read_capture, progress)
        if fresh:
            workspace.state.clear()
        yield workspace


def check_folder(folder: Path, *, resume: bool, fresh: bool) -> None:
    """Check that a build may write to a folder.

    Raises:
        OutputError: the path is a file, or the folder is not empty, or it contains a build and neither `resume` nor
            `fresh` is set.
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
