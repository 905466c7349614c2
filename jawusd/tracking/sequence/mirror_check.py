"""Whether the mirror images of the scans fit a take better than the scans: an axis was negated on their way here."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.finding import Finding
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.quality import score_px
from jawusd.tracking.contour.scan import Scan, mirrored
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.initialization.magnification import Instant

_FRAMES = 4  # that are aligned anew, twice: a second or two
# Contour that fits the mirror images over that which fits the scans. As given, it was 0.18 to 0.49 in takes of four
# mouths, and up to 0.98 in one whose arches are symmetric but for the triangles, where it does not matter.
_LEAST_RATIO = 1.15


def mirror_findings(
    scans: Sequence[Scan], left: Array, instants: Iterable[Instant], config: TrackingConfig
) -> list[Finding]:
    """Return a warning if more of the contour fits with left and right of the scans exchanged. Kind: "scans_mirrored".

    Args:
        scans: upper and lower.
        left: unit vector to the left in scan coordinates, shape (3,).
        instants: some frames of the take, aligned.
    """
    ratio = mirror_ratio(scans, left, instants, config)
    if not ratio > _LEAST_RATIO:
        return []
    return [
        Finding(
            "scans_mirrored",
            "warning",
            f"mirrored, the scans fit {ratio:.2f} times as much of the outlines: their left and right are exchanged",
            value=round(ratio, 2),
            limit=_LEAST_RATIO,
            hint="Export them again without mirroring; one axis may have been negated.",
        )
    ]


def mirror_ratio(scans: Sequence[Scan], left: Array, instants: Iterable[Instant], config: TrackingConfig) -> float:
    """Return how much contour fits with the scans mirrored, over that with the scans as given; NaN without any.

    Arguments as for `mirror_findings`.
    """
    middle = np.mean([scan.centre for scan in scans], axis=0)
    pair = [ContourSolver(own, config) for own in (scans, [mirrored(scan, middle, left) for scan in scans])]
    shares = []
    chosen = list(instants)
    for k in np.unique(np.linspace(0, len(chosen) - 1, _FRAMES).astype(int)) if chosen else ():
        poses, views, use = chosen[k]
        found = [solver.solve(poses, views, config.wide_gates_px, use) for solver in pair]
        shares.append([score_px(one).sum() / max(one.visible_px.sum(), 1.0) for one in found])
    given, other = np.median(shares, axis=0) if shares else (np.nan, np.nan)
    return float(other / given) if given > 0 else float("nan")
