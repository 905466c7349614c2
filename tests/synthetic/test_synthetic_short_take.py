"""The motion of short takes."""

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator
from subjects.short_take import _between


def test_motion_between_frames_is_that_of_scipys_monotone_cubic():
    rows = np.random.default_rng(0).normal(size=(9, 3))
    exact = PchipInterpolator(np.arange(9), rows)
    for t in np.linspace(1.0, 7.0, 25):  # scipy uses different slopes at the ends
        assert _between(rows, t) == pytest.approx(exact(t), abs=1e-12)
