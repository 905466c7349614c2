"""Add to a jaw model how fast the jaw moved in the take it was fitted to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jawusd.evaluator.speeds import Speeds
from jawusd.formats.model import JawModel

_FASTEST_MM_S2 = 3e4  # three times gravity: poses that jump, no motion


def with_speeds(model: JawModel, fps: float) -> JawModel:
    """Return a model with the speeds of its take at a rate [1/s].

    Frames that took no part in the fit are left out. The model stays as it was if too few frames follow each other, or
    if no jaw moves like this.
    """
    d = np.where(model.trained[:, None], model.d, np.nan)
    gaps = np.flatnonzero(np.diff(model.frames) != 1) + 1
    try:
        speeds = Speeds.of_take(np.insert(d, gaps, np.nan, axis=0), fps)
    except ValueError:
        return model
    if speeds.rms_mm_s2.max() > _FASTEST_MM_S2:
        return model
    return replace(model, arrays={**model.arrays, **speeds.arrays()})
