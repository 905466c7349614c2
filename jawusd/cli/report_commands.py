"""The command that reports on a finished build or on tracks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from jawusd.cli.output import emit, progress, refuse_existing
from jawusd.cli.subject_options import (
    CaptureOption,
    ColumnsOption,
    GroupOption,
    InvertOption,
    LandmarksOption,
    LengthUnit,
    LowerOption,
    MandibleOption,
    RestOption,
    UnitOption,
    UpperOption,
    subject_given,
    trajectory_options,
)

if TYPE_CHECKING:
    from jawusd.pipeline.trajectories import TrajectoryOptions


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("report")(report)


def report(
    source: Annotated[
        Path, typer.Argument(help="Folder of a build, or tracks.npz, CSV or HDF5 poses.", show_default=False)
    ],
    experiments: Annotated[
        bool, typer.Option("--experiments", help="The paper's experiments (Figs. 5, 12, 13) and the coverage plot.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder of the figures; DIR/experiments for a build.")
    ] = None,
    capture: CaptureOption = None,
    upper_teeth: UpperOption = None,
    lower_teeth: LowerOption = None,
    mandible: MandibleOption = None,
    landmarks: LandmarksOption = None,
    columns: ColumnsOption = None,
    length_unit: UnitOption = LengthUnit.mm,
    invert: InvertOption = False,
    rest_frame: RestOption = None,
    group: GroupOption = None,
    starts: Annotated[int, typer.Option(min=1, max=64, help="Random starts of the paper's networks.")] = 2,
    force: Annotated[bool, typer.Option("--force", help="Overwrite existing figures.")] = False,
    allow_outside: Annotated[
        bool, typer.Option("--allow-outside", help="Let paths in the capture leave its folder.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Write report.html of a finished build anew; or repeat the paper's experiments on a take (figures and table)."""
    options = trajectory_options(columns, length_unit, invert, rest_frame, group)
    given = (capture, upper_teeth, lower_teeth, mandible, landmarks)
    if not experiments:
        if not source.is_dir():
            raise typer.BadParameter("poses have no report: add --experiments for the paper's experiments on them.")
        _report_build(source, capture, None, allow_outside, as_json)
        return
    if out is None and not source.is_dir():
        raise typer.BadParameter("name the folder of the figures with -o.", param_hint="--out")
    _report_experiments(source, out, given, options, starts, force, allow_outside, as_json)


def _report_build(folder: Path, capture: Path | None, found: Any, allow_outside: bool, as_json: bool) -> None:
    from jawusd.pipeline.report import report_build

    with progress() as tell:
        summary = report_build(folder, capture, tell, found, allow_outside=allow_outside)
    emit(summary, as_json, lambda: [summary["file"]])


def _report_experiments(
    source: Path,
    out: Path | None,
    given: tuple[Path | None, ...],
    options: TrajectoryOptions,
    starts: int,
    force: bool,
    allow_outside: bool,
    as_json: bool,
) -> None:
    from jawusd.pipeline.experiments import do_experiments, draw_experiments, experiment_files, experiment_lines
    from jawusd.pipeline.report import fitted_poses, is_build, report_build
    from jawusd.pipeline.stages import about, read_motion
    from jawusd.pipeline.subject import subject_of_build

    folder = out or source / "experiments"
    for path in experiment_files(folder):
        refuse_existing(path, force)
    poses = fitted_poses(source) if source.is_dir() else source
    motion = read_motion(poses, options)
    if source.is_dir() and not any(given):
        subject = subject_of_build(source)
    else:
        subject = subject_given(source.stem, *given, allow_outside)
    with progress() as tell, about(poses):
        found = do_experiments(subject, motion, starts, tell)
        summary = draw_experiments(found, folder)
        if is_build(source):
            page = report_build(source, given[0], tell, found, allow_outside=allow_outside)
            summary["files"].append(Path(page["file"]))
    emit(summary, as_json, lambda: experiment_lines(summary))
