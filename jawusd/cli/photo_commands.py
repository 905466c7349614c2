"""Photographs of teeth that are together: photos."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jawusd.cli.options import Force, Json
from jawusd.cli.output import emit, progress


def photos(
    outlines: Annotated[
        list[Path],
        typer.Argument(
            help="A picture per photograph: bright lines along the teeth on black, or areas of the teeth.",
            show_default=False,
        ),
    ],
    upper_teeth: Annotated[Path, typer.Option(help="Scan of the upper teeth, in any frame.", show_default=False)],
    lower_teeth: Annotated[Path, typer.Option(help="Scan of the lower teeth, in any frame.", show_default=False)],
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder of photos.json and of a picture per photograph.")
    ] = Path("photos"),
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Find how two scans bite, from outlines drawn in photographs of the teeth together.

    All photographs show one bite and come from one camera, whose focal length need not be known; some may be taken over
    a mirror. Exit code 6 if the scans do not fit the lines.
    """
    from jawusd.base.errors import TrackingError
    from jawusd.pipeline.photographs import align_photograph_files, photograph_lines

    with progress() as report:
        found = align_photograph_files(outlines, upper_teeth, lower_teeth, out, force=force, progress=report)
    emit({**found.result.as_json(), "file": str(found.file)}, as_json, lambda: photograph_lines(found))
    if any(finding.severity == "error" for finding in found.result.findings):
        raise typer.Exit(TrackingError.exit_code)
