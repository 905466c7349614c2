"""Commands on a finished build: its report, the paper's experiments, and the viewer."""

from __future__ import annotations

import contextlib
import signal
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, BadParameter, Option

from jawusd.base.errors import naming_file
from jawusd.base.guard import map_large_arrays
from jawusd.cli import options
from jawusd.cli.output import emit, progress, refuse_any, say
from jawusd.formats.atomic import refuse_existing

if TYPE_CHECKING:
    from jawusd.formats.experiments import Experiments


def report(
    source: Annotated[
        Path,
        Argument(help="Folder of a build, tracks.npz of a solve, or (for experiments) tracks.npz, CSV or HDF5 poses."),
    ],
    experiments: Annotated[
        bool, Option("--experiments", help="Run the paper's experiments (figs. 5, 12, 13) and plot the coverage.")
    ] = False,
    out: Annotated[
        Path | None,
        Option(
            "-o",
            "--out",
            help="Folder of the figures, or page of a solve. Default: DIR/experiments, or beside the tracks.",
        ),
    ] = None,
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
    starts: Annotated[int, Option(min=1, max=64, help="Number of random starts of the paper's networks.")] = 2,
    force: Annotated[bool, Option("--force", help="Overwrite existing figures, or the page of a solve.")] = False,
    allow_outside: options.Outside = False,
    as_json: options.Json = False,
) -> None:
    """Write the report of a build or a solve again, or repeat the paper's experiments on a take."""
    settings = options.trajectory_options(columns, length_unit, invert, rest_frame, group, rigid)
    if not experiments:
        _report_found(source, capture, out, force, allow_outside, as_json)
        return
    if out is None and not source.is_dir():
        raise BadParameter("give the folder for the figures with -o.", param_hint="--out")
    from jawusd.pipeline import report as stage
    from jawusd.pipeline.fit import read_motion
    from jawusd.pipeline.subject import subject_of_build

    folder = out or source / "experiments"
    refuse_any(force, *stage.experiment_files(folder))
    poses = stage.fitted_poses(source) if source.is_dir() else source
    motion, _ = read_motion(poses, settings)
    given = (capture, upper_teeth, lower_teeth, mandible, landmarks)
    built = source.is_dir() and not any(given)
    subject = subject_of_build(source) if built else options.subject_given(source.stem, *given, allow_outside)
    with progress() as tell, naming_file(poses):
        found = stage.run_paper_experiments(subject, motion, starts, tell)
        files = stage.draw_experiments(found, folder)
        if stage.is_build(source):
            files.append(stage.report_build(source, capture, tell, found, allow_outside=allow_outside))
    _emit_experiments(found, files, as_json)


def _emit_experiments(found: Experiments, files: list[Path], as_json: bool) -> None:
    summary = {
        "actor": found.actor,
        "frames": found.frames,
        "table": found.table(),
        "coverage": list(found.coverage.sentences),
        "notes": list(found.notes),
        "files": files,
    }
    emit(summary, as_json, [*experiment_lines(found), *map(str, files)])


def _report_found(
    source: Path, capture: Path | None, out: Path | None, force: bool, allow_outside: bool, as_json: bool
) -> None:
    from jawusd.pipeline.report import report_build
    from jawusd.pipeline.solve_report import check_page, report_solve

    if source.suffix == ".npz":
        page = out or source.with_suffix(".html")
        check_page(page)
        refuse_existing(page, force)
        with progress() as tell:
            path = report_solve(source, capture, page, tell, allow_outside=allow_outside)
    elif source.is_dir():
        map_large_arrays()
        with progress() as tell:
            path = report_build(source, capture, tell, allow_outside=allow_outside)
    else:
        raise BadParameter(
            "no report is available for a pose file; add --experiments to run the paper's experiments on it."
        )
    emit({"file": str(path), "bytes": path.stat().st_size}, as_json, [str(path)])


PageOption = Annotated[
    Path | None, Option(help="Write a web page that poses the rig without a server, and exit.", metavar="FILE.html")
]


def view(
    rig: Annotated[
        Path | None,
        Argument(
            help="A rig (actor.usda, another layer of it, or its folder) or a capture (capture.toml or its folder). "
            "Default: the example rig that ships with jawusd.",
            metavar="RIG|CAPTURE",
        ),
    ] = None,
    tracks: Annotated[
        Path | None, Option(help="Poses to draw over the footage of a capture: the folder of its build, or tracks.npz.")
    ] = None,
    host: Annotated[
        str, Option(help="Address to listen on; the default accepts connections only from this machine.")
    ] = ("127.0.0.1"),
    port: Annotated[int, Option(min=0, max=65535, help="Port; if it is in use, the next free port.")] = 8080,
    browser: Annotated[bool, Option("--browser/--no-browser", help="Open a browser.")] = True,
    play: Annotated[
        bool, Option("--play/--no-play", help="Begin by playing the captured take of a rig, if it has one.")
    ] = True,
    page: PageOption = None,
    footage: Annotated[bool, Option("--footage", help="Also write the footage of the take into --page.")] = False,
    force: options.Force = False,
    allow_outside: options.Outside = False,
    prim: options.Prim = None,
    allow: options.Allow = None,
) -> None:
    """View and animate a rig in the browser; or view the footage of a capture, to inspect poses and set picks."""
    capture = False
    if rig is not None:
        from jawusd.pipeline.view import is_capture

        capture = is_capture(rig)
    options.refuse_conflicts(
        (tracks is not None and not capture, None, "--tracks needs a capture, not a rig."),
        (prim is not None and capture, None, "--prim needs a rig, not a capture."),
        (footage and page is None, None, "--footage needs --page; the viewer always shows footage."),
        (page is not None and capture, None, "--page needs a rig, not a capture."),
    )
    if page is not None:
        from jawusd.pipeline.view import write_page

        refuse_existing(page, force)
        write_page(rig, page, prim, footage=footage)
        say(f"{page}  ({page.stat().st_size / 1e6:.1f} MB; opens in any browser)")
        return
    _warn_of_host(host, capture)
    for folder in (rig, tracks):
        if folder is not None and folder.is_dir():
            _name_changed_files(folder)
    if rig is not None and capture:
        _serve_capture(rig, tracks, host, port, browser, allow_outside)
    else:
        _serve_rig(rig, host, port, prim, browser, play)


def _name_changed_files(folder: Path) -> None:
    from jawusd.pipeline.state import changed_files

    for found in changed_files(folder):
        say(found.line(), err=True)


def _serve_capture(
    capture: Path, tracks: Path | None, host: str, port: int, browser: bool, allow_outside: bool
) -> None:
    from jawusd.pipeline.view_capture import viewed_capture
    from jawusd.viewer.capture_page import CaptureViewer

    with progress() as report:
        viewer = CaptureViewer(viewed_capture(capture, tracks, report, allow_outside=allow_outside), host, port)
    try:
        _announce(browser, viewer.url)
        viewer.wait()
    except KeyboardInterrupt:
        viewer.stop()


def _serve_rig(rig: Path | None, host: str, port: int, prim: str | None, browser: bool, play: bool) -> None:
    """Serve the page of a rig, or of the example rig, whose address is announced before the rig is read."""
    from jawusd.viewer.address import FirstPage

    viewer = None
    try:
        with _interrupts_held():
            first = FirstPage(host, port) if rig is None else None
            if first is not None:
                _announce(browser, first.url)
            from jawusd.pipeline.view import open_viewer  # takes a second, while the browser loads the page

            viewer = open_viewer(rig, host, port, prim, play=play, first=first)
        if first is None:
            _announce(browser, viewer.url)
        viewer.wait()
    except KeyboardInterrupt:
        if viewer is not None:
            viewer.stop()


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Raise KeyboardInterrupt for Ctrl+C only at the end of the block: OpenUSD discards it while it is imported."""
    held: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: held.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if held:
        raise KeyboardInterrupt


def _announce(browser: bool, url: str) -> None:
    """Print the address of a page; open it in a browser if `browser` is true."""
    say(f"{url}  (Ctrl+C stops)")
    if browser:
        webbrowser.open(url)


def _warn_of_host(host: str, capture: bool) -> None:
    """Warn if the viewer's address can be reached from other machines."""
    from jawusd.viewer.address import is_loopback

    if not is_loopback(host):
        may = "write picks into the capture" if capture else "write animations beside the rig"
        say(
            f"jawusd: warning: listening on {host}: anyone who reaches this address can see this subject's jaw without "
            f"a password, and {may}. `ssh -L 8080:localhost:8080` works without --host.",
            err=True,
        )


def experiment_lines(found: Experiments) -> list[str]:
    """Return the results of the experiments as text."""
    heads = ("mean", "median", "p95", "max")
    lines = [f"{found.actor}: {found.frames} captured poses; distances [mm]"]
    lines.append(f"{'experiment':<16}{'model':<30}{'quantity':<32}{'count':>6}" + "".join(f"{h:>9}" for h in heads))
    for row in found.table():
        figures = "".join(f"{row[f'{head}_mm']:9.3f}" for head in heads)
        lines.append(f"{row['experiment']:<16}{row['model']:<30}{row['quantity']:<32}{row['count']:>6}{figures}")
    lines += [f"note: {note}" for note in found.notes]
    return lines + [f"coverage: {sentence}" for sentence in found.coverage.sentences or ["no exercise is missing."]]
