"""Commands that make a rig from a capture: builds of one or many captures, and the stages of a build."""

from __future__ import annotations

import shlex
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, BadParameter, Context, Exit, Option

from jawusd.base.errors import explain_missing_packages, naming_file
from jawusd.base.guard import map_large_arrays
from jawusd.cli import options
from jawusd.cli.commands import command_line, stopped_by_signals
from jawusd.cli.output import emit, progress, refuse_any, say
from jawusd.formats.atomic import refuse_existing

Solver = Literal["contour", "paper"]
Backend = Literal["cpu", "gl"]  # renderers of the paper's solver
SolverOption = Annotated[Solver, Option(help="Tracker; paper, for comparison, is slower and less accurate.")]
BackendOption = Annotated[Backend, Option(help="Renderer of --solver paper; gl needs OpenGL 4.3 (EGL).")]


def build(
    context: Context,
    capture: options.CaptureArg,
    out: Annotated[Path, Option("-o", "--out", help="Folder of the rig.")],
    model: Annotated[options.Method, Option(help="Form of the jaw model.")] = "anchored",
    solver: SolverOption = "contour",
    backend: BackendOption = "cpu",
    resume: Annotated[bool, Option("--resume", help="Continue an earlier build in this folder.")] = False,
    fresh: Annotated[bool, Option("--fresh", help="Delete an earlier build in this folder first.")] = False,
    dry_run: Annotated[
        bool, Option("--dry-run", help="List the stages that would run or be reused, with estimated times.")
    ] = False,
    jobs: options.Jobs = 2,
    prim_name: options.PrimName = None,
    verbose: Annotated[bool, Option("--verbose", "-v", help="Print the results of all stages.")] = False,
    allow_outside: options.Outside = False,
    as_json: options.Json = False,
) -> None:
    """Build a rig from a capture: calibrate if needed, sync, track, fit, track uncertain frames again, bake."""
    from jawusd.cli.text_build import build_lines, plan_lines
    from jawusd.pipeline import build as stages

    map_large_arrays()
    _check_backend(solver, backend)
    settings = stages.BuildOptions(
        model,
        solver,
        backend,
        jobs=jobs,
        resume=resume,
        fresh=fresh,
        allow_outside=allow_outside,
        prim_name=prim_name,
        command=command_line(context),
    )
    if dry_run:
        plan = stages.plan_build(capture, out, settings)
        emit({"stages": [asdict(stage) for stage in plan]}, as_json, plan_lines(plan))
        return
    with progress() as report:
        summary = stages.build(capture, out, settings, report, lambda found: say(found.line(), err=True))
    emit(summary, as_json, build_lines(summary, verbose))


def track(
    capture: options.CaptureArg,
    out: Annotated[Path, Option("-o", "--out", help="File of the tracks.")] = Path("tracks.npz"),
    solver: SolverOption = "contour",
    backend: BackendOption = "cpu",
    prior: Annotated[Path | None, Option(help="model.npz of this subject, as a prior for a second pass.")] = None,
    overlay: Annotated[
        Path | None,
        Option(help="Folder for videos of the tracked scans over the footage, or an .mp4 of all cameras side by side."),
    ] = None,
    jobs: options.Jobs = 2,
    force: options.Force = False,
    allow_outside: options.Outside = False,
    as_json: options.Json = False,
) -> None:
    """Track the teeth of both jaws in masks or, without masks, in the videos."""
    from jawusd.cli.text_build import track_lines
    from jawusd.formats.model import load_model
    from jawusd.pipeline import track as stage
    from jawusd.pipeline.pictures import overlay_files
    from jawusd.pipeline.workspace import open_capture

    _check_backend(solver, backend)
    refuse_any(force, out)
    model = load_model(prior) if prior else None
    opened = open_capture(capture, allow_outside=allow_outside)
    drawn = overlay_files(opened, overlay) if overlay else []
    refuse_any(force, *drawn)
    with progress() as report:
        tracks = stage.track(
            opened, out, solver=solver, backend=backend, model=model, overlay=overlay, jobs=jobs, progress=report
        )
    summary = stage.track_summary(tracks)
    found = {**summary, "file": str(out), "overlay": [str(path) for path in drawn]}
    emit(found, as_json, track_lines(summary))


def _check_backend(solver: Solver, backend: Backend) -> None:
    if backend == "gl" and solver != "paper":
        raise BadParameter("--backend gl needs --solver paper; the contour solver runs on the CPU.")


def fit(
    poses: Annotated[
        Path,
        Argument(help="tracks.npz, a CSV of poses, HDF5 of jaw-tracking-system, or with --rigid a table of markers."),
    ],
    capture: options.CaptureOption = None,
    upper_teeth: options.UpperOption = None,
    lower_teeth: options.LowerOption = None,
    mandible: options.MandibleOption = None,
    landmarks: options.LandmarksOption = None,
    columns: options.ColumnsOption = None,
    length_unit: options.UnitOption = "mm",
    invert: options.InvertOption = False,
    rest_frame: options.RestOption = None,
    group: options.GroupOption = None,
    rigid: options.RigidOption = None,
    out: Annotated[Path, Option("-o", "--out", help="File of the model.")] = Path("model.npz"),
    model: Annotated[options.Method, Option(help="Form of the jaw model.")] = "anchored",
    force: options.Force = False,
    allow_outside: options.Outside = False,
    as_json: options.Json = False,
) -> None:
    """Fit a three-parameter jaw model to tracks or other poses."""
    from jawusd.cli.text_build import fit_lines
    from jawusd.formats.model import save_model
    from jawusd.pipeline.fit import fit_subject, fit_summary, read_motion

    refuse_existing(out, force)
    motion, fps = read_motion(poses, options.trajectory_options(columns, length_unit, invert, rest_frame, group, rigid))
    subject = options.subject_given(poses.stem, capture, upper_teeth, lower_teeth, mandible, landmarks, allow_outside)
    with progress() as report, naming_file(poses):
        fitted = fit_subject(subject, motion, model, report, fps)
    save_model(out, fitted)
    summary = fit_summary(fitted)
    emit({**summary, "file": str(out)}, as_json, fit_lines(summary))


def bake(
    model: Annotated[Path, Argument(help="model.npz.")],
    out: Annotated[Path, Option("-o", "--out", help="Folder of the rig.")],
    capture: options.CaptureOption = None,
    upper_teeth: options.UpperOption = None,
    lower_teeth: options.LowerOption = None,
    mandible: options.MandibleOption = None,
    fps: Annotated[float, Option(min=0.001, help="Frames per second, for a subject without a capture.")] = 24.0,
    table: Annotated[int, Option(help="Knots per axis of the sampled decoder: 17, 33 or 65.")] = 33,
    prim_name: options.PrimName = None,
    force: options.Force = False,
    allow_outside: options.Outside = False,
    as_json: options.Json = False,
) -> None:
    """Write the OpenUSD rig of a model, with the meshes of a capture or loose scans."""
    from jawusd.formats.model import load_model
    from jawusd.pipeline.bake import bake_subject, check_same_jaw

    refuse_existing(out / "actor.usda", force)
    loaded = load_model(model)
    name = str(loaded.meta.get("actor") or model.stem)
    subject = options.subject_given(name, capture, upper_teeth, lower_teeth, mandible, None, allow_outside)
    check_same_jaw(subject, loaded)
    with progress() as report:
        files = bake_subject(subject, loaded, out, report, fps=fps, table_size=table, prim_name=prim_name)
    emit({"files": files}, as_json, [str(path) for path in files])


def demo(
    out: Annotated[Path, Option("-o", "--out", help="Folder of the capture.")],
    seed: Annotated[int, Option(min=0, help="Seed of the random subject.")] = 0,
    frames: Annotated[int, Option(min=24, max=20000, help="Number of exercise frames.")] = 240,
    force: options.Force = False,
) -> None:
    """Render a synthetic capture with ground truth: a random subject in front of three cameras.

    The default takes about 14 minutes without a GPU.
    """
    from jawusd.cli.text_build import rounded_duration

    with explain_missing_packages("demo"):
        from jawusd.synthetic.capture_writer import DemoConfig, write_demo

    refuse_existing(out / "capture.toml", force)
    config = DemoConfig(seed=seed, frames=frames)
    say(f"renders {config.images} images: about {rounded_duration(config.seconds)} without a GPU", err=True)
    with progress() as report:
        write_demo(out, config, progress=partial(report, "demo"))
    say(str(out / "capture.toml"))
    say(f"next: {shlex.join(['jawusd', 'build', str(out), '-o', f'{out}_rig'])}")


def build_many(
    context: Context,
    captures: Annotated[
        Path,
        Argument(metavar="LIST", help="Text file with one capture per line: PATH, or PATH, NAME of its output folder."),
    ],
    out: Annotated[Path, Option("-o", "--out", help="Parent folder of the rigs' folders.")],
    model: Annotated[options.Method, Option(help="Form of the jaw models.")] = "anchored",
    cluster: Annotated[
        str | None,
        Option(
            metavar="ADDRESS",
            help="Dask scheduler, such as tcp://host:8786; its workers need jawusd and the same paths. "
            "Default: local processes.",
        ),
    ] = None,
    workers: Annotated[
        int | None, Option(min=1, max=1024, help="Number of local processes. Default: one per core.")
    ] = None,
    retries: Annotated[int, Option(min=0, max=100, help="Number of retries after a local process dies.")] = 3,
    resume: Annotated[bool, Option("--resume", help="Continue earlier builds in this folder.")] = False,
    fresh: Annotated[bool, Option("--fresh", help="Delete earlier builds in this folder first.")] = False,
    jobs: Annotated[int, Option(min=1, max=64, help="Threads of each build.")] = 1,
    allow_outside: options.Outside = False,
    as_json: options.Json = False,
) -> None:
    """Build many captures, one process each; a failure does not stop the others. Exit code 1 if any failed."""
    from jawusd.cli.text_build import outcome_lines
    from jawusd.formats.capture_list import load_capture_list
    from jawusd.pipeline import many
    from jawusd.pipeline.build import BuildOptions

    if cluster is not None and workers is not None:
        raise BadParameter("--workers are local processes and cannot be combined with --cluster.")
    build = BuildOptions(
        model, jobs=jobs, resume=resume, fresh=fresh, allow_outside=allow_outside, command=command_line(context)
    )
    settings = many.ManyOptions(build, cluster, workers, retries)
    with stopped_by_signals():
        outcomes = many.build_many(load_capture_list(captures), out, settings, lambda line: say(line, err=True))
    data = {"folder": str(out), "builds": [asdict(outcome) for outcome in outcomes]}
    emit(data, as_json, outcome_lines(outcomes))
    if any(outcome.status == many.FAILED for outcome in outcomes):
        raise Exit(1)
