"""When attributes of a stage have samples or splines, and their values there."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from pxr import Usd

from jawusd.base.arrays import Array, Mask

if TYPE_CHECKING:
    from pxr import Ts  # not in OpenUSD 24.11

MOST_FRAMES = 220_000  # as many as are written, an hour at 60 per second


def key_times(attribute: Usd.Attribute) -> list[float]:
    """Return the times at which an attribute has samples; of a spline its knots and the whole frames between them."""
    spline = _spline_of(attribute)
    if spline is None:
        return list(attribute.GetTimeSamples())
    knots = np.array(sorted(spline.GetKnots()))
    first, last = np.ceil(knots.min(initial=np.inf)), np.floor(knots.max(initial=-np.inf))
    if not last - first < MOST_FRAMES:
        return knots.tolist()
    return np.union1d(knots, np.arange(first, last + 1)).tolist()


def values_at(attribute: Usd.Attribute, times: Iterable[float]) -> list[float | None]:
    """Return the values of an attribute, also where OpenUSD reads splines but does not evaluate them (25.02)."""
    spline = _spline_of(attribute)
    return [attribute.Get(time) if spline is None else spline.Eval(time) for time in times]


def _spline_of(attribute: Usd.Attribute) -> Ts.Spline | None:
    """Return the spline that gives an attribute its values; None where samples or a value of a stronger layer do."""
    if not hasattr(attribute, "HasSpline") or not attribute.HasSpline():  # OpenUSD 24.11 has no splines
        return None
    for spec in attribute.GetPropertyStack():
        strongest = next((name for name in ("timeSamples", "spline", "default") if spec.HasInfo(name)), None)
        if strongest:
            return attribute.GetSpline() if strongest == "spline" else None
    return None


def times_between(attributes: Iterable[Usd.Attribute]) -> tuple[Array, Mask]:
    """Return the times at which one of several attributes has samples, and the whole frames between them.

    Returns:
        Times, increasing, shape (n,), and which of them have samples, shape (n,).
    """
    keys = np.unique(np.concatenate([np.zeros(0), *(key_times(attribute) for attribute in attributes)]))
    first, last = np.ceil(keys.min(initial=np.inf)), np.floor(keys.max(initial=-np.inf))
    times = np.union1d(keys, np.arange(first, last + 1)) if 0 <= last - first < MOST_FRAMES else keys
    return times, np.isin(times, keys)


def time_codes(times: Array) -> list[Usd.TimeCode]:
    """Return time codes; without any time the default one."""
    return [Usd.TimeCode(time) for time in times.tolist()] or [Usd.TimeCode.Default()]
