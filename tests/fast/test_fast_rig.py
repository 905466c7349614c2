"""The compiled rig gives what `JawRig` gives, to 1e-10, for whatever `JawRig` takes; and what outside oracles give."""

import os
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import reference_jaw as reference
from example_model import example_arrays, example_meta, touching_arrays
from scipy.optimize import least_squares

from jawusd.evaluator import JawRig, Reason
from jawusd.geometry.se3 import se3_exp, transform_points

RIGS = {kind: JawRig(example_arrays(kind), example_meta(kind)) for kind in ("anchored", "additive")}
SHAPES = [(), (1,), (3, 1, 2), (0,), (2, 0)]
FROM_D = ("pose", "twist", "jacobian", "margin", "margin_gradient", "normalized", "captured_distance")
ABSURD = [np.nan, np.inf, -np.inf, 1e9, 1e300]
SUPPORT = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1] / "support")}  # where the example model is
VERDICT = ("valid", "reason", "residual_mm", "margin_mm", "d")


@pytest.fixture(params=sorted(RIGS))
def kind(request):
    return request.param


@pytest.fixture
def rig(kind):
    return RIGS[kind]


@pytest.fixture(scope="module")
def accelerate():
    """Return the function; its import compiles, which only the process that runs these tests need do."""
    from jawusd.fast import accelerate

    return accelerate


@pytest.fixture(scope="module")
def compiled(accelerate):
    return {kind: accelerate(rig) for kind, rig in RIGS.items()}


@pytest.fixture
def fast(kind, compiled):
    return compiled[kind]


def random_d(rig, shape, beyond_mm=6.0, seed=0):
    """Parameters inside and outside the bound."""
    low, high = rig.d_range.T
    return np.random.default_rng(seed).uniform(low - beyond_mm, high + beyond_mm, (*shape, 3))


def noisy_poses(rig, shape, seed=0):
    """Poses up to a few mm off the model, some of them from outside the bound."""
    rng = np.random.default_rng(seed)
    return se3_exp(rng.normal(size=(*shape, 6)) * ([0.01] * 3 + [0.5] * 3)) @ rig.pose(random_d(rig, shape, 0.0, seed))


def spoil(values):
    """Put numbers no jaw has into some rows (n, ...)."""
    flat = values.reshape(len(values), -1)
    for row, value in enumerate(ABSURD):
        flat[3 * row + 1, row % flat.shape[1]] = value
    return values


def assert_same_verdicts(found, expected, atol=1e-10):
    for name in VERDICT:
        a, b = getattr(found, name), getattr(expected, name)
        assert np.shape(a) == np.shape(b) and np.asarray(a).dtype == np.asarray(b).dtype
        np.testing.assert_allclose(a, b, rtol=0, atol=atol)


@pytest.mark.parametrize("name", FROM_D)
def test_functions_of_d_agree_inside_and_outside_the_bound(rig, fast, name):
    d = random_d(rig, (3000,))
    assert 100 < (rig.margin(d) > 0).sum() < 2900
    np.testing.assert_allclose(getattr(fast, name)(d), getattr(rig, name)(d), rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", FROM_D)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_functions_of_d_take_any_batch_shape_and_type(rig, fast, name, shape, dtype):
    d = random_d(rig, shape).astype(dtype)
    found, expected = getattr(fast, name)(d), getattr(rig, name)(d)
    assert np.shape(found) == np.shape(expected) and found.dtype == np.float64
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", [*FROM_D, "project"])
def test_rows_that_are_not_finite_give_nan_and_leave_the_others_alone(rig, fast, name):
    d = random_d(rig, (20,))
    clean = getattr(fast, name)(d)
    spoilt = spoil(d.copy())
    out, bad = getattr(fast, name)(spoilt), ~np.isclose(spoilt, d).all(axis=1)
    assert bad.sum() == len(ABSURD) and np.isnan(out[bad]).all()
    np.testing.assert_allclose(out[~bad], clean[~bad], rtol=0, atol=1e-10)
    for row in np.flatnonzero(bad):
        assert np.isnan(getattr(fast, name)(spoilt[row])).all()


@pytest.mark.parametrize("name", [*FROM_D, "project"])
def test_wrong_shapes_are_refused_in_the_same_words(rig, fast, name):
    with pytest.raises(ValueError) as expected:
        getattr(rig, name)(np.zeros((3, 2)))
    with pytest.raises(ValueError) as found:
        getattr(fast, name)(np.zeros((3, 2)))
    assert str(found.value) == str(expected.value)


@pytest.mark.parametrize("x", [0.0, 1e-7, 1e-3, 0.3, 60.0])
@pytest.mark.parametrize("name", ["pose", "twist", "jacobian", "margin", "margin_gradient"])
def test_small_parameters_and_those_far_outside_agree(rig, fast, name, x):
    """Across the seams of series and closed forms."""
    d = x * np.array([[1.0, 0.5, -0.3], [-0.2, 0.5, 0.3], [0.0, 0.0, 0.5]])
    expected = getattr(rig, name)(d)
    np.testing.assert_allclose(getattr(fast, name)(d), expected, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose([getattr(fast, name)(row) for row in d], expected, rtol=1e-10, atol=1e-10)


def test_margins_far_away_agree(rig, fast):
    d = np.array([[1e8, 0.0, 0.0], [0.0, -2e7, 0.0], [-5e3, 1e3, 0.0]])
    np.testing.assert_allclose(fast.margin(d), rig.margin(d), rtol=1e-12)
    np.testing.assert_allclose(fast.margin_gradient(d), rig.margin_gradient(d), atol=1e-12)


def test_poses_agree_with_50_digits(fast):
    for d in ([20.0, 3.0, 1.0], [-4.0, 12.0, -9.0], [1e-7, 0.0, 0.0], [70.0, 3.0, 3.0]):
        exact = np.array([[float(x) for x in row] for row in reference.pose(fast.arrays, d).tolist()])
        np.testing.assert_allclose(fast.pose(d), exact, atol=1e-11)


def test_jacobian_agrees_with_differences_of_the_twist(fast):
    d, h = random_d(fast, (100,)), 1e-4
    steps = h * np.eye(3)
    near, far = ([fast.twist(d + k * e) - fast.twist(d - k * e) for e in steps] for k in (1, 2))
    numeric = np.stack([(8 * a - b) / (12 * h) for a, b in zip(near, far)], axis=-1)
    np.testing.assert_allclose(fast.jacobian(d), numeric, atol=2e-8)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_encode_and_validate_agree_for_any_batch_shape_and_type(rig, fast, shape, dtype):
    T = noisy_poses(rig, shape).astype(dtype)
    for found, expected in zip(fast.encode(T), rig.encode(T)):
        assert np.shape(found) == np.shape(expected)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)
    assert_same_verdicts(fast.validate(T), rig.validate(T))
    d = random_d(rig, shape).astype(dtype)
    assert_same_verdicts(fast.validate_parameters(d), rig.validate_parameters(d))


def test_encode_agrees_on_and_off_the_model(rig, fast):
    for T in (rig.pose(random_d(rig, (2000,), 0.0)), noisy_poses(rig, (2000,)), noisy_poses(rig, (500,)) * 1.0003):
        for found, expected in zip(fast.encode(T), rig.encode(T)):
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


def test_matrices_that_are_no_poses_are_not_encoded(rig, fast):
    T = rig.pose([[10.0, 1.0, 0.5]] * 3)
    T[1], T[2, :3, 0] = 2 * np.eye(4), -T[2, :3, 0]
    for found in (rig.encode(T), fast.encode(T)):
        np.testing.assert_array_equal(np.isnan(found.d).all(1), [False, True, True])
        np.testing.assert_array_equal(np.isnan(found.residual_mm), [False, True, True])


def test_encode_is_as_near_as_scipy_finds(fast):
    T = noisy_poses(fast, (30,), seed=5)
    landmarks = fast.landmarks
    d, residual_mm = fast.encode(T)

    def miss(x, pose):
        return (transform_points(fast.pose(x), landmarks) - transform_points(pose, landmarks)).ravel()

    for row, pose in enumerate(T):
        oracle = least_squares(miss, d[row] + 0.5, args=(pose,), xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert abs(np.sqrt(2 * oracle.cost / len(landmarks)) - residual_mm[row]) < 1e-8


def test_encode_inside_the_bound_is_as_near_as_the_plain_rig_finds(rig, fast):
    """Searches along the bound end a step of 1e-6 mm from the bottom: parameters agree to that, residuals closer."""
    T = noisy_poses(rig, (200,), seed=3)
    (found, left_mm), (expected, expected_mm) = fast.encode(T, inside=True), rig.encode(T, inside=True)
    np.testing.assert_allclose(left_mm, expected_mm, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6)
    assert (fast.margin(found) >= -1e-12).all()
    covariance = np.diag([1e-4] * 3 + [0.04] * 3)
    for a, b in zip(fast.encode(T[:50], covariance=covariance), rig.encode(T[:50], covariance=covariance)):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-10)


def test_verdicts_agree_for_every_reason(rig, fast):
    T = spoil(np.concatenate([noisy_poses(rig, (400,)), rig.pose(random_d(rig, (400,)))]))
    T[100:110, :3, :3] *= 1.01
    T[110:115, :3, 0] *= -1.0
    T[115:120, 3] = [0.0, 0.0, 0.1, 1.0]
    limits = {"residual_limit_mm": 0.6, "tolerance_mm": 0.2}
    for given in ({}, limits, {"bound": "polygons"}, {"times_s": np.arange(800) / 25.0, "speed_limit_mm_s": 900.0}):
        found, expected = fast.validate(T, **given), rig.validate(T, **given)
        assert_same_verdicts(found, expected)
    assert {Reason(int(r)) for r in fast.validate(T).reason} >= {
        Reason.VALID,
        Reason.NOT_FINITE,
        Reason.NOT_RIGID,
        Reason.OFF_MODEL,
        Reason.OUTSIDE_BOUNDS,
    }
    for row in (0, 1, 105, 112, 117, 500):
        assert_same_verdicts(fast.validate(T[row]), rig.validate(T[row]))


def test_verdicts_on_parameters_agree(rig, fast):
    d = spoil(random_d(rig, (500,)))
    speed = {"times_s": np.arange(500) / 25.0, "speed_limit_mm_s": 900.0}
    for given in ({}, {"tolerance_mm": 1.0}, {"bound": "polygons"}, speed):
        assert_same_verdicts(fast.validate_parameters(d, **given), rig.validate_parameters(d, **given))


def test_project_agrees(rig, fast):
    """To 1e-9: a point on the bound is left up to 1e-10 mm inside, as rounding has it."""
    d = random_d(rig, (1000,))
    np.testing.assert_allclose(fast.project(d), rig.project(d), rtol=0, atol=1e-9)


def test_inverse_kinematics_agrees(rig, fast):
    points = rig.landmarks[:3]
    start = rig.project(random_d(rig, (300,), 0.0))
    targets = transform_points(rig.pose(start), points) + np.random.default_rng(1).normal(size=(300, 1, 3)) * 2.0
    for given in ({"start": start}, {}):
        (found, left_mm), (expected, expected_mm) = fast.ik(points, targets, **given), rig.ik(points, targets, **given)
        np.testing.assert_allclose(left_mm, expected_mm, rtol=0, atol=1e-8)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)
        assert (fast.margin(found) >= -1e-12).all()


def test_read_only_strided_and_big_endian_arrays_are_taken(rig, fast):
    d = random_d(rig, (50, 2))
    expected = rig.pose(d[:, 1])
    np.testing.assert_allclose(fast.pose(d[:, 1]), expected, atol=1e-10)
    np.testing.assert_allclose(fast.pose(np.broadcast_to(d[:, 1], (3, 50, 3)))[2], expected, atol=1e-10)
    np.testing.assert_allclose(fast.pose(np.asfortranarray(d[:, 1])), expected, atol=1e-10)
    np.testing.assert_allclose(fast.pose(d[:, 1].astype(">f8")), expected, atol=1e-10)
    np.testing.assert_allclose(fast.pose(d[0, 1].tolist()), expected[0], atol=1e-10)
    frozen = noisy_poses(rig, (4,))
    frozen.flags.writeable = False
    np.testing.assert_allclose(fast.encode(frozen)[0], rig.encode(frozen)[0], atol=1e-10)


def test_results_do_not_share_memory(fast):
    first = fast.pose([5.0, 0.0, 0.0])
    kept = first.copy()
    fast.pose([15.0, 1.0, 1.0])
    np.testing.assert_array_equal(first, kept)


def test_compiled_functions_refuse_other_types(fast):
    """Or they would be compiled anew, for seconds, inside somebody's playback."""
    from jawusd.fast import kernels

    with pytest.raises(TypeError):
        kernels.poses(fast.kernels._packed_model, np.zeros((2, 3), dtype=np.float32), np.empty((2, 4, 4)))


def test_rig_pickles_and_evaluates_in_threads(accelerate, fast):
    from jawusd.fast.kernels import CompiledKernels

    d, T = random_d(fast, (32, 50)), noisy_poses(fast, (32, 50))
    copy = pickle.loads(pickle.dumps(fast))
    assert type(copy.kernels) is CompiledKernels
    with ThreadPoolExecutor(4) as pool:
        poses, codes = list(pool.map(copy.pose, d)), list(pool.map(lambda each: copy.encode(each)[0], T))
    np.testing.assert_array_equal(poses, [fast.pose(x) for x in d])
    np.testing.assert_array_equal(codes, [fast.encode(each)[0] for each in T])
    assert accelerate(fast) is fast


def test_rig_works_in_a_forked_process(compiled, tmp_path):
    """Started elsewhere, so that it imports what these tests have compiled, not other sources in the current folder."""
    code = (
        "import multiprocessing, sys\n"
        "import numpy as np\n"
        "from example_model import example_arrays, example_meta\n"
        "from jawusd.evaluator import JawRig\n"
        "from jawusd.fast import accelerate\n"
        "rig = accelerate(JawRig(example_arrays(), example_meta()))\n"
        "d = rig.project(np.array([[20.0, 2.0, 1.0], [5.0, 0.0, 0.0]]))\n"
        "with multiprocessing.get_context('fork').Pool(2) as pool:\n"
        "    assert (pool.map(rig.pose, d) == rig.pose(d)).all()\n"
        "print('same')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=SUPPORT, cwd=tmp_path)
    assert done.stdout.strip() == "same", done.stderr


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("started", [True, False])
def test_inverse_kinematics_takes_any_batch_shape(rig, fast, shape, started):
    T = rig.pose(rig.project(random_d(rig, shape, 0.0)))
    start = np.array([5.0, 0.0, 0.5]) if started else None
    (found, left_mm), (expected, expected_mm) = (each.ik([0.0] * 3, T[..., :3, 3], start=start) for each in (fast, rig))
    assert found.shape == expected.shape and left_mm.shape == expected_mm.shape
    np.testing.assert_allclose(left_mm, expected_mm, rtol=0, atol=1e-5)


def test_a_rig_whose_teeth_meet_gives_what_the_evaluator_gives(accelerate):
    rig = JawRig({**example_arrays(), **touching_arrays()}, example_meta())
    fast, d = accelerate(rig), random_d(rig, (200,))
    for name in FROM_D:
        np.testing.assert_allclose(getattr(fast, name)(d), getattr(rig, name)(d), atol=1e-9, err_msg=name)
    np.testing.assert_allclose(fast.pose(d[0]), rig.pose(d[0]), atol=1e-12)
    T = noisy_poses(rig, (50,))
    np.testing.assert_allclose(fast.encode(T).d, rig.encode(T).d, atol=1e-7)
    for name in VERDICT[:2]:
        np.testing.assert_array_equal(getattr(fast.validate(T), name), getattr(rig.validate(T), name))
