"""The rig that ships with the package is small, whole, and of the present format."""

import numpy as np
import pytest
from example_rig import assert_valid_usd

from jawusd.rig.layout import CAPTURED_FILE, EXAMPLE_RIG, FORMAT_VERSION
from jawusd.rig.motion_read import read_poses_of_stage
from jawusd.rig.read import describe, load_rig

MOST_BYTES = 1_500_000


@pytest.fixture(scope="module")
def rig():
    return load_rig(EXAMPLE_RIG)


def test_it_is_small_and_of_the_present_format(rig):
    files = list(EXAMPLE_RIG.parent.iterdir())
    assert sum(file.stat().st_size for file in files) < MOST_BYTES
    assert {file.suffix for file in files} == {".usda", ".usdc"}
    about = describe(EXAMPLE_RIG)
    assert about["format_version"] == FORMAT_VERSION and about["actor"] == "example" and not about["onnx"]
    assert rig.meta["format"] == "jawusd-model/2" and rig.contact is not None and rig.speeds is not None


def test_it_is_a_valid_rig_of_a_person():
    assert_valid_usd(EXAMPLE_RIG)
    assert_valid_usd(EXAMPLE_RIG.parent / CAPTURED_FILE)


def test_its_take_is_a_jaw_that_opens_and_moves_to_both_sides(rig):
    frames, poses = read_poses_of_stage(EXAMPLE_RIG.parent / CAPTURED_FILE)
    assert len(frames) == 300 and (np.diff(frames) == 1).all()
    assert rig.validate(poses).valid.all()
    d, _ = rig.encode(poses)
    assert d[:, 0].max() > 35 and d[:, 1].min() < -4 and d[:, 1].max() > 4 and d[:, 2].max() > 4
