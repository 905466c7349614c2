"""Random keys, and what bringing their motion inside the bound does to it."""

from typing import NamedTuple

import numpy as np
from example_model import example_arrays, example_meta
from scipy.interpolate import PchipInterpolator

from jawusd.evaluator import JawRig


class Measured(NamedTuple):
    """Figures of one set of keys.

    ratio: largest step over the largest step of the keys' own curve; local_ratio: the largest of any frame over that of
    the curve in the same frame; margin_mm: smallest, at ten times the frame rate; overshoot_mm: how far the motion goes
    beyond the range of the keys; forced: at some opening on its way, nothing in that range is inside the bound;
    missed_mm: how far keys inside are moved.
    """

    ratio: float
    local_ratio: float
    margin_mm: float
    overshoot_mm: float
    missed_mm: float
    forced: bool


def hollow_rig():
    """Return the example rig with a waist: sections that close to a sixth at 20 mm of opening."""
    arrays = example_arrays()
    waist = 1.0 - 0.85 * np.exp(-(((arrays["slice_d1"] - 20.0) / 5.0) ** 2))
    return JawRig(arrays | {"slice_support": arrays["slice_support"] * waist[:, None]}, example_meta())


def random_keys(rig, seed, spread):
    """Return frames and keys, three to seven, anywhere in the box of the ranges widened by a share on every side."""
    rng = np.random.default_rng(seed)
    count = rng.integers(3, 8)
    low, high = rig.d_range.T
    keys = rng.uniform(low - spread * (high - low), high + spread * (high - low), (count, 3))
    if seed % 3 == 0:
        keys[1] = keys[0]  # a hold
    return np.cumsum(rng.integers(6, 40, count)).astype(float), keys


def own_curve(frames, keys, at, method):
    """Return the keys' curve by numpy and scipy, at rest before the first and after the last key."""
    if method == "linear":
        return np.stack([np.interp(at, frames, column) for column in keys.T], axis=1)
    held = np.concatenate([[frames[0] - 1], frames, [frames[-1] + 1]])
    return PchipInterpolator(held, np.concatenate([keys[:1], keys, keys[-1:]]))(at)


def leaves_range(rig, keys, openings):
    """Tell whether at one of the openings [mm] passed no d2 and d3 in the range of the keys are inside the bound."""
    (low2, low3), (high2, high3) = keys[:, 1:].min(axis=0), keys[:, 1:].max(axis=0)
    d1 = np.linspace(openings.min(), openings.max(), 60)
    d = np.stack(np.meshgrid(d1, np.linspace(low2, high2, 41), np.linspace(low3, high3, 41), indexing="ij"), axis=-1)
    return bool((rig.margin(d).max(axis=(1, 2)) < 0).any())


def measured(rig, frames, keys, method):
    """Return the figures of keys brought inside as `jawusd animate` does it."""
    at = np.arange(frames[0], frames[-1] + 1)
    own = own_curve(frames, keys, at, method)
    kept = rig.keep_inside(at, rig.interpolate(frames, keys, at, method, inside=False))
    d = kept.d[kept.given]
    step, own_step = (np.linalg.norm(np.diff(x, axis=0), axis=1) for x in (d, own))
    tenth = np.arange(at[0], at[-1] + 0.05, 0.1)
    between = np.stack([np.interp(tenth, kept.times, column) for column in kept.d.T], axis=1)
    nearest = np.clip(between, keys.min(0), keys.max(0))
    beyond = np.abs(between - nearest).max(axis=1)[rig.margin(nearest) >= 0]
    overshoot_mm = beyond.max(initial=0.0)
    forced = overshoot_mm > 0.05 and leaves_range(rig, keys, between[:, 0])
    valid = rig.is_inside(keys)
    missed = np.linalg.norm(d[np.isin(at, frames)] - keys, axis=1)[valid].max(initial=0.0)
    still = own_step <= 1e-9
    assert step[still].max(initial=0.0) <= 1e-9
    local = ((step - 1e-9)[~still] / own_step[~still]).max(initial=0.0)
    largest = own_step.max()
    return Measured(step.max() / largest, local, rig.margin(between).min(), overshoot_mm, missed, forced)
