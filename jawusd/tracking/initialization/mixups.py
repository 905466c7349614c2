"""Masks that were named for the wrong camera or the wrong arch: which exchange explains them?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import CaptureError, TrackingError
from jawusd.formats.capture_parts import CameraSource, Masks
from jawusd.tracking.contour.quality import coverage_error, uncovered_px
from jawusd.tracking.contour.scan import teeth_centre
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.initialization.footage import Footage

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
