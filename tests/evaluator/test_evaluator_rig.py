"""The rig's functions on batches of any shape and type, and its poses and derivatives in the skull frame."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import reference_jaw as reference
from example_model import example_arrays, example_meta, held_out_arrays
from scipy.spatial.transform import Rotation

from jawusd.base.errors import EvaluatorError
from jawusd.evaluator import JawRig
from jawusd.geometry.se3 import se3_exp, se3_log

RIGS = {kind: JawRig(example_arrays(kind), example_meta(kind)) for kind in ("anchored", "additive")}
SHAPES = [(), (1,), (3, 1, 2), (0,), (2, 0)]
FROM_D = {
    "pose": (4, 4),
    "twist": (6,),
    "jacobian": (6, 3),
    "margin": (),
    "margin_gradient": (3,),
    "project": (3,),
    "normalized": (3,),
    "denormalized": (3,),
    "captured_distance": (),
}


SEARCHED = {"project": 1e-6}  # [mm]: a search ends where it ends, of many rows elsewhere than of one


@pytest.fixture(params=sorted(RIGS))
def rig(request):
    return RIGS[request.param]


def random_d(rig, shape, seed=0):
    low, high = rig.d_range.T
    return np.random.default_rng(seed).uniform(low, high, (*shape, 3))


@pytest.mark.parametrize("name", FROM_D)
@pytest.mark.parametrize("shape", SHAPES)
def test_functions_of_d_take_any_batch_shape(rig, name, shape):
    """A batch gives what its rows give one by one, in the batch's shape."""
    d = random_d(rig, shape)
    out = getattr(rig, name)(d)
    assert out.shape == (*shape, *FROM_D[name])
    assert out.dtype == np.float64
    for index in np.ndindex(*shape):
        np.testing.assert_allclose(out[index], getattr(rig, name)(d[index]), atol=SEARCHED.get(name, 1e-10))


@pytest.mark.parametrize("name", FROM_D)
def test_rows_that_are_not_finite_give_nan_and_leave_the_others_alone(rig, name):
    d = random_d(rig, (5,))
    expected = getattr(rig, name)(d)
    d[1], d[3, 2] = np.nan, np.inf
    out = getattr(rig, name)(d)
    assert np.isnan(out[[1, 3]]).all()
    np.testing.assert_allclose(out[[0, 2, 4]], expected[[0, 2, 4]], atol=SEARCHED.get(name, 1e-10))
    assert np.isnan(getattr(rig, name)(d[1])).all()


@pytest.mark.parametrize("name", FROM_D)
def test_float32_is_computed_in_float64(rig, name):
    d = random_d(rig, (4,)).astype(np.float32)
    out = getattr(rig, name)(d)
    assert out.dtype == np.float64
    np.testing.assert_array_equal(out, getattr(rig, name)(d.astype(np.float64)))


@pytest.mark.parametrize("name", FROM_D)
def test_wrong_shapes_are_refused(rig, name):
    with pytest.raises(ValueError, match=r"\(\.\.\., 3\)"):
        getattr(rig, name)(np.zeros((3, 2)))


@pytest.mark.parametrize("bounds", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_encode_takes_any_batch_shape(rig, shape, bounds):
    T = rig.pose(random_d(rig, shape))
    d, residual_mm = rig.encode(T, inside=bounds)
    assert d.shape == (*shape, 3) and residual_mm.shape == shape
    d, residual_mm, of_d = rig.encode(T, inside=bounds, covariance=np.eye(6))
    assert d.shape == (*shape, 3) and residual_mm.shape == shape and of_d.shape == (*shape, 3, 3)


@pytest.mark.parametrize("shape", SHAPES)
def test_ik_takes_any_batch_shape(rig, shape):
    targets = rig.pose(random_d(rig, shape))[..., :3, 3]
    d, distance_mm = rig.ik([0.0, 0.0, 0.0], targets)
    assert d.shape == (*shape, 3) and distance_mm.shape == shape
    two = np.stack([targets, targets + 1.0], axis=-2)
    d, distance_mm = rig.ik([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], two, start=d)
    assert d.shape == (*shape, 3) and distance_mm.shape == shape


def test_long_batches_agree_with_short_ones(rig):
    """Batches are computed in chunks; the seams must not show."""
    d = random_d(rig, (5000,))
    np.testing.assert_allclose(rig.pose(d)[2040:2060], rig.pose(d[2040:2060]), atol=1e-12)
    found, residual_mm = rig.encode(rig.pose(d))
    np.testing.assert_allclose(found, d, atol=1e-8)
    np.testing.assert_allclose(residual_mm, 0.0, atol=1e-8)


def test_single_poses_agree_with_batches_and_with_50_digits(rig):
    d = np.concatenate([random_d(rig, (50,)), [[0, 0, 0], [70, 3, 3], [-9, -3, -3], [1e-7, 0, 0]]])
    batch = rig.pose(d)
    np.testing.assert_allclose([rig.pose(x) for x in d], batch, atol=1e-12)
    for i in (0, 50, 51, 52):
        exact = np.array([[float(x) for x in row] for row in reference.pose(rig.arrays, d[i]).tolist()])
        np.testing.assert_allclose(batch[i], exact, atol=1e-11)


def test_absurd_parameters_give_nan_not_exceptions(rig):
    assert np.isnan(rig.pose([1e300, 0.0, 0.0])).all()
    assert np.isnan(rig.margin([[1e300, 0.0, 0.0]])).all()
    assert np.isfinite(rig.margin([[1e8, 0.0, 0.0]])).all()


def test_poses_are_rigid_for_scipy(rig):
    T = rig.pose(random_d(rig, (100,)))
    np.testing.assert_allclose(Rotation.from_matrix(T[:, :3, :3]).as_matrix(), T[:, :3, :3], atol=1e-12)
    np.testing.assert_array_equal(T[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (100, 1)))


def test_rest_pose_is_the_closed_bite(rig):
    np.testing.assert_allclose(rig.pose([0.0, 0.0, 0.0]), rig.T_rest, atol=1e-12)
    np.testing.assert_allclose(rig.twist([0.0, 0.0, 0.0]), 0.0, atol=1e-12)


def test_twist_is_the_logarithm_relative_to_rest(rig):
    d = random_d(rig, (100,))
    T = rig.pose(d)
    np.testing.assert_allclose(se3_exp(rig.twist(d)) @ rig.T_rest, T, atol=1e-10)
    np.testing.assert_allclose(se3_log(T @ np.linalg.inv(rig.T_rest)), rig.twist(d), atol=1e-10)


def test_jacobian_agrees_with_differences_of_the_twist(rig):
    d, h = random_d(rig, (200,)), 1e-4
    numeric = np.stack(
        [
            (8 * (rig.twist(d + h * e) - rig.twist(d - h * e)) - rig.twist(d + 2 * h * e) + rig.twist(d - 2 * h * e))
            / (12 * h)
            for e in np.eye(3)
        ],
        axis=-1,
    )
    np.testing.assert_allclose(rig.jacobian(d), numeric, atol=2e-8)


def test_spatial_jacobian_agrees_with_differences_of_poses(rig):
    d, h = random_d(rig, (200,)), 1e-5
    apart = [rig.pose(d + h * e) @ np.linalg.inv(rig.pose(d - h * e)) for e in np.eye(3)]
    numeric = np.stack([se3_log(T) / (2 * h) for T in apart], axis=-1)
    np.testing.assert_allclose(rig.spatial_jacobian(d), numeric, atol=1e-7)
    np.testing.assert_allclose(rig.spatial_jacobian(d[0]), rig.spatial_jacobian(d)[0], atol=1e-12)


def test_point_jacobian_agrees_with_differences_of_points(rig):
    d, h = random_d(rig, (3, 2)), 1e-4
    points = rig.landmarks[:3]

    def moved(d):
        T = rig.pose(d)
        return np.einsum("...ij,pj->...pi", T[..., :3, :3], points) + T[..., None, :3, 3]

    numeric = np.stack(
        [
            (8 * (moved(d + h * e) - moved(d - h * e)) - moved(d + 2 * h * e) + moved(d - 2 * h * e)) / (12 * h)
            for e in np.eye(3)
        ],
        axis=-1,
    )
    jacobian = rig.point_jacobian(d, points)
    assert jacobian.shape == (3, 2, 3, 3, 3)
    np.testing.assert_allclose(jacobian, numeric, atol=1e-8)
    np.testing.assert_allclose(rig.point_jacobian(d, points[1]), jacobian[:, :, 1], atol=1e-12)
    with pytest.raises(ValueError, match="p_mandible"):
        rig.point_jacobian(d, [1.0, 2.0])


def test_rig_pickles_and_evaluates_in_threads(rig):
    d = random_d(rig, (64, 50))
    copy = pickle.loads(pickle.dumps(rig))
    rig.project(d[0])  # what a rig caches must not change what it pickles to
    assert pickle.dumps(rig) == pickle.dumps(copy)
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(copy.pose, d))
    np.testing.assert_array_equal(results, [rig.pose(x) for x in d])


def test_arrays_come_back_read_only(rig):
    given = example_arrays(rig.meta["kind"])
    assert set(rig.arrays) == set(given)
    for name, value in given.items():
        np.testing.assert_array_equal(rig.arrays[name], value)
    with pytest.raises(ValueError, match="read-only"):
        rig.incisor[0] = 1.0


def test_changing_the_given_arrays_does_not_change_the_rig():
    given = example_arrays()
    rig = JawRig(given, example_meta())
    before = rig.pose([20.0, 1.0, 1.0])
    given["spline_weights"] *= 2.0
    np.testing.assert_array_equal(rig.pose([20.0, 1.0, 1.0]), before)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"spline_weights": None}, 'no array "spline_weights"'),
        ({"incisor": np.zeros(2)}, r'"incisor" has shape \(2,\); expected \(3\)'),
        ({"slice_support": np.zeros((33, 15))}, '"slice_support" has shape'),
        ({"spline_weights": np.zeros((44, 3))}, "expected 43: one per centre and 3 for the linear part"),
        ({"incisor": np.array([0.0, np.nan, 0.0])}, '"incisor" contains values that are not finite'),
        ({"incisor": np.array(["a", "b", "c"])}, '"incisor" is not numeric'),
        ({"incisor": np.array([10**400, 0, 0], dtype=object)}, '"incisor" is not numeric'),
        ({"incisor": np.array([0.0, -1e200, 0.0])}, '"incisor" has magnitudes up to 1e\\+200; the maximum is 1e\\+09'),
        ({"landmarks": np.zeros((0, 3))}, '"landmarks" has 0 points'),
        ({"T_rest": np.diag([1.0, 2.0, 1.0, 1.0])}, '"T_rest" is not rigid'),
        ({"slice_softness_mm": np.array(0.0)}, '"slice_softness_mm" is 0.0; it must be positive'),
        ({"slice_d1": np.zeros(33)}, '"slice_d1" must contain at least two increasing values'),
        ({"d_range": np.zeros((3, 2))}, '"d_range"'),
        ({"tolerance_mm": np.array(-0.5)}, '"tolerance_mm" must not be negative'),
        ({"slice_directions": np.tile([[1.0, 0.0]], (16, 1))}, "do not surround the section"),
        ({"slice_directions": np.tile([[2.0, 0.0]], (16, 1))}, "unit vectors"),
        ({"polygon_d1d2_counts": np.array([3])}, '"polygon_d1d2_counts"'),
    ],
)
def test_damaged_arrays_are_refused_by_name(change, message):
    arrays = example_arrays() | change
    arrays = {name: value for name, value in arrays.items() if value is not None}
    with pytest.raises(EvaluatorError, match=message):
        JawRig(arrays, example_meta())


def test_unknown_kind_is_refused():
    with pytest.raises(EvaluatorError, match='kind "quadratic"'):
        JawRig(example_arrays(), example_meta() | {"kind": "quadratic"})


def test_a_rig_says_what_it_is():
    rig = JawRig(example_arrays(), example_meta())
    assert repr(rig) == "<JawRig example, anchored, d1 0.0 to 42.0, d2 -9.0 to 9.5, d3 -1.5 to 7.0 mm>"
    assert rig.encode(rig.pose([5.0, 0.0, 0.0])).residual_mm < 1e-9
    assert rig.ranges(5.0).d2_min < 0 < rig.ranges(5.0).d2_max


COMPLEX = np.array([10.0, 1.0, 0.5]) + 1e-3j


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "call",
    [
        lambda rig: rig.pose(COMPLEX),
        lambda rig: rig.margin(COMPLEX),
        lambda rig: rig.margin(list(COMPLEX), bound="polygons"),
        lambda rig: rig.project(COMPLEX[None]),
        lambda rig: rig.encode(np.eye(4) + 0j),
        lambda rig: rig.validate(np.eye(4) + 0j),
        lambda rig: rig.ik(COMPLEX, COMPLEX),
        lambda rig: rig.ik(COMPLEX.real, COMPLEX.real, start=COMPLEX),
        lambda rig: rig.ranges(10 + 1j),
        lambda rig: rig.interpolate([0.0], COMPLEX[None], 0.0),
        lambda rig: rig.keep_inside([0.0], COMPLEX[None]),
        lambda rig: rig.normalized(COMPLEX),
    ],
)
def test_complex_numbers_are_refused(call):
    with pytest.raises(ValueError, match="must be real numbers"):
        call(JawRig(example_arrays(), example_meta()))


def test_held_out_frames_are_stated_and_checked():
    arrays = {**example_arrays(), "tolerance_mm": np.array(1.0), **held_out_arrays()}
    rig = JawRig(arrays, example_meta())
    words = "76 % of held-out frames lie within the tolerance of 1.0 mm"
    assert rig.held_out.words == f"{words}; 95 % within 4.2 mm"
    assert JawRig({**arrays, "held_out_p95_mm": np.array(0.8)}, example_meta()).held_out.words == words
    assert JawRig(example_arrays(), example_meta()).held_out is None
    for name, wrong in (("held_out_share", 1.1), ("held_out_share", -0.1), ("held_out_p95_mm", -1.0)):
        with pytest.raises(EvaluatorError, match="held_out"):
            JawRig({**arrays, name: np.array(wrong)}, example_meta())


@pytest.mark.parametrize("bound", ["slices", "polygons"])
def test_margin_of_one_d_is_a_float_wherever_it_lies(bound):
    rig = RIGS["anchored"]
    for d in ([5.0, 0.0, 0.0], [2e4, 0.0, 0.0], [np.nan, 0.0, 0.0]):
        assert isinstance(rig.margin(d, bound=bound), float)
        assert rig.margin([d], bound=bound).shape == (1,)


@pytest.mark.parametrize("d", ["10,0,0", ["10", "0", "0"], [None, 0.0, 0.0], [b"1", b"0", b"0"]])
def test_text_is_no_number(d):
    rig = RIGS["anchored"]
    for call in (rig.pose, rig.margin, rig.project, rig.validate_parameters):
        with pytest.raises(ValueError, match="d must be real numbers"):
            call(d)
