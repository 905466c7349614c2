"""The first tracked frame and its poses: from picks, or from a search over frames."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.formats.capture import Bootstrap, Capture
from jawusd.formats.finding import Finding
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera, transform_point
from jawusd.tracking.config import Mapper
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import masked_sources
from jawusd.tracking.initialization.bootstrap import SIZE_HINT, picked_sigma_mm, pose_from_picks
from jawusd.tracking.initialization.first_frame import CLEAR_FIT, EXPLAINS
from jawusd.tracking.initialization.footage import Footage
from jawusd.tracking.initialization.scan_checks import check_occlusion
from jawusd.tracking.initialization.start_causes import (
    MOST_PICTURES,
    aligned,
    all_arches_exchanged,
    likely_exchange,
    raise_cause,
)
from jawusd.tracking.initialization.start_search import SearchResult, StartSearch

#: Number of frames surveyed: the survey takes two seconds, and covers every jaw exercise of a usual take.
SURVEYED = 24
#: Maximum number of frames on which the teeth are searched for.
FRAMES_TRIED = 5


@dataclass(frozen=True, eq=False)
class Start:
    """The first tracked frame and its poses."""

    frame: int  # frame number of the reference camera
    poses: Array  # T_world_upper, T_world_lower, shape (2, 4, 4)
    notes: dict[str, object]  # how the start was found, for the metadata of the tracks
    findings: tuple[Finding, ...] = ()  # findings about scans and picks
    T_anatomical_scan: Array = field(default_factory=lambda: np.eye(4))  # from the scan frame to (left, up, front) axes


def search_start(search: StartSearch, footage: Footage, suspects: Collection[str] = (), explain: bool = True) -> Start:
    """Find a frame on which both arches can be aligned, and their poses.

    The first frame with a clear fit is used, otherwise the frame with the best fit. If neither arch fits acceptably
    there, but both fit clearly once a mistake is corrected, that mistake is reported as an error.

    Args:
        suspects: hints of the mistakes that the scans suggest; a mistake is identified by its hint.
        explain: whether to look for a mistake if no frame fits, which takes several times as long.

    Raises:
        TrackingError: none of the frames tried could be aligned; the message gives the reason for each frame, or the
            mistake whose correction makes the search succeed.
    """
    most = max(1, min(FRAMES_TRIED, MOST_PICTURES // len(footage.sources)))
    frames = footage.survey(None, SURVEYED).promising(most).tolist()
    failed: dict[int, str] = {}
    suspected = set(suspects)
    best: tuple[int, SearchResult] | None = None
    fits: dict[int, Array] = {}
    for frame in frames:
        try:
            found = search.at(footage, frame)
            fits[frame] = found.fits
            # If most masks are correct, so are the poses, which then reveal the wrong masks. Poor poses are no evidence
            # against masks.
            exchange = likely_exchange(footage, search.solver, found.poses, frame)
            if exchange is None:
                found = replace(found, poses=aligned(search, footage, found.poses, frame))
        except TrackingError as error:
            failed[frame] = error.message
            continue
        if exchange is not None:
            if found.fit >= CLEAR_FIT:
                raise exchange.error(frame)
            failed[frame] = exchange.message
            suspected.add(exchange.hint)
            continue
        if best is None or found.fit > best[1].fit:
            best = frame, found
        if found.fit >= CLEAR_FIT:
            break
    if best is None:
        tried = raise_cause(search, footage, frames, fits, suspected) if explain else ""
        raise TrackingError(
            f"there are no [bootstrap] picks, and the search for the teeth failed on all {len(frames)} frames tried. "
            + " ".join([*(f"Frame {frame}: {message}." for frame, message in failed.items()), tried]),
            hint="Add [bootstrap] picks, at least three per arch, each in two cameras; and check the masks, the "
            "calibration and the time offsets.",
        )
    frame, found = best
    if explain and found.fits.max() < EXPLAINS:
        raise_cause(search, footage, [frame], {}, suspected, only_clear=True)
    _check_upright(search, footage, frame, found)
    notes = {"by": "search", "frame": frame, "worth_px": found.objective_px, "fit": found.fit}
    return Start(frame, found.poses, {**notes, "failed": {str(f): m for f, m in failed.items()}})


def search_near(search: StartSearch, footage: Footage, frame: int, poses: Array) -> SearchResult:
    """Search near given poses, and everywhere if none of them fits clearly.

    Raises TrackingError if no pair of poses is anatomically possible.
    """
    near = search.near(footage, frame, poses)
    if near.fit >= CLEAR_FIT:
        return near
    try:
        anywhere = search.at(footage, frame)
    except TrackingError:
        return near
    return max(near, anywhere, key=lambda found: found.objective_px)


def fit_without_a_camera(
    search: StartSearch, footage: Footage, frame: int, poses: Array, found: SearchResult
) -> tuple[str, SearchResult] | None:
    """Return a camera whose masks contradict the others, which fit clearly without it, and their poses, or None."""
    if len(footage.sources) < 3 or _fits(search, footage, found.poses, frame):
        return None
    better = []
    for name, others in footage.without_each_camera():
        with contextlib.suppress(TrackingError):
            near = search.near(others, frame, poses)
            if near.fit >= CLEAR_FIT:
                aligned(search, others, near.poses, frame)
                better.append((name, near))
    return max(better, key=lambda one: one[1].fit, default=None)


def _check_upright(search: StartSearch, footage: Footage, frame: int, found: SearchResult) -> None:
    """Reject masks that fit better with the arches swapped: an upside-down upper arch resembles a lower one."""
    exchange = all_arches_exchanged(footage)
    try:
        other = search.at(exchange.footage, frame)
    except TrackingError:
        return
    if other.objective_px > found.objective_px:
        evidence = f"{other.objective_px:.0f} px of contour match after exchanging them, "
        evidence += f"{found.objective_px:.0f} px as given"
        raise replace(exchange, message=f"{exchange.message}: {evidence}").error(frame)


_PICKS_OFF_MM = 3.0  # minimum distance between picked and found poses for a warning [mm]: half a tooth
_SURE_MM = 0.8  # maximum uncertainty of picked poses for the contour solver to converge from them [mm]


def find_start(
    capture: Capture,
    cameras: Mapping[str, Camera],
    offsets: Mapping[str, int],
    meshes: Sequence[Mesh],
    solver: ContourSolver,
    map_: Mapper = map,
) -> Start:
    """Return the first frame and its poses, from the capture's picks or, without picks, by search.

    Args:
        offsets: as in `Footage`.
        meshes, solver: upper and lower scan in one frame, in occlusion [mm], and a solver prepared with them.
        map_: distributes the search among threads.

    Raises:
        TrackingError: invalid picks, scans that do not belong together, swapped masks, or no frame on which the teeth
            were found.
        CaptureError: a mask cannot be read.
    """
    footage = Footage(masked_sources(capture.cameras, cameras, offsets), cameras, offsets, capture.frames)
    T_anatomical_scan, findings = check_occlusion(solver.scans, capture.anatomy.T_anatomical_skull)
    search = StartSearch(meshes, solver, T_anatomical_scan, map_)
    with quote_findings(findings):
        if capture.bootstrap is not None:
            start = _picked(capture.bootstrap, capture.frames, footage, meshes, search)
        else:
            suspects = {SIZE_HINT} if any(finding.kind == "scan_size" for finding in findings) else set()
            start = search_start(search, footage, suspects)
    return replace(start, findings=(*start.findings, *findings), T_anatomical_scan=T_anatomical_scan)


@contextlib.contextmanager
def quote_findings(findings: Sequence[Finding]) -> Iterator[None]:
    """Append findings, which may be the cause, to the hint of a TrackingError raised inside the context."""
    try:
        yield
    except TrackingError as error:
        if not findings:
            raise
        hint = " ".join([*([error.hint] if error.hint else []), *(finding.line() for finding in findings)])
        raise TrackingError(
            error.message, path=error.path, camera=error.camera, frame=error.frame, hint=hint
        ) from error


def _picked(
    bootstrap: Bootstrap, frames: tuple[int, int] | None, footage: Footage, meshes: Sequence[Mesh], search: StartSearch
) -> Start:
    """Return the poses from the picks; if the picks are uncertain, refine them by a search nearby."""
    first, stop = frames or (0, bootstrap.frame + 1)
    if not first <= bootstrap.frame < stop:
        raise TrackingError(f"bootstrap.frame is {bootstrap.frame}; frames run from {first} to {stop - 1}")
    poses, left_out, sigma_mm = [], {}, {}
    for scan, mesh, picks in zip(search.solver.scans, meshes, (bootstrap.upper, bootstrap.lower), strict=True):
        pose, wrong = pose_from_picks(picks, mesh.vertices, footage.cameras, scan.name)
        poses.append(pose)
        left_out[scan.name] = wrong
        good = [pick for k, pick in enumerate(picks, start=1) if k not in wrong]
        sigma_mm[scan.name] = picked_sigma_mm(good, mesh.vertices, footage.cameras, pose, scan.probes)
    notes: dict[str, object] = {"by": "picks", "frame": bootstrap.frame}
    notes |= {"picks_left_out": left_out, "picks_sigma_mm": sigma_mm}
    start = Start(bootstrap.frame, np.stack(poses), notes)
    if (exchange := likely_exchange(footage, search.solver, start.poses, start.frame)) is not None:
        raise exchange.error(start.frame)
    if not footage.has_masks(start.frame):
        return _elsewhere(search, footage, start, "the frame of the picks lacks masks of both arches in two cameras")
    if max(sigma_mm.values()) <= _SURE_MM and _fits(search, footage, start.poses, start.frame):
        return start
    try:
        found = search_near(search, footage, start.frame, start.poses)
    except TrackingError:
        fits = _fits(search, footage, start.poses, start.frame)
        return start if fits else _elsewhere(search, footage, start)
    if (without := fit_without_a_camera(search, footage, start.frame, start.poses, found)) is not None:
        notes["camera_left_out"], found = without
    searched = {"by": "picks, then search", "worth_px": found.objective_px, "fit": found.fit}
    near = Start(start.frame, found.poses, notes | searched, _picks_off(search, start, found.poses, sigma_mm))
    if "camera_left_out" in notes or _fits(search, footage, near.poses, near.frame):
        return near
    # The search may end in a wrong local minimum although the picks were nearly accurate enough.
    fits = _fits(search, footage, start.poses, start.frame)
    return start if fits else _elsewhere(search, footage, start)


def _picks_off(search: StartSearch, start: Start, poses: Array, sigma_mm: Mapping[str, float]) -> tuple[Finding, ...]:
    """Return warnings for arches that the search found far from their picks, although the picks are accurate."""
    out = []
    for scan, picked, found in zip(search.solver.scans, start.poses, poses, strict=True):
        off = float(np.linalg.norm(transform_point(found, scan.centre) - transform_point(picked, scan.centre)))
        if off > max(_PICKS_OFF_MM, 4.0 * sigma_mm[scan.name]):
            message = f"the picks of the {scan.name} teeth are {off:.1f} mm from their position according to the masks"
            hint = "The pose from the masks was used. Check the picked vertices and pixels."
            limit = _PICKS_OFF_MM
            out.append(Finding("picks_off", "warning", message, round(off, 2), limit, frame=start.frame, hint=hint))
    return tuple(out)


def _elsewhere(
    search: StartSearch, footage: Footage, start: Start, reason: str = "the picks do not fit the masks of their frame"
) -> Start:
    """Return a start on another frame that fits; without one, the given start, which then fails with its own error."""
    other = _near_on_another_frame(search, footage, start)
    if other is None:
        try:
            other = search_start(search, footage, explain=False)
        except TrackingError:
            return start
    message = f"{reason}; the teeth were found on frame {other.frame}"
    unused = Finding(
        "picks_unused", "warning", message, frame=start.frame, hint="Pick on a frame that shows both arches well."
    )
    return replace(other, findings=(unused,))


def _near_on_another_frame(search: StartSearch, footage: Footage, start: Start) -> Start | None:
    """Return the start on the first frame that fits clearly near the picked poses, since heads and jaws move little."""
    try:
        frames = footage.survey(None, SURVEYED).promising(FRAMES_TRIED).tolist()
    except TrackingError:
        return None
    for frame in frames:
        with contextlib.suppress(TrackingError):
            found = search.near(footage, frame, start.poses)
            if found.fit >= CLEAR_FIT:
                poses = aligned(search, footage, found.poses, frame)
                notes = {"by": "picks, then search on another frame", "frame": frame, "fit": found.fit}
                return Start(frame, poses, {**start.notes, **notes})
    return None


def _fits(search: StartSearch, footage: Footage, poses: Array, frame: int) -> bool:
    """Return whether poses pass the checks of a first frame; with hidden teeth, they may be a wrong local minimum."""
    try:
        aligned(search, footage, poses, frame)
    except TrackingError:
        return False
    return True
