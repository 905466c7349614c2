"""Write the report of a solved performance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jawusd.base.errors import AnyPath, FormatError, OutputError, explain_missing_packages, naming_file
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.capture import Capture
from jawusd.formats.performance import SolveState
from jawusd.formats.report import Overlay, SolveReportData
from jawusd.formats.tracks import Tracks, load_tracks
from jawusd.pipeline.calibrate import sync_cameras
from jawusd.pipeline.cameras import check_same_cameras
from jawusd.pipeline.pictures import draw_frames, worst_and_usual
from jawusd.pipeline.report import attempt, camera_facts
from jawusd.pipeline.state import Progress, make_folder, package_versions
from jawusd.pipeline.workspace import open_capture

PAGE = ".html"
_MOST_UNSEEN, _MOST_UNCERTAIN, _MOST_OUTSIDE = 3, 2, 2  # number of frames drawn for each reason


@explain_missing_packages()
def check_page(path: AnyPath) -> None:
    """Raise OutputError unless a file name ends in .html, and MissingDependencyError if packages are missing."""
    import jawusd.report.solve_page  # noqa: F401

    if Path(path).suffix.lower() != PAGE:
        raise OutputError("the report must be an HTML file.", path=path, hint=f"Give a file name ending in {PAGE}.")


def report_solve(
    tracks: Path, capture: AnyPath | None, page: Path, progress: Progress, *, allow_outside: bool = False
) -> Path:
    """Write the report of a solve from the .npz file of its tracks; return the path of the page.

    Without the capture of the shot, the report has no images and no cameras. Raises FormatError if the tracks were not
    written by `solve`, CaptureError or SyncError if the shot cannot be read, and OutputError.
    """
    check_page(page)
    with naming_file(tracks):
        found = load_tracks(tracks)
        if found.solved is None:
            raise FormatError(
                "contains tracks that do not come from a solve.",
                hint="Give the .npz that `jawusd solve` wrote, or the folder of a build.",
            )
        shot, offsets = None, {}
        if capture is not None:
            shot = open_capture(capture, allow_outside=allow_outside)
            check_same_cameras(shot, found)
            offsets = sync_cameras(shot, progress)["offsets"]
        write_solve_report(page, found, shot, offsets, progress, tracks.stem)
    return page


@explain_missing_packages()
def write_solve_report(
    page: AnyPath,
    tracks: Tracks,
    capture: Capture | None,
    offsets: Mapping[str, int],
    progress: Progress,
    name: str = "",
) -> None:
    """Write the report of a solve; `name` is the name of a shot without a capture.

    Raises FormatError without any frame rate, MissingDependencyError, and OutputError.
    """
    from jawusd.report.solve_page import solve_page

    progress("report", 0, 2)
    left_out: list[str] = []
    overlays: tuple[Overlay, ...] | None = None
    if not tracks.camera_names:
        left_out.append("images: the pose of the head is unknown, since d is from skin alone.")
    elif capture is None:
        left_out.append("images and cameras: no shot was given (--capture).")
    else:
        shot = capture
        chosen = frames_to_show(tracks, shot.fps)
        overlays = attempt("pictures", left_out, lambda: draw_frames(shot, offsets, tracks, chosen))
    progress("report", 1, 2)
    data = SolveReportData(
        shot=name if capture is None else capture.name,
        tracks=tracks,
        fps=_rate(tracks) if capture is None else capture.fps,
        limits=solve_limits(tracks.camera_names),
        cameras=() if capture is None else camera_facts(capture),
        overlays=overlays or (),
        versions=package_versions(),
        left_out=tuple(left_out),
    )
    make_folder(Path(page).resolve().parent)
    write_text_atomic(page, solve_page(data))
    progress("report", 2, 2)


def _rate(tracks: Tracks) -> float:
    rate = tracks.meta.get("fps")
    if not isinstance(rate, float) or not 0 < rate < math.inf:
        raise FormatError("contains no frame rate.", hint="Give its capture with --capture.")
    return rate


def frames_to_show(tracks: Tracks, fps: float) -> list[tuple[int, str]]:
    """Return the frames of a solve to inspect, each as its row in the tracks and the reason; raises ValueError."""
    solved = tracks.solved
    if solved is None:
        raise ValueError("the tracks have no solved performance")
    sigma, seen = solved.sigma_mm.max(axis=1), solved.state == SolveState.SOLVED
    worst = (
        (solved.state == SolveState.LOST, sigma, _MOST_UNSEEN, "lost, expected error up to {:.2f} mm"),
        (solved.state == SolveState.CARRIED, sigma, _MOST_UNSEEN, "occluded, expected error up to {:.2f} mm"),
        (solved.state == SolveState.SKIN, sigma, _MOST_UNSEEN, "estimated from skin, expected error up to {:.2f} mm"),
        (~solved.valid, -solved.margin_mm, _MOST_OUTSIDE, "{:.2f} mm outside the rig's bound, more than its tolerance"),
        (seen, sigma, _MOST_UNCERTAIN, "solved, with one of the largest expected errors, {:.2f} mm"),
    )
    rows = [(np.where(has, badness, np.nan), most, words) for has, badness, most, words in worst]
    usual = np.where(seen, sigma, np.nan), "a typical frame, expected error {:.2f} mm"
    return worst_and_usual(tracks, fps, rows, usual)


def solve_limits(cameras: Sequence[str]) -> str:
    """Return a phrase that names what limits the accuracy of a solve from these cameras."""
    if not cameras:
        return "the skin: it does not follow the bone exactly"
    if len(cameras) == 1:
        return "a single camera: errors are largest along its line of sight"
    return "the rig: its error at the condyles exceeds that of the outlines"
