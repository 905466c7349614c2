"""Motion of the teeth within a frame, for cameras with a delay of a fraction of a frame."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.tracks import LOST
from jawusd.tracking.contour.equations import motion_about, twist_between
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.contour.scan import ARCHES


def delay_motions(records: Mapping[int, FrameRecord], frame: int, delays: Array) -> Array:
    """Return the motion of both arches from the reference exposure to each camera's exposure, shape (C, 2, 4, 4)."""
    out = np.tile(np.eye(4), (len(delays), 2, 1, 1))
    for arch in ARCHES:
        motion = _motion_twists(records, frame, arch)
        if motion is not None:
            velocity, change = motion
            twists = delays[:, None] * velocity + 0.5 * delays[:, None] ** 2 * change
            out[:, arch] = motion_about(records[frame].solution.centres[arch], twists)
    return out


def _motion_twists(records: Mapping[int, FrameRecord], frame: int, arch: int) -> tuple[Array, Array] | None:
    """Fit a parabola in time; return the twist per frame about the arch's centre and its change per frame, shapes (6,).

    More frames would smooth too much, since a jaw starts and stops within one or two frames.
    """

    def step(frames: int) -> Array:
        here, there = records[frame].solution, records[frame + frames].solution
        return twist_between(here.poses[arch], there.poses[arch], here.centres[arch])

    def tracked(*steps: int) -> bool:
        return all(_is_tracked(records, frame + k, arch) for k in (0, *steps))

    if tracked(-1, 1):
        return 0.5 * (step(1) - step(-1)), step(1) + step(-1)
    for way in (1, -1):
        if tracked(way, 2 * way):
            return way * (2.0 * step(way) - 0.5 * step(2 * way)), step(2 * way) - 2.0 * step(way)
    across = bridge(records, frame, arch)
    return None if across is None else (across[1], np.zeros(6))


def interpolation_errors(records: Mapping[int, FrameRecord], frame: int, arch: int, delays: Array) -> Array:
    """Return the error of the parabola of `delay_motions`, as twists about the centre, shape (C, 6).

    The error is the next term of Newton's interpolation, from the third difference of four consecutive frames.
    """

    def tracked(first: int) -> bool:
        return all(_is_tracked(records, first + k, arch) for k in range(4))

    first = next((f for f in (frame - 1, frame - 2, frame, frame - 3) if tracked(f)), None)
    if first is None:
        return np.zeros((len(delays), 6))
    centre = records[frame].solution.centres[arch]
    poses = [records[first + k].solution.poses[arch] for k in range(4)]
    steps = [twist_between(here, there, centre) for here, there in zip(poses[:-1], poses[1:], strict=True)]
    third = steps[2] - 2.0 * steps[1] + steps[0]
    offset = frame - first
    nodes = np.array([0, 1, 2] if offset < 2 else [1, 2, 3])  # time offsets of the parabola's nodes [frames]
    share = np.prod(delays[:, None] + (offset - nodes), axis=1) / 6.0
    return np.asarray(share[:, None] * third, np.float64)


def velocity_twist(records: Mapping[int, FrameRecord], frame: int, arch: int) -> Array | None:
    """Return the twist per frame about the arch's centre, shape (6,); None without tracked frames before and after."""
    if not all(_is_tracked(records, f, arch) for f in (frame - 1, frame, frame + 1)):
        return None
    before, now, after = (records[f].solution for f in (frame - 1, frame, frame + 1))
    return 0.5 * twist_between(before.poses[arch], after.poses[arch], now.centres[arch])


def _is_tracked(records: Mapping[int, FrameRecord], frame: int, arch: int) -> bool:
    return frame in records and bool(records[frame].status[arch] != LOST)


#: Maximum number of frames from a lost frame to a tracked one on either side: a quarter of a second at 24 fps.
BRIDGE_FRAMES = 6


def bridge(records: Mapping[int, FrameRecord], frame: int, arch: int) -> tuple[Array, Array] | None:
    """Interpolate an arch linearly between tracked frames; return its pose (4, 4) and twist per frame about its centre.

    Return None without tracked frames nearby on both sides.
    """
    reach = range(1, BRIDGE_FRAMES + 1)
    before = next((frame - k for k in reach if _is_tracked(records, frame - k, arch)), None)
    after = next((frame + k for k in reach if _is_tracked(records, frame + k, arch)), None)
    if before is None or after is None:
        return None
    centre = records[frame].solution.centres[arch]
    start, end = (records[f].solution.poses[arch] for f in (before, after))
    twist = twist_between(start, end, centre) / (after - before)
    return motion_about(centre, (frame - before) * twist) @ start, twist
