"""How near a mandible has to be to where its d puts it, when, and whether the skull stays where it belongs."""

from __future__ import annotations

import numpy as np
from pxr import Usd

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.rig.animation import BETWEEN_MM
from jawusd.rig.keys import time_codes, times_between
from jawusd.rig.layout import PARAMETERS
from jawusd.rig.motion_read import moving_attributes, poses_in_actor, skull_of
from jawusd.rig.table import landmark_distance

#: Largest distance [mm] of a baked pose from that of d.
BAKED_MM = 0.01


def looked_at(actor: Usd.Prim, moving: list[Usd.Attribute], by_bones: bool) -> tuple[Array, Array]:
    """Return the times at which a mandible is compared with d, and how far it may be away.

    These are the keys of both, for where only d is keyed the jaw stays still, and the whole frames between them, for
    between two keys alone d is interpolated in another way. Bones have keys at every key of d.

    Args:
        moving: What moves the mandible.
        by_bones: Whether these are joints.

    Returns:
        Times, increasing, shape (n,), n = 0 where nothing has keys; landmark distances [mm], shape (max(n, 1),).
    """
    times, keyed = times_between([*moving, *(actor.GetAttribute(name) for name in PARAMETERS)])
    if by_bones:
        times, keyed = times[keyed], keyed[keyed]
    return times, np.where(keyed, BAKED_MM, BAKED_MM + BETWEEN_MM) if len(times) else np.array([BAKED_MM])


def skull_moved_mm(actor: Usd.Prim, rig: JawRig, path: object) -> float:
    """Return how far transforms or bones move the skull in the actor [mm].

    Raises:
        FormatError: Bones bend it, or it is not there.
    """
    skull = skull_of(actor, path)
    if skull is None:
        return 0.0
    times = time_codes(times_between(moving_attributes(skull, actor))[0])
    poses = poses_in_actor(skull, actor, times, path)
    return float(landmark_distance(rig, poses, np.broadcast_to(np.eye(4), poses.shape)).max())
