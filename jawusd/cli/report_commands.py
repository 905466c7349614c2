"""The command that reports on a finished build or on tracks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

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
    """Repeat the paper's experiments on a take: figures (PNG, SVG) and a table (CSV)."""
    from jawusd.pipeline.experiments import experiment_files, experiment_lines, report_experiments
    from jawusd.pipeline.stages import about, read_motion
    from jawusd.pipeline.subject import subject_of_build

    if not experiments:
        raise typer.BadParameter("add --experiments: figures and table of the paper's experiments.")
    if out is None and not source.is_dir():
        raise typer.BadParameter("name the folder of the figures with -o.", param_hint="--out")
    folder = out or source / "experiments"
    for path in experiment_files(folder):
        refuse_existing(path, force)
    options = trajectory_options(columns, length_unit, invert, rest_frame, group)
    given = (capture, upper_teeth, lower_teeth, mandible, landmarks)
    poses = source / "tracks.npz" if source.is_dir() else source
    motion = read_motion(poses, options)
    if source.is_dir() and not any(given):
        subject = subject_of_build(source)
    else:
        subject = subject_given(source.stem, *given, allow_outside)
    with progress() as tell, about(poses):
        summary = report_experiments(subject, motion, folder, starts, tell)
    emit(summary, as_json, lambda: experiment_lines(summary))
