"""Clearances: interpolation, gradient, verdicts, and arrays that make no field."""

import numpy as np
import pytest
from example_model import example_arrays, example_meta
from scipy.interpolate import RegularGridInterpolator

from jawusd.base.errors import EvaluatorError
from jawusd.evaluator import JawRig
from jawusd.evaluator.contact import ContactField
from jawusd.evaluator.verdicts import Reason

FIRST, STEP, SHAPE = np.array([-1.0, -6.0, -2.0]), np.array([0.5, 1.0, 0.8]), (9, 13, 8)


def contact_arrays(seed=0):
    values = np.random.default_rng(seed).uniform(-2.0, 2.0, SHAPE)
    return ContactField(FIRST, STEP, values, 0.4, 0.05, -0.3).arrays("teeth")


def touching_rig(**changes):
    return JawRig({**example_arrays(), **contact_arrays(), **changes}, example_meta())


def test_clearance_is_that_of_scipy():
    rig = touching_rig()
    axes = [first + step * np.arange(n) for first, step, n in zip(FIRST, STEP, SHAPE)]
    oracle = RegularGridInterpolator(axes, 0.01 * contact_arrays()["contact_values"].reshape(SHAPE))
    d = np.random.default_rng(1).uniform([a[0] for a in axes], [a[-1] for a in axes], (4, 500, 3))
    found = rig.clearance(d)
    assert found.clearance_mm.shape == (4, 500)
    np.testing.assert_allclose(found.clearance_mm, oracle(d), atol=1e-12)
    step = 1e-6
    inner = d[0][(np.abs((d[0] - FIRST) / STEP % 1 - 0.5) < 0.49).all(axis=1)]
    for axis, e in enumerate(np.eye(3)):
        slope = (oracle(inner + step * e) - oracle(inner - step * e)) / (2 * step)
        np.testing.assert_allclose(rig.clearance(inner).gradient[:, axis], slope, atol=1e-6)


def test_outside_the_grid_the_nearest_value_holds():
    rig = touching_rig()
    far = rig.clearance([[30.0, 0.3, 0.1], [3.0, 0.3, 0.1]])
    assert far.clearance_mm[0] == far.clearance_mm[1]
    assert far.gradient[0, 0] == 0.0
    gone = rig.clearance([np.nan, 0.0, 0.0])
    assert np.isnan(gone.clearance_mm) and np.isnan(gone.gradient).all()


def test_one_pose_is_judged_as_many_are():
    """One is computed in floats, many as arrays."""
    field = touching_rig().contact
    last = FIRST + STEP * (np.array(SHAPE) - 1)
    d = np.random.default_rng(2).uniform(FIRST - 2.0, last + 2.0, (300, 3))
    d = np.concatenate([d, [FIRST, last, [np.nan, 0, 0], [0, np.inf, 0], [1e8, -1e8, 0]]])
    together = field.clearance(d).clearance_mm
    np.testing.assert_allclose([field._single(*row) for row in d.tolist()], together, atol=1e-12)
    limits = np.nan_to_num(together, nan=0.0) + field.error_mm + np.where(np.arange(len(d)) % 2, 1e-6, -1e-6)
    for row, value, limit in zip(d, together, limits):
        assert field.collides(row[None], limit).tolist() == [bool(value < limit - field.error_mm)]
        assert field.collides_at(row[None], limit) == bool(value < limit - field.error_mm)


def test_colliding_poses_are_refused():
    values = np.zeros(SHAPE)
    values[:3] = -50  # half a millimetre below an opening of 0 mm
    rig = touching_rig(contact_values=values.ravel())
    d = np.array([[2.0, 0.0, 0.2], [0.0, 0.0, 0.2]])
    assert rig.validate_parameters(d).reason.tolist() == [0, Reason.TEETH_COLLIDE]
    found = rig.validate(rig.pose(d))
    assert found.reason.tolist() == [0, Reason.TEETH_COLLIDE]
    assert found.words() == ["inside", "teeth collide"]
    # measured poses may come as close as captured ones did
    near = touching_rig(contact_values=values.ravel() / 2)
    assert near.validate(near.pose(d)).valid.all()
    assert near.validate_parameters(d, tolerance_mm=None).valid.all()
    for authored in (near.validate_parameters(d), near.validate(near.pose(d), tolerance_mm=0.0)):
        assert authored.reason.tolist() == [0, Reason.TEETH_COLLIDE]


def test_condyles_have_clearances_that_reject_no_pose():
    values = np.random.default_rng(2).uniform(-1.0, 1.5, SHAPE)
    field = ContactField(FIRST, STEP, np.round(values, 2), -0.4, 0.05, -0.3)
    rig = JawRig({**example_arrays(), **contact_arrays(), **field.arrays("condyles")}, example_meta())
    d = np.random.default_rng(1).uniform(FIRST, FIRST + STEP * (np.array(SHAPE) - 1), (200, 3))
    found = rig.clearance(d, of="condyles")
    np.testing.assert_allclose(found.clearance_mm, field.clearance(d).clearance_mm, atol=1e-12)
    np.testing.assert_array_equal(rig.clearance(d).clearance_mm, touching_rig().clearance(d).clearance_mm)
    plain = touching_rig()
    np.testing.assert_array_equal(rig.validate(rig.pose(d)).reason, plain.validate(plain.pose(d)).reason)
    assert rig.model_hash != plain.model_hash
    with pytest.raises(EvaluatorError, match="no clearance data for the condyles"):
        plain.clearance(d, of="condyles")
    with pytest.raises(ValueError, match="tongue"):
        rig.clearance(d, of="tongue")


def test_a_rig_without_scans_says_so():
    rig = JawRig(example_arrays(), example_meta())
    assert rig.contact is None
    with pytest.raises(EvaluatorError, match="has no clearance data for the teeth"):
        rig.clearance([0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("contact_shape", np.array([9.0, 13.0, 7.0]), "contact_shape"),
        ("contact_step_mm", np.array([0.5, 0.0, 0.8]), "must be positive"),
        ("contact_limit_mm", np.array(0.1), "at most 0"),
        ("contact_closed_mm", np.array(np.nan), "finite"),
        ("contact_first_mm", np.zeros(2), "shape"),
    ],
)
def test_damaged_clearances_are_refused(name, value, words):
    with pytest.raises(EvaluatorError, match=words):
        touching_rig(**{name: value})


def test_a_missing_array_is_named():
    arrays = {**example_arrays(), **contact_arrays()}
    del arrays["contact_step_mm"]
    with pytest.raises(EvaluatorError, match="contact_step_mm"):
        JawRig(arrays, example_meta())
