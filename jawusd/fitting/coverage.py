"""What the captured poses can show: which of the three parameters they move."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jawusd.fitting.data import TrainingData
from jawusd.fitting.gauge_fit import path_gauge
from jawusd.fitting.path import SMALLEST_OPENING_MM, fit_path

Array = NDArray[np.float64]

PARAMETERS = ("opening", "laterotrusion", "protrusion")

# Ranges (1 to 99 %) below which a parameter is noise and habit, not an exercise [mm]
_SMALLEST_RANGE_MM = np.array([SMALLEST_OPENING_MM, 3.0, 2.5])


def shown_parameters(data: TrainingData) -> tuple[NDArray[np.bool_], list[str]]:
    """Tell which of opening, laterotrusion and protrusion the poses exercise.

    Args:
        data: the training data.

    Returns:
        Shown or not, shape (3,), and one sentence for each parameter that is not.
    """
    u = data.displacement()
    gx, gz, _, _ = path_gauge(fit_path(u, data.weights)).path(-u[:, 1])
    side, front = u[:, 0] - gx, u[:, 2] - gz
    # A lateral excursion carries the jaw forward by itself; only what goes beyond that shows protrusion.
    arch = np.stack([np.abs(side), side, side**2], axis=-1)
    front = front - arch @ np.linalg.lstsq(arch, front, rcond=1e-6)[0]
    free = np.stack([-u[:, 1], side, front], axis=-1)
    spread = np.percentile(free, 99, axis=0) - np.percentile(free, 1, axis=0)
    shown = spread >= _SMALLEST_RANGE_MM
    sentences = [
        f"The poses do not show {name}: it varies by {spread[i]:.1f} mm (at least {_SMALLEST_RANGE_MM[i]:g} mm are "
        f"needed), so its slider only shifts the jaw within that range without learned rotation."
        for i, name in enumerate(PARAMETERS)
        if not shown[i]
    ]
    return shown, sentences
