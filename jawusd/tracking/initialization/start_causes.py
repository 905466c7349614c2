"""Causes of a failed start: swapped masks, and other mistakes in scans or calibration, each tested by correcting it."""

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
from jawusd.tracking.initialization.bootstrap import SIZE_HINT
from jawusd.tracking.initialization.first_frame import CLEAR_FIT, EXPLAINS, first_record
from jawusd.tracking.initialization.footage import Footage
from jawusd.tracking.initialization.start_search import StartSearch

# Maximum ratio of the uncovered mask fractions after and before correcting a swap for the swap to be reported [-].
_PROOF = 0.5
_ODD_SHARE = 0.05  # uncovered fraction of masks above which a swap is suspected: good poses leave 0.01, swaps 0.1


@dataclass(frozen=True, eq=False)
class Cause:
    """A possible mistake in the inputs, and the inputs after correcting it."""

    message: str
    hint: str
    footage: Footage
    search: StartSearch | None = None  # a search with corrected scans; None: with the given ones

    def error(self, frame: int) -> TrackingError:
        """Return the error that reports the mistake."""
        return TrackingError(self.message, frame=frame, hint=self.hint)


def all_arches_exchanged(footage: Footage) -> Cause:
    """Return the swap of arches in all cameras; swapped scan files have the same effect."""
    return Cause(
        "the masks of the upper and lower teeth are exchanged in every camera",
        "Exchange masks.upper and masks.lower, or upper_teeth and lower_teeth in [scans].",
        _with_masks(footage, {k: _masks(source).exchanged for k, source in enumerate(footage.files)}),
    )


def possible_exchanges(footage: Footage) -> list[Cause]:
    """Return every swap of arches in one camera or in all, and of masks between two cameras."""
    out, sources = [], footage.files
    for k, source in enumerate(sources):
        message = f"the masks of the upper and lower teeth are exchanged in camera {source.name}"
        hint = f"Exchange masks.upper and masks.lower of camera {source.name}."
        out.append(Cause(message, hint, _with_masks(footage, {k: _masks(source).exchanged})))
    out.append(all_arches_exchanged(footage))
    for a, b in combinations(range(len(sources)), 2):
        both = f"cameras {sources[a].name} and {sources[b].name}"
        hint = f"Exchange the masks of {both}, or their entries in the calibration."
        swapped = _with_masks(footage, {a: _masks(sources[b]), b: _masks(sources[a])})
        out.append(Cause(f"the masks of {both} are exchanged", hint, swapped))
    return out


def likely_exchange(footage: Footage, solver: ContourSolver, poses: Array, frame: int) -> Cause | None:
    """Return the swap that best explains why masks lie outside their scans, with its evidence; None if no swap does.

    A camera whose masks fit as given takes part in no swap. `poses` are T_world_upper and T_world_lower of the frame,
    accurate to about 1 mm, shape (2, 4, 4).
    """
    given = _uncovered_shares(footage, solver, poses, frame)
    if not (given >= _ODD_SHARE).any():
        return None
    found: list[tuple[float, float, Cause]] = []
    for exchange in possible_exchanges(footage):
        if _sizes_differ(footage, exchange.footage.files):
            continue
        try:
            shares = _uncovered_shares(exchange.footage, solver, poses, frame)
        except CaptureError:
            continue  # mask videos differ in length from the clips of the cameras to which they would be assigned
        # If a swap leaves a camera without masks in this frame, that does not count against the swap.
        both = np.isfinite(given) & np.isfinite(shares)
        changed = [one.masks != other.masks for one, other in zip(footage.files, exchange.footage.files, strict=True)]
        fitting = given[changed] < _ODD_SHARE
        if (given[both] >= _ODD_SHARE).any() and not fitting.any():
            found.append((float(shares[both].mean()), float(given[both].mean()), exchange))
    if not found:
        return None
    share, before, exchange = min(found, key=lambda f: f[0] / f[1])
    if share >= _PROOF * before:
        return None
    evidence = f"{before:.0%} of the mask area lies outside the scans, {share:.0%} after exchanging them"
    return replace(exchange, message=f"{exchange.message}: {evidence}")


def _uncovered_shares(footage: Footage, solver: ContourSolver, poses: Array, frame: int) -> Array:
    """Return the uncovered fraction of each camera's masks, NaN without masks, shape (C,)."""
    with footage.views(teeth_centre(solver.scans, poses), solver.config.working_px_per_mm / 2) as masks:
        uncovered, total = uncovered_px(solver.scans, poses, masks.at(frame))
    return coverage_error(uncovered.sum(0), total.sum(0))


def _masks(source: CameraSource) -> Masks:
    """Return the masks of a camera, which has masks because `masked_sources` chose it."""
    if source.masks is None:
        raise TrackingError("there are no masks", camera=source.name)
    return source.masks


def _with_masks(footage: Footage, masks: dict[int, Masks]) -> Footage:
    sources = [s.model_copy(update={"masks": masks.get(k, s.masks)}) for k, s in enumerate(footage.files)]
    return replace(footage, sources=sources)


def _sizes_differ(footage: Footage, sources: Sequence[CameraSource]) -> bool:
    """Return whether masks would be assigned to a camera with another image size."""
    sizes = {source.name: footage.cameras[source.name].size_px for source in footage.files}
    size = {file: sizes[s.name] for s in footage.files for file in (_masks(s).upper, _masks(s).lower)}
    return any(size[_masks(source).upper] != sizes[source.name] for source in sources)


_MOST_CAMERAS = 4  # maximum number of cameras for which swaps are tried, since each swap costs a search
#: Maximum number of images searched, separately for the start and for mistakes; each takes 2 to 3 s of CPU time. Work
#: is counted instead of time, so that messages do not depend on the machine.
MOST_PICTURES = 120
# Scan sizes that are tried, relative to the given size [-]; each is close enough for teeth up to 5 % larger or smaller.
_SIZES = (0.95, 1.05, 0.86, 1.16, 0.77, 1.28)


def aligned(search: StartSearch, footage: Footage, poses: Array, frame: int) -> Array:
    """Return the poses aligned by the solver, if they pass the checks of a first frame, shape (2, 4, 4).

    Raises TrackingError if they do not pass the checks.
    """
    solver = search.solver
    with footage.views(teeth_centre(solver.scans, poses), solver.config.working_px_per_mm) as masks:
        return first_record(solver, poses, masks.at(frame), frame).solution.poses


def raise_cause(
    search: StartSearch,
    footage: Footage,
    frames: Sequence[int],
    fits: Mapping[int, Array],
    suspected: set[str],
    only_clear: bool = False,
) -> str:
    """Raise an error for a mistake if correcting it makes the search succeed on one of the given frames.

    Suspected swaps are tried before others, and suspected sizes before everything else. Mistakes of single cameras, and
    sizes that are not suspected, come last, since many poses fit once contradictions are excluded. In a group of
    mistakes of which some were not tried, only a clear fit counts. Next, a scan that fits none of its masks is
    reported; then other frames are tried within the same budget, since the search can miss the teeth on a frame.

    Args:
        frames: frames to try, in this order.
        fits: `arch_fit` of both arches by frame, as found by the search [-], shape (2,).
        suspected: hints of the suspected mistakes; a mistake is identified by its hint.
        only_clear: whether only a clear fit counts.

    Returns:
        A sentence about what was tried; returned only if no mistake explains the failure.

    Raises:
        TrackingError: a mistake explains the failure; the message describes it.
    """
    exchanges = sorted(_exchanges(footage), key=lambda cause: cause.hint not in suspected)
    sizes = [*_sizes(search, footage)]
    message = "the scans are mirrored: left and right are exchanged"
    hint = "Export them again without mirroring; one axis may have been negated."
    hands, cameras = [Cause(message, hint, footage, search.mirrored())], [*_cameras(footage)]
    groups = (sizes, hands, exchanges, cameras) if SIZE_HINT in suspected else (hands, exchanges, sizes, cameras)
    count = sum(map(len, groups))
    pictures = sum(len(cause.footage.sources) for group in groups for cause in group)
    frames = frames[: max(1, MOST_PICTURES // pictures)]
    tried = _raise_cause_on(search, frames[0], groups, only_clear)
    raise_for_unmatched_arch(fits)
    for frame in frames[1:]:
        _raise_cause_on(search, frame, groups, only_clear)
    where = f"frame{'s' if len(frames) > 1 else ''} {', '.join(map(str, frames))}"
    sentence = f"Correcting any of {tried} possible mistakes in masks, scans and calibration does not help on {where}"
    if tried == count:
        return f"{sentence}."
    return f"{sentence}; {count - tried} more were not tried, since at most {MOST_PICTURES} images are searched."


def _raise_cause_on(search: StartSearch, frame: int, groups: Sequence[Sequence[Cause]], only_clear: bool) -> int:
    """Raise an error for a mistake if correcting it makes the search succeed; return the number of mistakes tried."""
    tried, pictures = 0, 0
    for causes in groups:
        explained: list[tuple[float, Cause]] = []
        for cause in causes:
            pictures += len(cause.footage.sources)
            if pictures > MOST_PICTURES:
                break
            explained.append((_fit(cause.search or search, cause.footage, frame), cause))
        tried += len(explained)
        least = CLEAR_FIT if only_clear or len(explained) < len(causes) else EXPLAINS
        fit, best = max(explained, key=lambda one: one[0], default=(0.0, None))
        if best is not None and fit >= least:
            raise replace(best, message=f"{best.message}: the teeth are found only after correcting this").error(frame)
    return tried


def raise_for_unmatched_arch(fits: Mapping[int, Array]) -> None:
    """Raise a TrackingError for a scan that fits none of its masks while the other scan clearly fits its own.

    `fits` is `arch_fit` of both arches by frame, as found by a failed search [-], shape (2,).
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
        f"the {name} scan does not fit its own masks on any frame on which the {other} scan fits its own: the "
        f"fit (matched fraction of the contour minus a penalty for uncovered mask) is {fit[1 - good]:.2f} against "
        f"{fit[good]:.2f}; at least {EXPLAINS:g} is needed",
        frame=frame,
        hint=f"Check that the {name} scan is a recent one of this subject, and that its masks show the {name} teeth.",
    )


def _fit(search: StartSearch, footage: Footage, frame: int) -> float:
    """Return the fit of the teeth in a frame [-]; zero if they are not found."""
    try:
        found = search.at(footage, frame)
        if found.fit < EXPLAINS:
            return 0.0
        aligned(search, footage, found.poses, frame)
    except (TrackingError, CaptureError):
        return 0.0
    return found.fit


def _exchanges(footage: Footage) -> Iterator[Cause]:
    """Yield swaps of masks and of calibrations."""
    if len(footage.sources) > _MOST_CAMERAS:
        return
    yield from possible_exchanges(footage)
    for a, b in combinations([source.name for source in footage.sources], 2):
        if footage.offsets[a] != footage.offsets[b]:  # with equal offsets, this is identical to a swap of masks
            cameras = {**footage.cameras, a: footage.cameras[b], b: footage.cameras[a]}
            message = f"the calibrations of cameras {a} and {b} are exchanged"
            hint = f"Exchange the names {a} and {b} in the calibration."
            yield Cause(message, hint, replace(footage, cameras=cameras))


def _sizes(search: StartSearch, footage: Footage) -> Iterator[Cause]:
    for size in _SIZES:
        message = f"the scans are about {abs(size - 1.0):.0%} too {'large' if size > 1.0 else 'small'}: the scale of "
        message += "the scans or of the calibration is wrong"
        yield Cause(message, SIZE_HINT, footage, search.scaled(1.0 / size))


def _cameras(footage: Footage) -> Iterator[Cause]:
    for name, others in footage.without_each_camera():
        message = f"camera {name} contradicts the other cameras: its calibration is wrong (focal length, principal "
        message += "point), it was turned or moved since, or its masks belong to another frame"
        yield Cause(message, f"Calibrate camera {name} again, check its time offset, or exclude it.", others)
