"""Commands from a capture to a rig: build and its single stages."""

from __future__ import annotations

from enum import StrEnum
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

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite an existing output.")]
Outside = Annotated[bool, typer.Option("--allow-outside", help="Let paths in the capture leave its folder.")]
CaptureArg = Annotated[Path, typer.Argument(help="capture.toml, or the folder that holds it.", show_default=False)]


class Method(StrEnum):
    """Name the jaw models."""

    anchored = "anchored"
    additive = "additive"
    paper = "paper"
    pca = "pca"


class Solver(StrEnum):
    """Name the trackers."""

    contour = "contour"
    paper = "paper"


class Backend(StrEnum):
    """Name the places where the paper's solver draws."""

    cpu = "cpu"
    gl = "gl"


SolverOption = Annotated[Solver, typer.Option(help="How to track: paper is slower and less accurate, to compare with.")]
BackendOption = Annotated[Backend, typer.Option(help="Where --solver paper draws; gl needs OpenGL 4.3 (EGL).")]


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("build")(build)
    app.command("track")(track)
    app.command("fit")(fit)
    app.command("bake")(bake)
    app.command("demo")(demo)


def build(
    capture: CaptureArg,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder of the rig.", show_default=False)],
    model: Annotated[Method, typer.Option(help="Form of the jaw model.")] = Method.anchored,
    solver: SolverOption = Solver.contour,
    backend: BackendOption = Backend.cpu,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an earlier build in this folder.")] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="Delete an earlier build in this folder first.")] = False,
    jobs: Annotated[int, typer.Option(min=1, max=64, help="Threads that draw and compare.")] = 2,
    allow_outside: Outside = False,
    as_json: Json = False,
) -> None:
    """Turn a capture into a rig: calibrate and segment if need be, sync, track, fit, track hard frames again, bake."""
    from jawusd.pipeline.build import BuildOptions, build_rig
    from jawusd.pipeline.summary import build_lines

    _check_backend(solver, backend)
    options = BuildOptions(
        model.value, solver.value, backend.value, jobs=jobs, resume=resume, fresh=fresh, allow_outside=allow_outside
    )
    with progress() as report:
        summary = build_rig(capture, out, options, report)
    emit(summary, as_json, lambda: build_lines(summary))


def track(
    capture: CaptureArg,
    out: Annotated[Path, typer.Option("-o", "--out", help="File of the tracks.")] = Path("tracks.npz"),
    solver: SolverOption = Solver.contour,
    backend: BackendOption = Backend.cpu,
    prior: Annotated[
        Path | None,
        typer.Option(help="model.npz of this person: a second pass with its help.", show_default=False),
    ] = None,
    overlay: Annotated[
        Path | None, typer.Option(help="Folder for videos with the tracked scans over the footage.", show_default=False)
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, max=64, help="Threads that draw and compare.")] = 2,
    force: Force = False,
    allow_outside: Outside = False,
    as_json: Json = False,
) -> None:
    """Track both rows of teeth through the masks."""
    from jawusd.formats.model import load_model
    from jawusd.formats.tracks import save_tracks
    from jawusd.pipeline.overlay import overlay_files, write_overlay
    from jawusd.pipeline.prepare import open_capture
    from jawusd.pipeline.stages import aid_teeth, sync_cameras, track_teeth
    from jawusd.pipeline.summary import track_lines, track_summary

    _check_backend(solver, backend)
    refuse_existing(out, force)
    model = load_model(prior) if prior else None
    opened = open_capture(capture, allow_outside=allow_outside)
    for path in overlay_files(opened, overlay) if overlay else ():
        refuse_existing(path, force)
    with progress() as report:
        offsets = sync_cameras(opened, report)["offsets"]
        tracks = track_teeth(opened, offsets, jobs, report, solver.value, backend.value)
        if model is not None:
            tracks = aid_teeth(opened, offsets, tracks, model, jobs, report)
        save_tracks(out, tracks)
        drawn = write_overlay(opened, offsets, tracks, overlay, report) if overlay else []
    summary = {**track_summary(tracks), "file": str(out), "overlay": [str(path) for path in drawn]}
    emit(summary, as_json, lambda: track_lines(summary))


def _check_backend(solver: Solver, backend: Backend) -> None:
    if backend is Backend.gl and solver is not Solver.paper:
        raise typer.BadParameter("--backend gl belongs to --solver paper; the contour solver runs on the CPU.")


def fit(
    poses: Annotated[
        Path,
        typer.Argument(help="tracks.npz, a CSV of poses, or HDF5 of jaw-tracking-system.", show_default=False),
    ],
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
    out: Annotated[Path, typer.Option("-o", "--out", help="File of the model.")] = Path("model.npz"),
    model: Annotated[Method, typer.Option(help="Form of the jaw model.")] = Method.anchored,
    force: Force = False,
    allow_outside: Outside = False,
    as_json: Json = False,
) -> None:
    """Fit a three-parameter jaw model to tracked or given poses."""
    from jawusd.formats.model import save_model
    from jawusd.pipeline.stages import about, fit_subject, read_motion
    from jawusd.pipeline.summary import fit_lines, fit_summary

    refuse_existing(out, force)
    motion = read_motion(poses, trajectory_options(columns, length_unit, invert, rest_frame, group))
    subject = subject_given(poses.stem, capture, upper_teeth, lower_teeth, mandible, landmarks, allow_outside)
    with progress() as report, about(poses):
        fitted = fit_subject(subject, motion, model.value, report)
    save_model(out, fitted)
    summary = {**fit_summary(fitted), "file": str(out)}
    emit(summary, as_json, lambda: fit_lines(summary))


def bake(
    model: Annotated[Path, typer.Argument(help="model.npz.", show_default=False)],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder of the rig.", show_default=False)],
    capture: CaptureOption = None,
    upper_teeth: UpperOption = None,
    lower_teeth: LowerOption = None,
    mandible: MandibleOption = None,
    fps: Annotated[float, typer.Option(min=0.001, help="Frames per second of a person without a capture.")] = 24.0,
    table: Annotated[int, typer.Option(help="Knots per axis of the sampled decoder: 17, 33 or 65.")] = 33,
    force: Force = False,
    allow_outside: Outside = False,
    as_json: Json = False,
) -> None:
    """Write the OpenUSD rig of a model, with the meshes of a capture or loose scans."""
    from jawusd.formats.model import load_model
    from jawusd.pipeline.stages import bake_meshes
    from jawusd.pipeline.subject import check_same_jaw

    refuse_existing(out / "actor.usda", force)
    loaded = load_model(model)
    name = str(loaded.meta.get("actor") or model.stem)
    subject = subject_given(name, capture, upper_teeth, lower_teeth, mandible, None, allow_outside)
    check_same_jaw(subject, loaded)
    with progress() as report:
        files = bake_meshes(subject.bones, subject.name, subject.fps or fps, loaded, out, report, table)
    emit({"files": files}, as_json, lambda: [str(path) for path in files])


def demo(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder of the capture.", show_default=False)],
    seed: Annotated[int, typer.Option(min=0, help="Another number is another person.")] = 0,
    frames: Annotated[int, typer.Option(min=24, max=20000, help="Exercise frames.")] = 240,
    force: Force = False,
) -> None:
    """Render a synthetic capture with known truth: a made-up person in front of three cameras."""
    from jawusd.pipeline.stages import write_demo_capture

    refuse_existing(out / "capture.toml", force)
    with progress() as report:
        path = write_demo_capture(out, seed, frames, report)
    typer.echo(str(path))
