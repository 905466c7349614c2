"""Commands for a subject with a rig: solve a performance, or track live video."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from typer import Argument, BadParameter, Option

from jawusd.cli import options
from jawusd.cli.face_commands import Fps, RestFrame, Rigid
from jawusd.cli.output import emit, progress, refuse_any, say, shortened
from jawusd.formats.finding import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jawusd.pipeline.live import OscSender
    from jawusd.pipeline.live_jaw import LiveFrame
    from jawusd.pipeline.skin import SkinOptions
    from jawusd.pipeline.solve import SolveSummary
    from jawusd.viewer.server import Viewer


Head = Literal["free", "fixed"]  # motion relative to the cameras
Focal = Literal["known", "free"]  # calibrated or estimated
ShotArg = Annotated[Path, Argument(help="capture.toml of the shot, or its folder.")]
OverlayFile = Annotated[
    Path | None, Option(help="Video (.mp4) to write: the solved teeth over the images of all cameras.")
]
ReportFile = Annotated[
    Path | None,
    Option(help="Page (.html) to write: curves with expected errors, frames with hidden teeth, findings, images."),
]
SkinFile = Annotated[
    Path | None,
    Option(
        help="For frames with hidden teeth: map from facial skin to d, written by skin-fit, with --face; or the word "
        "footage, to follow skin in the videos and learn from the frames with visible teeth."
    ),
]
FaceFile = Annotated[
    Path | None, Option(help="Face data of the shot, as for skin-fit, with the points or columns of --skin.")
]
FaceOffset = Annotated[
    float | None,
    Option(help="Time from frame 0 of the shot to frame 0 of the face [s]. Default: estimated from visible teeth."),
]
LiveFaceFile = Annotated[
    Path | None,
    Option(
        help="Live face data with the points or columns of --skin: - (standard input), a pipe or a growing CSV. "
        "For recorded cameras, a recording as for skin-fit."
    ),
]
LiveFaceOffset = Annotated[
    float,
    Option(
        help="Time to add to the times of the face [s]: negative if the face arrives later than the images. For a "
        "recording, the time from the first images to frame 0 of the face."
    ),
]
SkinOnly = Annotated[bool, Option("--skin-only", help="Ignore the images: no frame of the shot shows the teeth.")]


def solve(
    rig: options.RigArg,
    shot: ShotArg,
    out: Annotated[
        Path, Option("-o", "--out", help="Table of d (.csv), tracks (.npz) or animation layer (.usdc).")
    ] = Path("take.csv"),
    overlay: OverlayFile = None,
    report: ReportFile = None,
    head: Annotated[Head, Option(help="fixed: the cameras are head-mounted.")] = "free",
    focal: Annotated[Focal, Option(help="free: estimate focal lengths from the take.")] = "known",
    skin: SkinFile = None,
    face: FaceFile = None,
    face_fps: Fps = None,
    offset: FaceOffset = None,
    rigid: Rigid = None,
    rest_frame: RestFrame = None,
    length_unit: options.UnitOption = "mm",
    skin_only: SkinOnly = False,
    jobs: options.Jobs = 2,
    force: options.Force = False,
    allow_outside: options.Outside = False,
    prim: options.Prim = None,
    allow: options.Allow = None,
    as_json: options.Json = False,
) -> None:
    """Track a performance of a subject with a rig, from masks or, without masks, videos of one or more cameras."""
    from jawusd.pipeline import solve as stage

    given: SkinOptions | Literal["footage"] | None
    if skin == Path("footage") and face is None and not skin_only:
        given = "footage"
    else:
        given = _skin_options(skin, face, face_fps, offset, rigid, rest_frame, length_unit, skin_only)
    stage.check_output(rig, out, overlay, report)
    written = [path for path in (out, overlay, report) if path is not None]
    refuse_any(force, *written)
    with progress() as tell:
        found = stage.solve(
            rig,
            shot,
            out,
            prim=prim,
            overlay=overlay,
            report=report,
            fixed_head=head == "fixed",
            free_focal=focal == "free",
            jobs=jobs,
            allow_outside=allow_outside,
            skin=given,
            progress=tell,
        )
    summary = stage.solve_summary(found)
    files = [str(path) for path in written]
    emit({**summary, "file": str(out), "files": files}, as_json, [*files, *solve_lines(summary)])


def _skin_options(
    skin: Path | None,
    face: Path | None,
    fps: float | None,
    offset_s: float | None,
    rigid: list[str] | None,
    rest_frame: int | None,
    unit: options.LengthUnit,
    only: bool = False,
) -> SkinOptions | None:
    """Return the options about facial skin; None without it."""
    from jawusd.pipeline.skin import SkinOptions

    if skin is not None and face is not None:
        return SkinOptions(skin, face, fps, offset_s, unit, options.rigid_bodies(rigid), rest_frame, only)
    if skin is not None or face is not None or only:
        raise BadParameter("needs both --skin and --face.", param_hint="--skin")
    return None


_LISTED_RUNS = 20


def solve_lines(summary: SolveSummary) -> list[str]:
    """Return `solve_summary` as text."""
    seen_by = ", ".join(summary["cameras"]) or "no camera"
    lines = [f"solved {summary['solved']} of {summary['frames']} frames with {seen_by}"]
    if "skin_learned" in summary:
        learned = summary["skin_learned"]
        errors = learned["errors_mm"]
        lines.append(
            f"  learned from {learned['points']} points on the skin in {learned['frames']} frames with visible teeth; "
            f"held-out error {errors['skin']:.2f} mm, chin rigid with the bone {errors['chin']:.2f} mm"
        )
    if "skin_offset_s" in summary:
        lines.append(f"  the face starts {summary['skin_offset_s']:.3f} s after frame 0 of the shot")
    for word, runs in (
        ("estimated from facial skin", summary["skin"]),
        ("  with an unfamiliar face, so that sigma is a rough guess", summary.get("unfamiliar", [])),
        ("interpolated from the motion around", summary["carried"]),
        ("lost", summary["lost"]),
    ):
        if runs:
            listed = shortened([f"{a}" if a == b else f"{a}-{b}" for a, b in runs], _LISTED_RUNS, "more runs")
            lines.append(f"  {word}: {sum(b - a + 1 for a, b in runs)} frames ({listed})")
    if summary["within_tolerance"]:
        lines.append(f"  outside the rig's bound, within its tolerance: {summary['within_tolerance']} frames")
    if summary["outside"]:
        lines.append(f"  outside the rig's bound: {summary['outside']} frames")
    sigma = ", ".join(f"{name} {value:.3f}" for name, value in summary["sigma_mm"].items())
    lines.append(f"  expected error (1 sigma, median) [mm]: {sigma}")
    worst = ", ".join(f"{name} {value:.2f}" for name, value in summary["worst_sigma_mm"].items())
    lines.append(f"  largest: {worst}")
    for name, (factor, sigma_factor) in summary.get("focal", {}).items():
        lines.append(f"  focal length of {name}: {factor:.4f} times the calibrated one (+-{sigma_factor:.4f})")
    lines.append(f"  limited by {summary['limits']}")
    return [*lines, *(f"  {Finding.from_json(found).line()}" for found in summary.get("findings", []))]


def live(
    rig: options.RigArg,
    shot: ShotArg,
    source: Annotated[
        list[str] | None,
        Option(
            metavar="NAME=SOURCE",
            help="Source of a camera: NAME=/dev/video0, NAME=rtsp://..., NAME=FILE. Cameras without a source are not "
            "used; without any source, the shot's videos are played in real time.",
        ),
    ] = None,
    osc: Annotated[str | None, Option(metavar="HOST:PORT", help="OSC messages: /jaw/d, /jaw/sigma, ...")] = None,
    view: Annotated[bool, Option("--view", help="Also show the jaw in a page on this machine.")] = False,
    port: Annotated[int, Option(min=0, max=65535, help="Port of the page, or the next free port.")] = 8080,
    head: Annotated[Head, Option(help="fixed: the cameras are head-mounted.")] = "free",
    seconds: Annotated[float | None, Option(min=0.1, help="Stop after this time [s].")] = None,
    skin: SkinFile = None,
    face: LiveFaceFile = None,
    face_fps: Fps = None,
    offset: LiveFaceOffset = 0.0,
    rigid: Rigid = None,
    rest_frame: RestFrame = None,
    length_unit: options.UnitOption = "mm",
    silence: Annotated[float, Option(min=0.1, help="Maximum time without an image from a source [s].")] = 10.0,
    jobs: options.Jobs = 2,
    allow_outside: options.Outside = False,
    prim: options.Prim = None,
    allow: options.Allow = None,
) -> None:
    """Track the jaw of a subject with a rig in live video; results are one line of JSON per frame, OSC, and a web page.

    Frames are dropped if images arrive faster than they are tracked; every line contains the latency. With --skin and
    --face, frames with hidden teeth are estimated from facial skin.
    """
    from jawusd.pipeline.live import OscSender
    from jawusd.pipeline.live import live as follow
    from jawusd.pipeline.view import open_viewer

    given = _skin_options(skin, face, face_fps, offset, rigid, rest_frame, length_unit)
    sources = options.named_values(source, "NAME=WHERE, such as mid=/dev/video0", "--source")
    sender = None if osc is None else OscSender(osc)
    viewer = open_viewer(rig, "127.0.0.1", port, prim, play=False) if view else None
    if viewer is not None:
        say(f"{viewer.url}  (Ctrl+C stops)", err=True)
    results = follow(
        rig,
        shot,
        sources,
        prim=prim,
        fixed_head=head == "fixed",
        jobs=jobs,
        seconds=seconds,
        silence_s=silence,
        allow_outside=allow_outside,
        skin=given,
    )
    _show(results, sender, viewer)


def _show(results: Iterator[LiveFrame], sender: OscSender | None, viewer: Viewer | None) -> None:
    """Print and send live results as they come, until they end or the user stops the command."""
    try:
        for found in results:
            if sender is not None:
                sender.send(found)
            if viewer is not None:
                viewer.show(found.d)
            say(json.dumps(found.as_json()))
    except KeyboardInterrupt:
        pass
    finally:
        if sender is not None:
            sender.close()
        if viewer is not None:
            viewer.stop()
