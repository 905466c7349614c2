"""Bring a motion to another number of frames per second."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jawusd.cli.motion import AuthoredMotion
from jawusd.evaluator.curves import HermiteCurve
from jawusd.formats.keys import Key

if TYPE_CHECKING:
    from jawusd.evaluator import JawRig


def resampled(rig: JawRig, motion: AuthoredMotion, source_fps: float, fps: float) -> AuthoredMotion:
    """Return a motion at the whole frames of another rate; frame 0 stays frame 0.

    Between samples it is cubic, with the slopes of parabolas through three samples; keys move and keep their curves. A
    frame is lost where the nearest sample is.

    Args:
        source_fps: Rate at which the frames of the motion pass.
        fps: Rate wanted.
    """
    ratio = fps / source_fps
    times = motion.frames * ratio
    at = np.arange(np.ceil(times[0] - 1e-6), np.floor(times[-1] + 1e-6) + 1)
    if not len(at):
        at = np.round(times[:1])
    if motion.keys is not None:
        keys = tuple(Key(frame=key.frame * ratio, d=key.d) for key in motion.keys.keys)
        moved = motion.keys.model_copy(update={"keys": keys, "fps": fps})
        at = np.union1d(at, [key.frame for key in keys])
        d = rig.interpolate(*moved.arrays(), at, method=moved.interpolation, inside=False)
        return AuthoredMotion(at, d, fps, moved)
    known = np.asarray(np.isfinite(motion.d).all(axis=1))
    seen, values = times[known], motion.d[known]
    if len(seen) < 3:
        d = np.stack([np.interp(at, seen, column) for column in values.T], axis=1)
    else:
        d = HermiteCurve(seen, values, np.gradient(values, seen, axis=0)).value(np.clip(at, seen[0], seen[-1]))
    after = np.clip(np.searchsorted(times, at), 1, max(len(times) - 1, 1))
    nearest = np.where(at - times[after - 1] <= times[after] - at, after - 1, after) if len(times) > 1 else 0 * after
    d[~known[nearest]] = np.nan
    return AuthoredMotion(at, d, fps)
