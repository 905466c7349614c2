"""Which stages a build would run, which it would reuse, and about how long it would take."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from jawusd.base.errors import explain_missing_packages
from jawusd.formats.capture import Capture
from jawusd.pipeline import build
from jawusd.pipeline.build import BuildOptions
from jawusd.pipeline.capture_inputs import open_capture
from jawusd.pipeline.scans import all_labelled
from jawusd.pipeline.workspace import DryWorkspace, Stage, StageMissing, check_folder


@dataclass(frozen=True)
class PlannedStage:
    """A stage of a build to come."""

    name: str
    keeps: bool  # its record is reused
    seconds: float  # an estimate; of a recorded stage how long it took


@explain_missing_packages()
def plan_build(capture: Capture | str | os.PathLike[str], out: Path, options: BuildOptions) -> list[PlannedStage]:
    """Return the stages of a build in order; nothing is written.

    Raises:
        CaptureError, FormatError: the capture cannot be read.
        OutputError: the build may not write to this folder.
    """
    opened = open_capture(capture, allow_outside=options.allow_outside)
    check_folder(out, resume=options.resume, fresh=options.fresh)
    run = DryWorkspace(out, opened, lambda: opened)
    recorded = dict(run.state.stages)
    with contextlib.suppress(StageMissing):
        if not options.fresh:
            build.run_stages(run, options, None)
    pictures = _pictures(opened)
    stages = []
    for stage in _stages(opened):
        estimate = stage.seconds + stage.seconds_per_picture * pictures
        seconds = recorded[stage.name].seconds if stage.name in recorded else estimate
        stages.append(PlannedStage(stage.name, stage.name in run.reused, seconds))
    return stages


def _stages(capture: Capture) -> list[Stage[Mapping[str, object]]]:
    before: list[Stage[Mapping[str, object]]] = [build.CHECK]
    before += [] if all_labelled(capture) else [build.SCANS]
    before += [build.CALIBRATE] if capture.calibration is None and capture.boards is not None else []
    return [*before, build.SYNC, build.TRACK, build.FIT, build.REFINE, build.BAKE, build.REPORT]


def _pictures(capture: Capture) -> int:
    """Return the number of pictures of all cameras that are processed."""
    from jawusd.media.footage import open_clip

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
    """Return a time in words, rounded coarsely."""
    if seconds < 90:
        return f"{max(5, round(seconds / 5) * 5)} seconds"
    if seconds < 90 * 60:
        return f"{round(seconds / 60)} minutes"
    return f"{seconds / 3600:.1f} hours"
