"""Speeds of the take that a model was fitted to."""

import numpy as np
import pytest
from example_rig import example_rig

from jawusd.evaluator import JawRig, Speeds
from jawusd.fitting.fit import with_speeds
from jawusd.formats.model import JawModel

FPS = 30.0


def model_of(frames, d, trained):
    rig = example_rig()
    return JawModel(dict(rig.arrays), frames, d, np.zeros(len(frames)), trained, rig.meta)


def test_gaps_and_frames_left_out_are_no_motion():
    times = np.arange(600) / FPS
    d = np.stack([10 + 8 * np.sin(5 * times), 3 * np.cos(3 * times), np.sin(4 * times)], axis=1)
    expected = Speeds.of_take(d, FPS)
    keep = np.ones(600, dtype=bool)
    keep[200:260] = False  # a gap, after which the jaw has moved
    trained = np.ones(600, dtype=bool)
    trained[400] = False
    d[400] += 30.0  # an outlier
    rig = JawRig(with_speeds(model_of(np.arange(600)[keep], d[keep], trained[keep]), FPS).arrays, example_rig().meta)
    np.testing.assert_allclose(rig.speeds.rms_mm_s, expected.rms_mm_s, rtol=0.1)
    np.testing.assert_allclose(rig.speeds.rms_mm_s2, expected.rms_mm_s2, rtol=0.1)


@pytest.mark.parametrize("d", [np.zeros((20, 3)), 1e3 * np.random.default_rng(0).normal(size=(200, 3))])
def test_short_takes_and_poses_that_jump_say_nothing(d):
    model = model_of(np.arange(len(d)), d, np.ones(len(d), dtype=bool))
    assert with_speeds(model, FPS) is model
