"""Keys as splines: the same motion, in a separate layer."""

import numpy as np
import pytest
from example_rig import assert_valid_usd
from pxr import Usd

from jawusd.base.errors import RigError
from jawusd.rig import write_animation, write_splines

KEYS, VALUES = np.array([101, 120, 149]), np.array([[0, 0, 0], [15, 2, 1], [3, -2, 0]], dtype=float)


def test_splines_show_the_motion_of_the_samples(anchored_folder):
    animation = write_animation(anchored_folder / "anim_keys.usdc", anchored_folder / "actor.usda", KEYS, VALUES, 60)
    out = write_splines(anchored_folder / "anim_keys_splines.usda", animation, KEYS, VALUES, 60)
    assert_valid_usd(out)
    stage = Usd.Stage.Open(str(out))
    actor = stage.GetPrimAtPath("/Actor")
    for i in range(3):
        attribute = actor.GetAttribute(f"jaw:d{i + 1}")
        assert attribute.HasSpline() and len(attribute.GetSpline().GetKnots()) == 3
        for time in np.arange(101, 149, 3.7):
            assert attribute.Get(time) == pytest.approx(np.interp(time, KEYS, VALUES[:, i]), abs=1e-9)
    assert ".spline" not in (anchored_folder / "actor.usda").read_text()


@pytest.mark.parametrize(
    ("frames", "d"), [([], np.zeros((0, 3))), ([2, 1], np.zeros((2, 3))), ([1, 2], np.full((2, 3), np.nan))]
)
def test_keys_that_make_no_spline(anchored_folder, frames, d):
    with pytest.raises(RigError, match="increasing frames"):
        write_splines(anchored_folder / "s.usda", anchored_folder / "actor.usda", frames, d, 24)
