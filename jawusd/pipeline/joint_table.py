"""What the mandible's joint does for each ARKit shape alone."""

from __future__ import annotations

import numpy as np

from jawusd.evaluator import JawRig
from jawusd.formats.arkit import ArkitMapping, shares_of
from jawusd.formats.poses import JointDelta

SHAPES = ("JawOpen", "JawLeft", "JawRight", "JawForward")
_WEIGHTS = (0.5, 1.0)  # motion bends, so that a full shape is not twice a half one


def joint_deltas(rig: JawRig, mapping: ArkitMapping | None = None) -> list[JointDelta]:
    """Return what each shape does to the joint midway between the condyles, at half and full weight.

    The other weights are neutral. d is brought inside the bound, as `jawusd animate` does.

    Args:
        mapping: the person's own; None for shares of the ranges, whose neutral face is the closed bite.
    """
    from jawusd.rig.skel import joint_poses

    neutral = np.zeros(4) if mapping is None else np.array(mapping.neutral)
    cases = [(i, weight) for i in range(len(SHAPES)) for weight in _WEIGHTS]
    weights = np.tile(neutral, (1 + len(cases), 1))
    for row, (i, weight) in enumerate(cases, start=1):
        weights[row, i] = weight
    wanted = rig.denormalized(shares_of(weights)) if mapping is None else mapping.d(weights)
    d = rig.project(wanted)
    joint = joint_poses(rig, d)
    moved, turned = joint[1:, :3, 3] - joint[0, :3, 3], joint[1:, :3, :3] @ joint[0, :3, :3].T
    clamped = np.linalg.norm(d - wanted, axis=1)[1:]
    return [
        JointDelta(SHAPES[i], weight, *rest)
        for (i, weight), *rest in zip(cases, d[1:], moved, turned, clamped.tolist(), strict=True)
    ]
