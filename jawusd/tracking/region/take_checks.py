"""What colours show of cameras and scans: knocked cameras, wrong focal lengths, scans mirrored or of another size."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.formats.finding import Finding
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.equations import Solution
from jawusd.tracking.contour.quality import score_px
from jawusd.tracking.contour.scan import Scan
from jawusd.tracking.contour.views import View
from jawusd.tracking.initialization.magnification import measure_magnification
from jawusd.tracking.region.learned import CORRELATION_PX
from jawusd.tracking.sequence.mirror_check import mirror_findings
from jawusd.tracking.sequence.take_checks import OF_COLOURS, lens_findings

# Share of a camera's contour that fits over that of the camera with most, below which it sees the teeth elsewhere. It
# was 0.65 and more in 8 takes of 7 mouths (false alarms: at most 31 %, 95 %), and 0.05 to 0.08 in 3 of these with a
# camera turned by 0.6 degrees.
_LEAST_SHARE = 0.3


def camera_findings(names: Sequence[str], solutions: Iterable[Solution]) -> list[Finding]:
    """Return a warning for each camera whose pictures fit the teeth far less than those of the others.

    Kind: "camera_rarely_used", with its share of the contour in sight that fits.
    """
    shares = []
    for solution in solutions:
        seen = solution.visible_px.sum(0)
        shares.append(np.where(seen > 0, score_px(solution).sum(0) / np.maximum(seen, 1.0), np.nan))
    known = np.array(shares)
    seen_at_all = np.isfinite(known).any(0)
    share = np.zeros(len(names))
    share[seen_at_all] = np.nanmedian(known[:, seen_at_all], axis=0)
    return [
        Finding(
            "camera_rarely_used",
            "warning",
            f"{share[c]:.0%} of the teeth's outlines fit its pictures, {share.max():.0%} those of the camera that sees "
            f"them best; {_LEAST_SHARE:.0%} of that at least is usual. It adds little to the tracks.",
            value=round(float(share[c]), 3),
            limit=round(float(_LEAST_SHARE * share.max()), 3),
            camera=name,
            hint="Check that the video is this camera's, its calibration (was it knocked?) and its time offset.",
        )
        for c, name in enumerate(names)
        if share[c] < _LEAST_SHARE * share.max()
    ]


def scan_findings(
    names: Sequence[str],
    scans: Sequence[Scan],
    left: Array,
    looks: Iterable[tuple[Array, Sequence[View]]],
    config: TrackingConfig,
) -> list[Finding]:
    """Return what some frames show about the scans and of focal lengths; see `lens_findings` and `mirror_findings`.

    Args:
        left: unit vector in scan coordinates, shape (3,).
        looks: T_world_upper and T_world_lower (2, 4, 4) of a frame, and its views, one per camera.
    """

    def shown(views: Sequence[View]) -> Mask:
        return np.tile([view.edges is not None for view in views], (2, 1))

    instants = [(poses, views, shown(views)) for poses, views in looks]
    thin = [scan.thin or scan for scan in scans]
    hands = mirror_findings(thin, left, instants, config)
    found = measure_magnification(thin, instants, replace(config, correlation_px=CORRELATION_PX))
    return hands if found is None else hands + lens_findings(names, found, OF_COLOURS)
