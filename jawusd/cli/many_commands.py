"""The command for many captures at once: build-many."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jawusd.cli.build_commands import Json, Method, Outside
from jawusd.cli.output import emit


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("build-many")(build_many)


def build_many(
    captures: Annotated[
        Path,
        typer.Argument(
            metavar="LIST", help="Text with one capture a line: PATH, or PATH, NAME of its folder.", show_default=False
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder of the rigs' folders.", show_default=False)],
    model: Annotated[Method, typer.Option(help="Form of the jaw models.")] = Method.anchored,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Dask scheduler to use, as tcp://host:8786; its workers need jawusd and the same paths. "
            "Without: processes of this machine.",
            show_default=False,
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, max=1024, help="Processes of this machine; one per core else.", show_default=False),
    ] = None,
    retries: Annotated[
        int, typer.Option(min=0, max=100, help="How often to start over when a process of this machine dies.")
    ] = 3,
    resume: Annotated[bool, typer.Option("--resume", help="Continue earlier builds in this folder.")] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="Delete earlier builds in this folder first.")] = False,
    jobs: Annotated[int, typer.Option(min=1, max=64, help="Threads of each build.")] = 1,
    allow_outside: Outside = False,
    as_json: Json = False,
) -> None:
    """Build many captures, one process each; one that fails stops no other. Exit code 1 if any failed."""
    from dataclasses import asdict

    from jawusd.formats.capture_list import load_capture_list
    from jawusd.pipeline import many
    from jawusd.pipeline.build import BuildOptions

    if cluster is not None and workers is not None:
        raise typer.BadParameter("--workers are processes of this machine; a --cluster has its own.")
    build = BuildOptions(model.value, jobs=jobs, resume=resume, fresh=fresh, allow_outside=allow_outside)
    outcomes = many.build_many(
        load_capture_list(captures),
        out,
        many.ManyOptions(build, cluster, workers, retries),
        lambda line: typer.echo(line, err=True),
    )
    data = {"folder": str(out), "builds": [asdict(outcome) for outcome in outcomes]}
    emit(data, as_json, lambda: many.outcome_lines(outcomes))
    if any(outcome.status == many.FAILED for outcome in outcomes):
        raise typer.Exit(1)
