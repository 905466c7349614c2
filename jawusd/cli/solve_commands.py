"""Performances of people whose rigs exist: solve."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from jawusd.cli.options import Allow, Force, Json, Outside, Prim, RigArg
from jawusd.cli.output import emit, progress
from jawusd.formats.atomic import refuse_existing


class Head(StrEnum):
    """Say whether the head moves before the cameras."""

    free = "free"
    fixed = "fixed"


class Focal(StrEnum):
    """Say whether focal lengths are calibrated."""

    known = "known"
    free = "free"


ShotArg = Annotated[
    Path, typer.Argument(help="capture.toml of the shot, or the folder that holds it.", show_default=False)
]


def solve(
    rig: RigArg,
    shot: ShotArg,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Table of d (.csv), tracks (.npz) or animation layer (.usdc).")
    ] = Path("take.csv"),
    overlay: Annotated[
        Path | None,
        typer.Option(
            help="Video (.mp4) to write of the solved teeth over all cameras side by side.",
            show_default=False,
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            help="Page (.html) to write: curves with expected errors, what was not seen, findings, pictures.",
            show_default=False,
        ),
    ] = None,
    head: Annotated[Head, typer.Option(help="fixed: the cameras are worn, and move with the head.")] = Head.free,
    focal: Annotated[
        Focal, typer.Option(help="free: the calibration only guesses focal lengths; the take tells them.")
    ] = Focal.known,
    jobs: Annotated[int, typer.Option(min=1, max=64, help="Threads that search for the start.")] = 2,
    force: Force = False,
    allow_outside: Outside = False,
    prim: Prim = None,
    allow: Allow = None,
    as_json: Json = False,
) -> None:
    """Solve a performance of the person of a rig, from the masks or else the videos of one or more cameras."""
    from jawusd.pipeline import solve as stage

    stage.check_output(rig, out, overlay, report)
    written = [path for path in (out, overlay, report) if path is not None]
    for path in written:
        refuse_existing(path, force)
    with progress() as tell:
        found = stage.solve(
            rig,
            shot,
            out,
            prim=prim,
            overlay=overlay,
            report=report,
            fixed_head=head is Head.fixed,
            free_focal=focal is Focal.free,
            jobs=jobs,
            allow_outside=allow_outside,
            progress=tell,
        )
    summary = stage.solve_summary(found)
    files = [str(path) for path in written]
    emit({**summary, "file": str(out), "files": files}, as_json, lambda: [*files, *stage.solve_lines(summary)])
