"""Why a take has no start: exchanged masks, and other mistakes in scans or calibration, each tested by undoing it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import CaptureError, TrackingError
from jawusd.formats.capture_parts import CameraSource, Masks
from jawusd.tracking.contour.quality import coverage_error, uncovered_px
from jawusd.tracking.contour.scan import ARCH_NAMES, teeth_centre
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.initialization.first_frame import first_record
from jawusd.tracking.initialization.footage import Footage
from jawusd.tracking.initialization.start_search import StartSearch

# An exchange is believed if it leaves less than this share of what is uncovered as the masks are named.
_PROOF = 0.5
# Uncovered share of all masks of a camera from which an exchange is looked for: good poses leave 0.01, and two cameras'
# masks may resemble one another up to 0.1.
_ODD_SHARE = 0.05


@dataclass(frozen=True, eq=False)
class Mixup:
    """Hold one way in which masks may have been exchanged."""

    finding: str  # what is wrong, to follow "frame F: "
    hint: str  # what to do
    sources: tuple[CameraSource, ...]  # the cameras with the exchange undone

    def refusal(self, frame: int) -> TrackingError:
        """Return the error that names the exchange."""
        return TrackingError(self.finding, frame=frame, hint=self.hint)


def all_arches_exchanged(sources: Sequence[CameraSource]) -> Mixup:
    """Return the exchange of arches in all cameras, which exchanged scan files look like as well."""
    return Mixup(
        "the masks of the upper and lower teeth are exchanged in every camera",
        "Exchange masks.upper and masks.lower, or upper_teeth and lower_teeth in [scans].",
        _with_masks(sources, {k: _masks(s).exchanged for k, s in enumerate(sources)}),
    )


def possible_mixups(sources: Sequence[CameraSource]) -> list[Mixup]:
    """Return every exchange of arches in one camera or in all, and of masks between two cameras of one picture size."""
    out = []
    for k, source in enumerate(sources):
        out.append(
            Mixup(
                f"the masks of the upper and lower teeth are exchanged in camera {source.name}",
                f"Exchange masks.upper and masks.lower of camera {source.name}.",
                _with_masks(sources, {k: _masks(source).exchanged}),
            )
        )
    out.append(all_arches_exchanged(sources))
    for a, b in combinations(range(len(sources)), 2):
        first, second = sources[a].name, sources[b].name
        out.append(
            Mixup(
                f"the masks of cameras {first} and {second} are exchanged",
                f"Exchange the masks of cameras {first} and {second}, or their entries in the calibration.",
                _with_masks(sources, {a: _masks(sources[b]), b: _masks(sources[a])}),
            )
        )
    return out


def likely_mixup(footage: Footage, solver: ContourSolver, poses: Array, frame: int) -> Mixup | None:
    """Return the exchange that explains much better why masks lie off their scans, with the evidence; None without.

    `poses` are T_world_upper and T_world_lower of the frame, good to a millimetre or so, shape (2, 4, 4).
    """
    given = _uncovered_shares(footage, solver, poses, frame)
    if not (given >= _ODD_SHARE).any():
        return None
    found: list[tuple[float, float, Mixup]] = []
    for mixup in possible_mixups(footage.sources):
        if _sizes_differ(footage, mixup.sources):
            continue
        try:
            shares = _uncovered_shares(replace(footage, sources=mixup.sources), solver, poses, frame)
        except CaptureError:
            continue  # mask videos of other lengths than those cameras' clips
        # An exchange may leave a camera without masks on this frame: that explains nothing.
        both = np.isfinite(given) & np.isfinite(shares)
        if (given[both] >= _ODD_SHARE).any():
            found.append((float(shares[both].mean()), float(given[both].mean()), mixup))
    if not found:
        return None
    share, before, mixup = min(found, key=lambda f: f[0] / f[1])
    if share >= _PROOF * before:
        return None
    evidence = f"{before:.0%} of the masks lie off their scans, {share:.0%} would after exchanging them"
    return replace(mixup, finding=f"{mixup.finding}: {evidence}")


def _uncovered_shares(footage: Footage, solver: ContourSolver, poses: Array, frame: int) -> Array:
    """Return the share of each camera's masks that lies off their scans, NaN without a mask, shape (C,)."""
    with footage.views(teeth_centre(solver.scans, poses), solver.config.working_px_per_mm / 2) as masks:
        uncovered, total = uncovered_px(solver.scans, poses, masks.at(frame))
    return coverage_error(uncovered.sum(0), total.sum(0))


def _masks(source: CameraSource) -> Masks:
    """Return the masks of a camera that `masked_sources` chose."""
    if source.masks is None:
        raise TrackingError("there are no masks", camera=source.name)
    return source.masks


def _with_masks(sources: Sequence[CameraSource], masks: dict[int, Masks]) -> tuple[CameraSource, ...]:
    return tuple(s.model_copy(update={"masks": masks.get(k, s.masks)}) for k, s in enumerate(sources))


def _sizes_differ(footage: Footage, sources: Sequence[CameraSource]) -> bool:
    """Tell whether masks would go to a camera with pictures of another size."""
    size = {_masks(source).upper: footage.cameras[source.name].size_px for source in footage.sources}
    size |= {_masks(source).lower: footage.cameras[source.name].size_px for source in footage.sources}
    return any(size[_masks(source).upper] != footage.cameras[source.name].size_px for source in sources)


# Fit that leaves no doubt [-]. Wrong poses of a hundred searches stayed below 0.1 in one of the arches, right ones
# exceed 0.35 where much of the teeth shows, and 0.1 with lips nearly closed or cameras 0.1 degrees off.
# (Scans of other persons: 0.35 to 0.77 in the arch that is right, below 0.05 in the other one, on seven persons.)
CLEAR_FIT = 0.3
#: Least fit with a mistake undone, which wrong poses do not reach [-].
EXPLAINS = 0.1
_MOST_CAMERAS = 4  # whose exchanges are tried; every one costs a search
#: Pictures searched after which no further search begins [-], on the frames of a start and again for the mistake; each
#: takes two to three seconds of processor time. All mistakes of up to four cameras are tried, and without exchanges, of
#: eight.
#: Work is counted, not time: what is said does not depend on the machine.
MOST_PICTURES = 120
# Sizes of the scans that are tried, each of which finds teeth that are 5 % off it.
_SIZES = (0.95, 1.05, 0.86, 1.16, 0.77, 1.28)
#: Hint for scans of a wrong size; where it is among the `accused`, sizes are tried first.
SIZE_HINT = "Check the scans' unit and scaling, and the square size of the calibration board."


@dataclass(frozen=True, eq=False)
class _Cause:
    """Hold a mistake with the search and the footage in which it is undone."""

    message: str
    hint: str
    search: StartSearch
    footage: Footage


def aligned(search: StartSearch, footage: Footage, poses: Array, frame: int) -> Array:
    """Return the poses as aligned by the solver if they pass the checks of a first frame, shape (2, 4, 4).

    Raises:
        TrackingError: they do not.
    """
    solver = search.solver
    with footage.views(teeth_centre(solver.scans, poses), solver.config.working_px_per_mm) as masks:
        return first_record(solver, solver.config, poses, masks.at(frame), frame).solution.poses


def refuse_by_cause(
    search: StartSearch,
    footage: Footage,
    frames: Sequence[int],
    fits: Mapping[int, Array],
    accused: set[str],
    beyond_doubt: bool = False,
) -> str:
    """Refuse a capture for the mistake with which undone the search succeeds on one of some frames.

    Exchanges whose hints are among the `accused` are tried before others, and sizes before everything. What is wrong
    with one camera alone, or else with the size of the scans, is looked for last, since leaving out what contradicts
    makes many poses fit. No search begins that would look at more than `MOST_PICTURES`; what was found in a group of
    mistakes that are not all tried counts if it fits beyond doubt. A scan that fits none of its masks is the next
    suspect; then other frames are tried, as far as all mistakes can be: the right one is missed on some, as teeth are
    with nothing wrong.

    Args:
        search, footage: that failed.
        frames: tried in this order.
        fits: what the search found, by frame: `arch_fit` of both arches [-], shape (2,).
        accused: hints of mistakes.
        beyond_doubt: whether only a fit beyond doubt counts.

    Returns:
        What was tried, as a sentence, if there is no such mistake among it.

    Raises:
        TrackingError: names the mistake.
    """
    exchanges = sorted(_exchanges(search, footage), key=lambda cause: cause.hint not in accused)
    sizes = [*_sizes(search, footage)]
    hands, cameras = [*_mirrored(search, footage)], [*_cameras(search, footage)]
    groups = (sizes, hands, exchanges, cameras) if SIZE_HINT in accused else (hands, exchanges, sizes, cameras)
    count = sum(map(len, groups))
    pictures = sum(len(cause.footage.sources) for group in groups for cause in group)
    frames = frames[: max(1, MOST_PICTURES // pictures)]
    tried = _refuse_on(frames[0], groups, beyond_doubt)
    refuse_lone_arch(fits)
    for frame in frames[1:]:
        _refuse_on(frame, groups, beyond_doubt)
    where = f"frame{'s' if len(frames) > 1 else ''} {', '.join(map(str, frames))}"
    sentence = f"Undoing any of {tried} mistakes in masks, scans and calibration does not help on {where}"
    if tried == count:
        return f"{sentence}."
    return f"{sentence}; {count - tried} more were not tried: no more than {MOST_PICTURES} pictures are searched."


def _refuse_on(frame: int, groups: Sequence[Sequence[_Cause]], beyond_doubt: bool) -> int:
    """Refuse a capture for the mistake with which undone the search succeeds on a frame; return how many were tried."""
    tried, pictures = 0, 0
    for causes in groups:
        explained: list[tuple[float, _Cause]] = []
        for cause in causes:
            pictures += len(cause.footage.sources)
            if pictures > MOST_PICTURES:
                break
            explained.append((_fit(cause, frame), cause))
        tried += len(explained)
        least = CLEAR_FIT if beyond_doubt or len(explained) < len(causes) else EXPLAINS
        fit, best = max(explained, key=lambda one: one[0], default=(0.0, None))
        if best is not None and fit >= least:
            message = f"{best.message}: the teeth are found only with that undone"
            raise TrackingError(message, frame=frame, hint=best.hint)
    return tried


def refuse_lone_arch(fits: Mapping[int, Array]) -> None:
    """Refuse a scan that fits none of its masks where the other one fits beyond doubt; return if there is none.

    Args:
        fits: what a search that failed found, by frame: `arch_fit` of both arches [-], shape (2,).

    Raises:
        TrackingError: names the scan.
    """
    clear = {frame: fit for frame, fit in fits.items() if fit.max() >= CLEAR_FIT}
    arches = {int(fit.argmax()) for fit in clear.values()}
    if len(arches) != 1 or any(fit.min() >= EXPLAINS for fit in clear.values()):
        return
    good = arches.pop()
    frame = max(clear, key=lambda f: float(clear[f][good]))
    fit = clear[frame]
    name, other = ARCH_NAMES[1 - good], ARCH_NAMES[good]
    raise TrackingError(
        f"the {name} scan does not fit its own masks on any frame where the {other} one does: {fit[1 - good]:.2f} of "
        f"its contour against {fit[good]:.2f}, less what stays uncovered; at least {EXPLAINS:g} is needed",
        frame=frame,
        hint=f"Check that the {name} scan is this person's, of this time, and that its masks show the {name} teeth.",
    )


def _fit(cause: _Cause, frame: int) -> float:
    """Return how well the teeth fit with a mistake undone [-]; zero if they are not found."""
    try:
        found = cause.search.at(cause.footage, frame)
        if found.fit < EXPLAINS:
            return 0.0
        aligned(cause.search, cause.footage, found.poses, frame)
    except (TrackingError, CaptureError):
        return 0.0
    return found.fit


def _mirrored(search: StartSearch, footage: Footage) -> Iterator[_Cause]:
    yield _Cause(
        "the scans are mirrored: left and right are exchanged",
        "Export them again without mirroring; one axis may have been negated.",
        search.mirrored(),
        footage,
    )


def _exchanges(search: StartSearch, footage: Footage) -> Iterator[_Cause]:
    """Yield exchanges of masks and of calibrations."""
    if len(footage.sources) > _MOST_CAMERAS:
        return
    for mixup in possible_mixups(footage.sources):
        yield _Cause(mixup.finding, mixup.hint, search, replace(footage, sources=mixup.sources))
    for a, b in combinations([source.name for source in footage.sources], 2):
        if footage.offsets[a] != footage.offsets[b]:  # else it is the same as an exchange of masks
            cameras = {**footage.cameras, a: footage.cameras[b], b: footage.cameras[a]}
            message = f"the calibrations of cameras {a} and {b} are exchanged"
            hint = f"Exchange the names {a} and {b} in the calibration."
            yield _Cause(message, hint, search, replace(footage, cameras=cameras))


def _sizes(search: StartSearch, footage: Footage) -> Iterator[_Cause]:
    for size in _SIZES:
        yield _Cause(
            f"the scans are about {abs(size - 1.0):.0%} too {'large' if size > 1.0 else 'small'}: their scale is "
            "wrong, or the calibration's lengths",
            SIZE_HINT,
            search.scaled(1.0 / size),
            footage,
        )


def _cameras(search: StartSearch, footage: Footage) -> Iterator[_Cause]:
    if len(footage.sources) < 3:
        return
    for source in footage.sources:
        others = replace(footage, sources=[other for other in footage.sources if other is not source])
        yield _Cause(
            f"camera {source.name} contradicts the other cameras: its calibration is wrong (focal length, principal "
            "point), it was turned or knocked since, or its masks are of another instant",
            f"Calibrate camera {source.name} again, check its time offset, or leave it out.",
            search,
            others,
        )
