"""The valid parameters of a jaw model: the box around them, and samples of them."""

from __future__ import annotations

import numpy as np

from jawusd.errors import RigError
from jawusd.evaluator import JawRig
from jawusd.geometry.arrays import Array

_PROBES_PER_AXIS = 41


def valid_box(rig: JawRig) -> Array:
    """Return the box (3, 2) [mm] of d that the table spans: `d_range`, widened to all d with a margin above zero.

    Raises:
        RigError: the bounds leave no valid parameters.
    """
    box = np.array(rig.arrays["d_range"], dtype=np.float64)
    reach = 1.0 + float(rig.arrays["slice_margin_mm"]) + float(rig.arrays["slice_softness_mm"])
    wide = box + np.array([-reach, reach])
    axes = [np.linspace(low, high, _PROBES_PER_AXIS) for low, high in wide]
    probes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    valid = probes[rig.margin(probes) >= 0]
    if not len(valid):
        raise RigError("the bounds of the model leave no valid parameters.")
    step = np.array([axis[1] - axis[0] for axis in axes])
    low, high = valid.min(axis=0) - step, valid.max(axis=0) + step
    return np.stack([np.minimum(box[:, 0], low), np.maximum(box[:, 1], high)], axis=1).clip(wide[:, :1], wide[:, 1:])


def sample_valid(rig: JawRig, count: int, seed: int = 0) -> Array:
    """Return `count` valid d, shape (count, 3) [mm], spread evenly over the volume where the margin is not negative."""
    rng = np.random.default_rng(seed)
    box = valid_box(rig)
    found: list[Array] = []
    missing = count
    while missing > 0:
        d = rng.uniform(box[:, 0], box[:, 1], (4 * count, 3))
        d = d[rig.margin(d) >= 0][:missing]
        found.append(d)
        missing -= len(d)
    return np.concatenate(found)
