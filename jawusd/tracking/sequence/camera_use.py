"""In how many frames each camera's masks took part, and what is to be said where they did not."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from jawusd.formats.finding import Finding
from jawusd.tracking.contour.frame_record import FrameRecord

_HALF = 0.5  # of a camera's masks: with fewer used, the camera contradicts the others more often than not


def use_of_cameras(names: tuple[str, ...], records: Mapping[int, FrameRecord]) -> list[Finding]:
    """Return a warning for each camera whose masks were used in none of the frames, or in few of those that have some.

    Kinds: "camera_not_used", with the number of frames that have masks; "camera_rarely_used", with the used share.
    """
    frames = sorted(records)
    present = np.array([np.isfinite(records[frame].coverage) for frame in frames])  # (F, 2, C)
    used = np.array([records[frame].used for frame in frames])
    out = []
    for c, name in enumerate(names):
        seen, taken = present[..., c], used[..., c]
        with_masks, with_use = int(seen.any(1).sum()), int(taken.any(1).sum())
        if not with_masks:
            out.append(
                Finding(
                    "camera_not_used",
                    "warning",
                    f"used in 0 of {len(frames)} frames: it has no masks from frame {frames[0]} to {frames[-1]}.",
                    value=0,
                    camera=name,
                    hint="Check `frames`, the numbers of its masks and its time offset.",
                )
            )
        elif not with_use or taken.sum() < _HALF * seen.sum():
            out.append(
                Finding(
                    "camera_rarely_used" if with_use else "camera_not_used",
                    "warning",
                    f"used in {with_use} of {len(frames)} frames: of its {int(seen.sum())} masks "
                    f"{int((seen & ~taken).sum())} fit neither the scans nor the other cameras' masks.",
                    value=round(float(taken.sum() / seen.sum()), 3),
                    limit=_HALF,
                    camera=name,
                    hint="Check that they are this camera's, its calibration and its time offset.",
                )
            )
    return out
