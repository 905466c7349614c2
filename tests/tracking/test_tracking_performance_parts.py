"""Parts of the performance solver against dense algebra, finite differences and simulated motion."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.optimize
from example_model import LANDMARKS_ANATOMICAL, example_arrays, example_meta

from jawusd.evaluator import JawRig
from jawusd.formats.performance import Performance, SolveState, write_performance
from jawusd.formats.poses import read_parameters
from jawusd.formats.tracks import LOST, load_tracks, save_tracks
from jawusd.geometry import (
    LANDMARKS,
    make_transform,
    relative_pose,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_log,
    transform_point,
)
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.annotator import DRAWN, AnnotatorPrior
from jawusd.tracking.contour.equations import OutlineSums
from jawusd.tracking.performance.attempts import Attempts, Trial, Usual
from jawusd.tracking.performance.coordinates import HEAD, JAW, LOCAL, OPENING, Coordinates, Pose
from jawusd.tracking.performance.instant import CLOSED_MM, Misfit, bound_equations, rig_gain
from jawusd.tracking.performance.motion import measured_motion
from jawusd.tracking.performance.results import tracks_of
from jawusd.tracking.performance.system import TakeSystem
from jawusd.tracking.performance.unknowns import Unknowns

COUNT = 7
BORDERS = AnnotatorPrior(common=(0.0, 0.0, 0.0), arch=(0.4, 0.08, 0.02), camera=(0.0, 0.0), frames=5.0)


@pytest.fixture(scope="module")
def jaw():
    same = {"T_anatomical_skull": np.eye(4), "T_rest": np.eye(4), "landmarks": LANDMARKS_ANATOMICAL}
    return JawRig({**example_arrays(), **same}, example_meta())


@pytest.mark.parametrize("frames", [3, 6, 7])
@pytest.mark.parametrize("shared", [0, 3])
def test_the_take_is_solved_as_the_dense_system_is(frames, shared):
    rng = np.random.default_rng(frames)
    local = 4
    system, size = TakeSystem(frames, local, shared), frames * local + shared
    H, g = np.zeros((size, size)), np.zeros(size)
    for k in range(frames):
        A, right = rng.normal(size=(local + shared + 2, local + shared)), rng.normal(size=local + shared)
        system.add_frame(k, A.T @ A, right)
        index = np.r_[k * local : (k + 1) * local, frames * local : size]
        H[np.ix_(index, index)] += A.T @ A
        g[index] += right
    for add, pattern, width in ((system.add_bends, [1, -2, 1], 2), (system.add_steps, [-1, 1], 1)):
        count = frames - len(pattern) + 1
        value, weight = rng.normal(size=(count, width)), rng.random((count, width))
        add(slice(1, 1 + width, None), value, weight)
        for k, j in np.ndindex(count, width):
            row = np.zeros(size)
            row[[(k + a) * local + 1 + j for a in range(len(pattern))]] = pattern
            H += weight[k, j] * np.outer(row, row)
            g -= weight[k, j] * row * value[k, j]
    own, take = system.solve()
    np.testing.assert_allclose(np.r_[own.ravel(), take], np.linalg.solve(H, g), atol=1e-12)
    inverse, found = np.linalg.inv(H), system.covariance()
    for k in range(frames):
        block = found.own[k] + found.response[k] @ found.shared @ found.response[k].T
        np.testing.assert_allclose(block, inverse[k * local :, k * local :][:local, :local], atol=1e-12)


def test_motion_is_told_from_the_noise_of_the_poses(jaw):
    """Smooth motion under noise as large as its second differences."""

    class Arch:
        centre = np.array([0.0, 4.0, -9.0])

    coordinates, rng = Coordinates(jaw, (Arch, Arch)), np.random.default_rng(0)
    t = np.arange(900.0)
    d = np.column_stack([12 + 6 * np.sin(0.2 * t), 2 * np.sin(0.25 * t), 1 + 1.5 * np.cos(0.22 * t)])
    move = np.array([5.0, 8.0, 6.0]) * np.sin(0.15 * t[:, None] + np.arange(3))
    true = [Pose(make_transform(np.eye(3), m), x) for m, x in zip(move, d)]
    shaken = [
        Pose(p.head @ se3_exp(np.r_[np.zeros(3), rng.normal(0, 0.1, 3)]), p.d + rng.normal(0, 0.1, 3)) for p in true
    ]
    good = np.ones(len(t), bool)
    wanted, found = (measured_motion(coordinates, poses, good, 24.0).bend for poses in (true, shaken))
    np.testing.assert_allclose(np.sqrt(found[3:]), np.sqrt(wanted[3:]), rtol=0.5)
    none = measured_motion(coordinates, shaken, ~good, 24.0)  # nothing seen: variances of the rig's own take
    assert (none.bend > 0).all() and (none.step > 0).all()


def inside_by(bias_px, jaw, frames, annotator):
    """Return the estimated bias of free edges from borders on random normals with a common offset."""
    rng, scan = np.random.default_rng(4), SimpleNamespace(centre=np.array([0.0, 4.0, -9.0]))
    coordinates = Coordinates(jaw, (scan, scan))
    unknowns = Unknowns(coordinates, frames, 1, annotator=annotator)
    none = unknowns.start()
    system, pose = TakeSystem(frames, unknowns.local, unknowns.shared), Pose(np.eye(4), np.array([8.0, 0.0, 0.0]))
    for k in range(frames):
        twist, free = rng.normal(0, 5, (2, 200, 6)), np.zeros((200, 3))
        free[:150, 0] = free[150:, 1] = 1.0
        moved = free[:, 0] * bias_px + rng.normal(0, 0.3, (2, 200))
        outline = SimpleNamespace(
            precision=np.swapaxes(twist, 1, 2)[:, None] @ twist[:, None],
            gradient=np.einsum("rni,rn->ri", twist, moved)[:, None],
            habit_slope=(free.T @ twist)[:, None],
            habit_weight=np.tile(free.T @ free, (2, 1, 1, 1)),
            habit_distance=(moved @ free)[:, None],
        )
        fit = SimpleNamespace(pose=pose, solution=SimpleNamespace(outline=outline), found=np.ones(2, bool), growth=None)
        system.add_frame(k, *unknowns.frame(fit, np.full(2, 1.0 / 10.0), fit.pose.d))
    system.add_shared(*unknowns.prior(none))
    return unknowns.moved([pose] * frames, none, *system.solve())[1].habits[:, 0, 0]


def test_many_frames_reveal_a_bias_as_far_as_the_prior_allows(jaw):
    """Masks of a take share errors, so the bias is estimated as from a few frames, and only within its prior."""
    narrow = replace(DRAWN, common=(0.1, 0.1, 0.05), arch=(0.1, 0.1, 0.05))
    np.testing.assert_allclose(inside_by(-0.5, jaw, 40, DRAWN), -0.5, atol=0.1)
    np.testing.assert_allclose(inside_by(-0.5, jaw, 40, BORDERS), -0.5, atol=0.1)
    assert (inside_by(-0.5, jaw, 40, narrow) > -0.3).all()
    many = replace(narrow, frames=40.0)
    np.testing.assert_allclose(inside_by(-0.5, jaw, 40, many), -0.5, atol=0.1)


def test_layers_without_variance_are_no_unknowns(jaw):
    """The borders of colours have one bias per arch, which all cameras share."""
    scan = SimpleNamespace(centre=np.array([0.0, 4.0, -9.0]))
    unknowns = Unknowns(Coordinates(jaw, (scan, scan)), 4, 3, annotator=BORDERS)
    poses = [Pose(np.eye(4), np.zeros(3))] * 4
    _, state = unknowns.moved(poses, unknowns.start(), np.zeros((4, LOCAL)), np.arange(1.0, 7.0))
    assert unknowns.shared == 6
    np.testing.assert_array_equal(state.habits, np.repeat([[[1, 2, 3]], [[4, 5, 6]]], 3, axis=1))


@pytest.fixture
def performance(jaw):
    rng = np.random.default_rng(3)
    t = np.arange(COUNT)
    d = np.column_stack([7.0 + t, 0.3 * t, 0.1 * t])
    A = rng.normal(size=(COUNT, 9, 9)) * np.r_[[1e-3] * 3, [0.1] * 6]
    found = np.ones((COUNT, 2), bool)
    found[4, 1] = False
    return Performance(
        frames=10 + t,
        T_world_upper=se3_exp(rng.normal(size=(COUNT, 6)) * [0.1, 0.1, 0.1, 9, 9, 9]),
        d=d,
        covariance=np.swapaxes(A, 1, 2) @ A,
        rig_covariance=jaw.parameter_covariance(d),
        rig_pose_covariance=np.zeros((COUNT, 6, 6)),
        pivot=np.array([0.0, 5.0, -9.0]),
        state=np.where(found.all(1), SolveState.SOLVED, SolveState.CARRIED).astype(np.int8),
        found=found,
        use=np.repeat(found[..., None], 2, axis=2),
        uncovered=np.full((COUNT, 2, 2), 0.01),
        residual_px=np.full((COUNT, 2), 0.4),
        matched_px=np.full((COUNT, 2), 900.0),
        margin_mm=np.asarray(jaw.margin(d)),
        valid=np.arange(COUNT) < COUNT - 1,
        verdict=["inside"] * (COUNT - 1) + ["off the model, outside"],
        camera_names=("a", "b"),
    )


def test_covariances_are_those_of_the_moved_poses(jaw, performance):
    """Compare with Monte Carlo over the nine unknowns."""
    tracks, p, k = tracks_of(performance, jaw), performance, 2
    rng, to = np.random.default_rng(0), make_transform(np.eye(3), p.pivot)
    steps = rng.multivariate_normal(np.zeros(9), p.covariance[k] * 1e-4, size=20_000)
    head = p.T_world_upper[k] @ to @ se3_exp(steps[:, :6]) @ se3_inverse(to)
    relative = jaw.pose(p.d[k] + steps[:, 6:])
    lower = head @ relative
    moved = {
        "upper": se3_log(head @ se3_inverse(tracks.T_world_upper[k])),
        "lower": se3_log(lower @ se3_inverse(tracks.T_world_lower[k])),
        "relative": se3_log(relative @ se3_inverse(tracks.T_upper_lower[k])),
    }
    for name, twists in moved.items():
        covariance = getattr(tracks, f"covariance_{name}")[k] * 1e-4
        scale = np.sqrt(np.diag(covariance))
        np.testing.assert_allclose(
            np.cov(twists.T) / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=0.06
        )


@pytest.mark.parametrize("fixed_head", [False, True])
def test_an_error_of_the_rig_moves_d_as_in_a_least_squares_fit(jaw, fixed_head):
    """Poses of both arches are measured with given precisions; the lower one deviates from the rig."""
    rng, centres = np.random.default_rng(5), np.array([[0.0, 4.0, -9.0], [0.0, -6.0, -8.0]])
    coordinates = Coordinates(jaw, [SimpleNamespace(centre=centre) for centre in centres])
    pose = Pose(se3_exp(rng.normal(size=6) * [0.3, 0.3, 0.3, 9, 9, 9]), np.array([8.0, 1.0, 0.5]))
    roots = [rng.normal(size=(6, 6)) * np.r_[[9.0] * 3, [1.0] * 3] for _ in range(2)]
    error = np.r_[rng.normal(size=3) * 1e-5, rng.normal(size=3) * 1e-3]
    true = np.stack([pose.head, pose.head @ se3_exp(error) @ jaw.pose(pose.d)])
    places = [transform_point(T, centre) for T, centre in zip(coordinates.arches(pose), centres)]
    about = [se3_adjoint(make_transform(np.eye(3), -place)) for place in places]

    def residual(step):
        full = np.r_[np.zeros(6), step] if fixed_head else step
        moved = coordinates.arches(coordinates.moved(pose, full))
        twists = [se3_log(one @ se3_inverse(other)) for one, other in zip(moved, true)]
        return np.concatenate([root @ move @ twist for root, move, twist in zip(roots, about, twists)])

    found = scipy.optimize.least_squares(residual, np.zeros(3 if fixed_head else 9), x_scale="jac", xtol=1e-14).x[-3:]
    slopes = coordinates.slopes(pose).arches
    matrix = sum(slope.T @ root.T @ root @ slope for slope, root in zip(slopes, roots))
    gain = rig_gain(coordinates, pose, matrix, roots[1].T @ roots[1], fixed_head=fixed_head)
    np.testing.assert_allclose(gain @ error, found, rtol=2e-3, atol=1e-7)


def test_a_misfit_is_eliminated_as_the_full_system_would(jaw):
    """Compare a step, and the misfit after it, with the solution of the equations that include the misfit."""
    rng, unknowns = np.random.default_rng(2), 11
    coordinates = Coordinates(jaw, [SimpleNamespace(centre=np.array([0.0, y, -9.0])) for y in (4.0, -6.0)])
    pose = Pose(np.eye(4), np.array([8.0, 1.0, 0.5]), rng.normal(size=6) * 0.01)
    root, slope = rng.normal(size=(9, 6)), rng.normal(size=(6, unknowns))
    precision, error = root.T @ root, coordinates.slopes(pose).error
    gradient, of_rig = rng.normal(size=6), np.diag(rng.uniform(0.1, 1.0, 6))
    coupling, left = precision @ slope, rng.normal(size=unknowns)
    own = slope.T @ coupling + np.eye(unknowns)
    misfit = Misfit(of_rig, error, pose.misfit, (precision, gradient), coupling)
    step = np.linalg.solve(own + misfit.matrix, left + misfit.right)
    cross = coupling.T @ error
    full = np.block([[own, cross], [cross.T, error.T @ precision @ error + np.linalg.inv(of_rig)]])
    right = np.r_[left, error.T @ gradient - np.linalg.solve(of_rig, pose.misfit)]
    expected = np.linalg.solve(full, right)
    np.testing.assert_allclose(step, expected[:unknowns], atol=1e-9)
    np.testing.assert_allclose(misfit.after(step), pose.misfit + expected[unknowns:], atol=1e-9)


@pytest.mark.parametrize(("beyond_mm", "pull_mm"), [(0.3, 0.3), (3.0, 0.6), (9.0, 0.6)])
def test_the_pull_of_the_bound_does_not_grow_far_beyond_it(jaw, beyond_mm, pull_mm):
    coordinates = Coordinates(jaw, [SimpleNamespace(centre=np.zeros(3))] * 2)
    inside, outside = np.array([8.0, 0.0, 0.5]), np.array([8.0, 30.0, 0.5])
    share = scipy.optimize.brentq(lambda x: jaw.margin(inside + x * (outside - inside)) + beyond_mm, 0.0, 1.0)
    d = inside + share * (outside - inside)
    matrix, right = bound_equations(coordinates, d)
    gradient = jaw.margin_gradient(d)
    np.testing.assert_allclose(right[JAW], pull_mm * gradient, rtol=1e-3)
    np.testing.assert_allclose(matrix[JAW, JAW] * beyond_mm, pull_mm * np.outer(gradient, gradient), rtol=1e-3)


def test_teeth_cannot_close_below_the_smallest_captured_opening(jaw):
    scan = SimpleNamespace(centre=np.array([0.0, 4.0, -9.0]))
    coordinates = Coordinates(jaw, (scan, scan))
    assert coordinates.closed_mm <= 0.0
    d = np.array([coordinates.closed_mm - 1.0, 0.0, 0.0])
    matrix, right = bound_equations(coordinates, d)
    step = np.linalg.solve(matrix[JAW, JAW] + 1e-6 * np.eye(3), right[JAW])
    assert step[0] == pytest.approx(1.0, abs=0.05) and matrix[OPENING, OPENING] > CLOSED_MM**-2.0
    assert not matrix[HEAD].any()


def test_the_bound_can_be_linearised_where_a_step_ends(jaw):
    scan = SimpleNamespace(centre=np.array([0.0, 4.0, -9.0]))
    coordinates = Coordinates(jaw, (scan, scan))
    d, closed = np.array([coordinates.closed_mm + 2.0, 0.0, 0.5]), np.array([coordinates.closed_mm - 1.0, 0.0, 0.5])
    assert not bound_equations(coordinates, d)[0].any()
    matrix, right = bound_equations(coordinates, d, at=closed)
    step = np.linalg.solve(matrix[JAW, JAW] + 1e-6 * np.eye(3), right[JAW])
    assert step[0] == pytest.approx(-2.0, abs=0.05)
    outside = np.array([8.0, 30.0, 0.5])
    margin, gradient = jaw.margin(outside), jaw.margin_gradient(outside)
    near = outside - 2.0 * gradient
    matrix, right = bound_equations(coordinates, near, at=outside)
    step = gradient * (right[JAW] @ gradient) / (gradient @ matrix[JAW, JAW] @ gradient)
    assert margin + gradient @ (near + step - outside) == pytest.approx(0.0, abs=1e-9)


def test_deviations_of_d_include_the_error_of_the_rig(jaw, performance):
    table = {name: {"base_mm": 0.4} for name in LANDMARKS}
    unsure = JawRig(jaw.arrays, {**jaw.meta, "uncertainty": table})
    of_rig = unsure.parameter_covariance(performance.d)
    found = replace(performance, rig_covariance=of_rig).sigma_d
    without = replace(performance, rig_covariance=np.zeros_like(of_rig)).sigma_d
    np.testing.assert_allclose(found**2 - without**2, np.einsum("fii->fi", of_rig), rtol=1e-9)
    assert (found > without).all() and (0.1 < np.sqrt(np.einsum("fii->fi", of_rig)).max() < 1.0)


def test_tracks_hold_the_poses_and_what_was_not_seen(jaw, performance, tmp_path):
    save_tracks(tmp_path / "take.npz", tracks_of(performance, jaw))
    tracks = load_tracks(tmp_path / "take.npz")
    np.testing.assert_allclose(
        relative_pose(tracks.T_world_upper, tracks.T_world_lower), jaw.pose(performance.d), atol=1e-9
    )
    assert tracks.tracked().all() and tracks.prior_aided.all() and (tracks.sigma_mm > 0).all()
    assert (tracks.status == LOST).sum() == 1 and tracks.status[4, 1] == LOST
    assert np.isnan(tracks.raw_T_upper_lower[4]).all() and np.isfinite(tracks.raw_T_world_upper[4]).all()
    solved = tracks.solved
    np.testing.assert_array_equal(solved.d, performance.d)
    np.testing.assert_array_equal(solved.sigma_mm, performance.sigma_d)
    np.testing.assert_array_equal(solved.state, performance.state)
    assert solved.valid.tolist() == performance.valid.tolist() and not solved.valid.all()


@pytest.mark.parametrize("applied", [True, False])
def test_tracks_say_whether_the_lower_scan_was_moved(jaw, performance, applied):
    T = make_transform(np.eye(3), [0.0, 0.3, 0.0]).tolist()
    moved = JawRig(jaw.arrays, {**jaw.meta, "registration": {"applied": applied, "T": T}})
    assert ("registration" in tracks_of(performance, moved).meta) == applied


def test_the_table_is_read_as_parameters(performance, tmp_path):
    write_performance(tmp_path / "take.csv", performance, 25.0)
    frames, d = read_parameters(tmp_path / "take.csv")
    np.testing.assert_array_equal(frames, performance.frames)
    np.testing.assert_allclose(d, performance.d, atol=1e-6)
    lines = (tmp_path / "take.csv").read_text().splitlines()
    assert lines[5].endswith("inside,carried") and lines[-1].endswith("off the model; outside,solved")


def bad_arches(score_px, uncovered_px, usual, residual_px=1.0):
    """Return which arches of a trial do not fit, from contour, uncovered pixels and residuals of the masks, (2, C).

    Residuals of 1 px, and matches of half of the visible 640 px, are usual.
    """
    score_px, uncovered_px = np.array(score_px), np.array(uncovered_px)
    outline = OutlineSums.zeros(score_px.shape[1])._replace(
        score_px=score_px, matched_px=1.5 * score_px, weight=score_px, square=score_px * np.square(residual_px)
    )
    trial = Trial(
        pose=Pose(np.eye(4), np.zeros(3)),
        solution=SimpleNamespace(outline=outline, visible_px=np.full(score_px.shape, 640.0)),
        use=np.ones(score_px.shape, bool),
        uncovered_px=uncovered_px,
        mask_px=np.full(score_px.shape, 4000.0),
    )
    assert (trial.uncovered < TrackingConfig().lost_coverage).all()
    usually = Usual(np.ones(2), np.full(2, usual), np.full(2, 0.5))
    return Attempts(SimpleNamespace(config=TrackingConfig()), np.ones(2), usually).bad(trial).tolist()


@pytest.mark.parametrize(
    ("uncovered_px", "usual", "lost"),
    [(100.0, 0.01, False), (160.0, 0.01, True), (160.0, 0.03, False), (400.0, 0.03, True)],
)
def test_an_arch_is_lost_if_the_penalty_of_a_mask_exceeds_its_matched_contour(uncovered_px, usual, lost):
    assert bad_arches([[40.0], [320.0]], [[uncovered_px], [30.0]], usual) == [lost, False]


def test_the_penalty_of_one_mask_is_not_balanced_by_the_contour_of_another():
    assert bad_arches([[40.0, 320.0], [320.0, 320.0]], [[160.0, 30.0], [30.0, 30.0]], 0.01) == [True, False]


@pytest.mark.parametrize(
    ("score_px", "residual_px", "bad"),
    [(40.0, 2.2, True), (40.0, 1.4, False), (280.0, 2.0, False)],
    ids=["wrong mask", "closing lips", "wrong rig"],
)
def test_the_residuals_of_one_mask_are_not_balanced_by_those_of_another(score_px, residual_px, bad):
    residuals = [[1.0, residual_px], [1.0, 1.0]]
    assert bad_arches([[320.0, score_px], [320.0, 320.0]], np.full((2, 2), 30.0), 0.01, residuals) == [bad, False]
