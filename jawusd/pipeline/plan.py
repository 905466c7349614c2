"""What a build would do, without doing it: its stages, which are kept from an earlier build, and about how long."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from jawusd.errors import explain_missing_packages
from jawusd.formats.capture import Capture
from jawusd.pipeline.build import BuildOptions, StagedBuild, check_folder
from jawusd.pipeline.capture_inputs import open_capture
from jawusd.pipeline.scans import all_labelled
from jawusd.pipeline.state import BuildState, StageRecord, no_progress

R = TypeVar("R", bound=Mapping[str, object])

# Seconds on one core of 2.5 GHz, measured on two captures of three cameras at 1280 x 720 and 1920 x 1080: a fixed part,
# and one per picture of a camera.
_SECONDS = {
    "check": (8.0, 0.0),
    "scans": (5.0, 0.0),
    "calibrate": (60.0, 0.0),
    "sync": (3.0, 0.0),
    "track": (10.0, 0.15),
    "fit": (15.0, 0.0),
    "aid": (5.0, 0.03),
    "bake": (5.0, 0.0),
    "report": (15.0, 0.0),
}


@dataclass(frozen=True)
class PlannedStage:
    """Hold a stage of a build to come."""

    name: str
    keeps: bool  # its results stay as an earlier build left them
    seconds: float  # how long it may take; how long it took if it is kept


class _Stop(Exception):
    """End a plan at the first stage that must run: what follows depends on its results."""


class _Plan(StagedBuild):
    """Walk through a build's stages as far as they are kept."""

    def _stage(self, name: str, kind: type[R], inputs: str, work: Callable[[], tuple[list[Path], R]]) -> StageRecord[R]:
        record = self._kept(name, kind, inputs)
        if record is None:
            raise _Stop
        return record


@explain_missing_packages()
def plan_build(capture: Capture | str | os.PathLike[str], out: Path, options: BuildOptions) -> list[PlannedStage]:
    """Return the stages of a build in order; nothing is written.

    Raises:
        CaptureError, FormatError: the capture cannot be read.
        OutputError: the build may not go to this folder.
    """
    opened = open_capture(capture, allow_outside=options.allow_outside)
    check_folder(out, options)
    state = BuildState(out)
    recorded = dict(state.stages)
    kept: list[str] = []
    if not options.fresh:
        plan = _Plan(opened, out, options, state, no_progress, lambda: opened)
        with contextlib.suppress(_Stop):
            plan.run(None)
        kept = plan.reused
    pictures = _pictures(opened)
    stages = []
    for name in _stages(opened):
        fixed, each = _SECONDS[name]
        known = recorded[name].seconds if name in recorded else fixed + each * pictures
        stages.append(PlannedStage(name, name in kept, known))
    return stages


def _stages(capture: Capture) -> list[str]:
    left_out = set()
    if all_labelled(capture):
        left_out.add("scans")
    if capture.calibration is not None or capture.boards is None:
        left_out.add("calibrate")
    return [name for name in _SECONDS if name not in left_out]


def _pictures(capture: Capture) -> int:
    """Return how many pictures of all cameras are worked on."""
    from jawusd.imaging.footage import open_clip

    counts = [open_clip(camera.clip).count for camera in capture.cameras if camera.clip is not None]
    frames = capture.frames[1] - capture.frames[0] if capture.frames else max(counts, default=300)
    return frames * len(capture.cameras)


def plan_lines(stages: list[PlannedStage]) -> list[str]:
    """Return a plan as text."""
    lines = [
        f"  {stage.name:10} {'kept' if stage.keeps else 'runs, about ' + about(stage.seconds)}" for stage in stages
    ]
    total = sum(stage.seconds for stage in stages if not stage.keeps)
    return [*lines, f"about {about(total)} in all on one core; nothing was written" if total else "nothing to do"]


def about(seconds: float) -> str:
    """Return a time in words, rounded as guesses are."""
    if seconds < 90:
        return f"{max(5, round(seconds / 5) * 5)} seconds"
    if seconds < 90 * 60:
        return f"{round(seconds / 60)} minutes"
    return f"{seconds / 3600:.1f} hours"
