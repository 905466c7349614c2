"""The paper's inverse kinematics (Yang et al. 2019, eq. 10) as an oracle: walk to the best neighbour until none is."""

import itertools

import numpy as np

STEPS = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))


def brute_force_ik(rig, handles, targets, start, step_mm=0.05, most_moves=2000):
    """Return valid d (n, 3) after walking from start (n, 3) in steps on a grid, and the rms handle distances (n,).

    handles (H, 3) in the mandible, targets (n, H, 3) in the skull frame.
    """
    d = start.copy()
    best = _distance(rig, handles, targets, d)
    moving = np.arange(len(d))
    for _ in range(most_moves):
        around = d[moving, None] + step_mm * STEPS
        distance = _distance(rig, handles, targets[moving, None], around)
        distance[rig.margin(around) < 0] = np.inf
        choice = distance.argmin(axis=1)
        found = distance[np.arange(len(moving)), choice]
        better = found < best[moving] - 1e-12
        moved = moving[better]
        d[moved] = around[better, choice[better]]
        best[moved] = found[better]
        moving = moved
        if not moving.size:
            break
    return d, best


def _distance(rig, handles, targets, d):
    T = rig.pose(d)
    at = np.einsum("...ij,hj->...hi", T[..., :3, :3], handles) + T[..., None, :3, 3]
    return np.sqrt(((at - targets) ** 2).sum(-1).mean(-1))
