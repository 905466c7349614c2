"""Performances of a known jaw: unknowns, a take with lips closed in some frames, one and several cameras."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import small_take
from rig_take import COUNT, HIDDEN, seen, solved, tip_error_mm, write_masks

from jawusd.base.errors import TrackingError
from jawusd.evaluator import JawRig
from jawusd.evaluator.skin import SkinJaw
from jawusd.formats.performance import SolveState
from jawusd.geometry import LANDMARKS, relative_pose, transform_point, transform_points
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.annotator import DRAWN
from jawusd.tracking.contour.equations import twist_between
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.performance import smoother
from jawusd.tracking.performance.attempts import FrameFit
from jawusd.tracking.performance.coordinates import JAW, LOCAL, Coordinates, Pose
from jawusd.tracking.performance.forward import ForwardPass
from jawusd.tracking.performance.instant import Equations, Expected, InstantSolver, bound_equations
from jawusd.tracking.performance.smoother import Smoother


def test_slopes_are_what_steps_do(jaw, scans, truth):
    coordinates = Coordinates(jaw, scans)
    pose = Pose(truth[1][5], truth[0][5])
    before = coordinates.arches(pose)
    for k, unit in enumerate(1e-5 * np.eye(LOCAL)):
        after = coordinates.arches(coordinates.moved(pose, unit))
        for r, slope in enumerate(coordinates.slopes(pose).arches):
            centre = transform_point(before[r], scans[r].centre)
            np.testing.assert_allclose(slope[:, k], twist_between(before[r], after[r], centre) / 1e-5, atol=2e-4)


def test_steps_and_moves_undo_each_other(jaw, scans, truth):
    coordinates = Coordinates(jaw, scans)
    a, b = (Pose(truth[1][k], truth[0][k]) for k in (3, 9))
    reached = coordinates.moved(a, coordinates.step(a, b))
    np.testing.assert_allclose(reached.head, b.head, atol=1e-9)
    np.testing.assert_allclose(reached.d, b.d, atol=1e-12)
    nearest = coordinates.pose_of(coordinates.arches(b))
    np.testing.assert_allclose(nearest.d, b.d, atol=1e-6)


@pytest.mark.parametrize(("count", "seen_mm", "hidden_mm"), [(3, 0.08, 0.5), (1, 0.5, 0.8)])
def test_a_performance_is_found_and_carried_through_closed_lips(jaw, scans, truth, folder, count, seen_mm, hidden_mm):
    found = solved(jaw, scans, truth, folder, small_take.CAMERAS[:count])
    error = tip_error_mm(jaw, found, truth)
    assert error[seen()].max() < seen_mm and error[list(HIDDEN)].max() < hidden_mm
    assert (found.state[seen()] == SolveState.SOLVED).all() and (found.state[list(HIDDEN)] == SolveState.CARRIED).all()
    sigma = found.sigma_d
    assert sigma[list(HIDDEN)].min() > 2 * np.median(sigma[seen()])
    crown = scans[0].vertices[::50]
    head = np.linalg.norm(
        transform_points(found.T_world_upper, crown) - transform_points(truth[1], crown), axis=-1
    ).mean(1)
    assert head[seen()].max() < 2.5 * seen_mm


def test_sigma_covers_what_a_biased_annotator_does_to_depth(jaw, scans, truth, tmp_path, monkeypatch):
    """One camera; outlines outside of the upper teeth and inside of the lower ones."""
    folder = write_masks(tmp_path, jaw, truth, small_take.CAMERAS[:1], (1.1, -0.4))

    def z2():
        found = solved(jaw, scans, truth, folder, small_take.CAMERAS[:1])
        away = (found.d - truth[0])[seen()]
        return np.einsum("fi,fij,fj->f", away, np.linalg.inv(found.covariance[seen(), 6:, 6:]), away).mean() / 3

    assert z2() < 2
    none = replace(DRAWN, common=(0.01, 0.01, 0.01), arch=(0.01, 0.01, 0.01), camera=(0.01, 0.01))
    monkeypatch.setattr("jawusd.tracking.contour.annotator.DRAWN", none)
    assert z2() > 4


def with_patch(mask):
    """Return a mask with a large patch beside the teeth."""
    rows, columns = np.nonzero(mask)
    return cv2.circle(mask.copy(), (int(columns.max()), int(rows.max())), int(np.ptp(columns)) // 3, 255, -1)


def eroded(mask):
    """Return a mask whose outline lies 7 px inside of the teeth, which it does not leave uncovered."""
    return np.where(cv2.distanceTransform(mask, cv2.DIST_L2, 5) > 7, 255, 0).astype(np.uint8)


@pytest.mark.parametrize("change", [with_patch, eroded])
@pytest.mark.parametrize(("count", "most_mm"), [(3, 0.1), (2, 0.3)])
def test_a_wrong_mask_in_one_of_several_cameras_costs_no_frame(
    jaw, scans, truth, folder, tmp_path, count, most_mm, change
):
    """The wrong mask is left out; the other masks of the frame are used."""
    spoilt, k = shutil.copytree(folder, tmp_path / "spoilt"), 8
    path = small_take.png(spoilt, "cam1", "lower", k)
    cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)))
    found = solved(jaw, scans, truth, spoilt, small_take.CAMERAS[:count])
    assert found.state[k] == SolveState.SOLVED and tip_error_mm(jaw, found, truth)[k] < most_mm
    unused = np.argwhere(~found.use[seen()])
    np.testing.assert_array_equal(unused, [[np.flatnonzero(seen() == k)[0], 1, 1]])


def test_a_wrong_mask_that_the_first_pass_used_is_left_out_later(jaw, scans, truth, folder, tmp_path, monkeypatch):
    spoilt, k = shutil.copytree(folder, tmp_path / "spoilt"), 8
    path = small_take.png(spoilt, "cam1", "lower", k)
    cv2.imwrite(str(path), eroded(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)))

    def everything_used(self, expected, instant):
        attempts = self._attempts
        trial = attempts.attempt(expected.pose, expected, instant, instant.present, attempts.config.wide_gates_px)
        return FrameFit(trial.pose, trial.solution, trial.use, instant.present, trial.uncovered)

    monkeypatch.setattr(ForwardPass, "_fit", everything_used)
    found = solved(jaw, scans, truth, spoilt, small_take.CAMERAS[:2])
    assert not found.use[k, 1, 1] and found.use[k].sum() == 3
    assert tip_error_mm(jaw, found, truth)[k] < 0.3


def test_a_jaw_that_the_rig_cannot_reproduce_moves_no_head(jaw, scans, truth, tmp_path):
    """Two cameras; in two of the frames, one of these has no mask of the upper teeth."""
    strange = range(6, 10)
    misfits = {k: np.array([0.03, 0.0, 0.0, 0.6, -1.3, 2.0]) for k in strange}
    folder = write_masks(tmp_path, jaw, truth, small_take.CAMERAS[:2], misfits=misfits)
    for k in (6, 9):
        small_take.png(folder, "cam1", "upper", k).unlink()
    table = {name: {"base_mm": 0.4, "per_mm": 0.0} for name in LANDMARKS}
    unsure, crown = JawRig(jaw.arrays, {**jaw.meta, "uncertainty": table}), scans[0].vertices[::50]

    def head_mm(rig):
        found = solved(rig, scans, truth, folder, small_take.CAMERAS[:2])
        away = transform_points(found.T_world_upper, crown) - transform_points(truth[1], crown)
        return np.linalg.norm(away, axis=-1).mean(1)[strange].max()

    found = head_mm(unsure), head_mm(jaw)
    assert found[0] < 0.25 < 0.5 < found[1], found


@pytest.mark.parametrize("step_mm", [3.0, 6.0, 9.0])
def test_a_jaw_that_moves_far_to_the_second_frame_is_found(jaw, scans, truth, tmp_path, step_mm):
    """Lips cover parts of the teeth, so that the centres of teeth and masks are apart."""
    d, head = truth[0].copy(), truth[1]
    d[1:, 0] += step_mm
    folder = write_masks(tmp_path, jaw, (d, head), small_take.CAMERAS[:1])
    for path in sorted(folder.rglob("*.png")):
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        upper, rows = path.parent.name == "upper", np.nonzero(mask)[0]
        covered = slice(0, int(np.quantile(rows, 0.4))) if upper else slice(int(np.quantile(rows, 0.6)), None)
        mask[covered] = 0
        cv2.imwrite(str(path), mask)
    found = solved(jaw, scans, (d, head), folder, small_take.CAMERAS[:1], off_mm=0.2)
    assert (found.state[seen()] == SolveState.SOLVED).all()
    assert tip_error_mm(jaw, found, (d, head))[seen()].max() < 0.8


def test_a_jaw_far_outside_the_bound_is_measured_by_d(jaw, scans, truth, tmp_path):
    """The stated error of the rig, which is large there, lets no misfit replace the deviation of d."""
    d, head = truth[0].copy(), truth[1]
    d[:, (0, 2)] += np.array([14.0, 10.0]) * np.exp(-(((np.arange(COUNT)[:, None] - 6.0) / 3.0) ** 2))
    table = {name: {"base_mm": 0.05, "per_mm": 0.5} for name in LANDMARKS}
    unsure = JawRig(jaw.arrays, {**jaw.meta, "uncertainty": table})
    folder = write_masks(tmp_path, jaw, (d, head), small_take.CAMERAS)
    found = solved(unsure, scans, (d, head), folder, small_take.CAMERAS)
    assert unsure.margin(d[6]) < -5
    assert tip_error_mm(jaw, found, (d, head))[4:9].max() < 0.2


def test_skin_measures_the_jaw_while_one_camera_sees_no_teeth(jaw, scans, truth, tmp_path):
    """Skin with an unknown offset, and two strange faces with a large error; half of the frames show no teeth."""
    hidden, strange = np.arange(6, 20), np.array([11, 12])
    usual = np.setdiff1d(hidden, strange)
    write_masks(tmp_path, jaw, truth, small_take.CAMERAS[:1], hidden=hidden)
    measured = truth[0] + [0.5, -0.2, 0.2] + np.random.default_rng(6).normal(0, 0.2, (COUNT, 3))
    measured[strange] += 3.0
    familiar, covariance = ~np.isin(np.arange(COUNT), strange), np.tile(0.2 * np.eye(3), (COUNT, 1, 1))
    covariance[strange] *= 50.0

    def skin(frames, d, seen, heads):
        assert len(frames) == len(d) == len(heads) == COUNT and frames[0] == small_take.FIRST
        np.testing.assert_array_equal(np.flatnonzero(~seen), hidden)
        return SkinJaw(measured, covariance, familiar)

    carried, found = (solved(jaw, scans, truth, tmp_path, small_take.CAMERAS[:1], skin=s) for s in (None, skin))
    without, errors = (tip_error_mm(jaw, one, truth)[usual].mean() for one in (carried, found))
    assert errors < 0.35 < 1.0 < without, errors
    z2 = ((found.d - truth[0]) ** 2 / found.sigma_d**2)[hidden].mean()
    assert 0.1 < z2 < 2.0 and (found.sigma_d[usual] < 0.6 * carried.sigma_d[usual]).all()
    assert found.sigma_d[strange].min() > 2 * found.sigma_d[usual].max()
    assert (found.state[hidden] == SolveState.SKIN).all()
    assert (carried.state[hidden] == SolveState.CARRIED).all()
    assert (np.delete(found.state, hidden) == SolveState.SOLVED).all()


@pytest.mark.parametrize("cameras", [1, 3])
def test_the_bound_pulls_a_jaw_inside_but_makes_it_no_surer(jaw, scans, truth, cameras):
    """The jaw is invisible and some millimetres outside its bound."""
    instants = InstantSolver(ContourSolver(scans, TrackingConfig()), Coordinates(jaw, scans))
    none = np.zeros((2, cameras), bool)

    def smoothed(d):
        fits = [FrameFit(Pose(truth[1][0], d), None, none, none, np.full(none.shape, np.nan))] * 5
        return Smoother(instants, None, range(5), 25.0, cameras).run(fits)

    away = truth[0][0] + [0.0, 12.0, 0.0]
    inside, beyond = smoothed(truth[0][0]), smoothed(away)
    assert jaw.margin(away) < -1 < -0.1 < jaw.margin(beyond.fits[0].pose.d) < 0
    np.testing.assert_allclose(beyond.covariance[:, 6:, 6:], inside.covariance[:, 6:, 6:], rtol=1e-6)


def test_shared_errors_of_borders_add_to_the_variance_of_the_residuals(jaw, scans, truth, monkeypatch):
    instants = InstantSolver(ContourSolver(scans, TrackingConfig()), Coordinates(jaw, scans))
    none = np.zeros((2, 1), bool)
    fits = [FrameFit(Pose(truth[1][0], truth[0][0]), None, none, none, np.full(none.shape, np.nan))] * 5
    monkeypatch.setattr(smoother, "outline_variance", lambda *_: np.array([3.0, 1.0]))
    smoothing, weights = Smoother(instants, None, range(5), 25.0, 1, shared_px3=2.0), []
    system = smoothing._system

    def weighted(fits, state, weight, *more):
        weights.append(weight)
        return system(fits, state, weight, *more)

    monkeypatch.setattr(smoothing, "_system", weighted)
    smoothing.run(fits)
    np.testing.assert_allclose(weights, np.tile([1 / 5, 1 / 3], (len(weights), 1)))


@pytest.mark.parametrize("bounds", [1, 5])
def test_smoothing_does_not_close_the_jaw_farther_than_the_teeth(jaw, scans, truth, monkeypatch, bounds):
    """The outlines ask for a step from a jaw that is slightly open to one that is closed by 1.5 mm too far."""
    monkeypatch.setattr(smoother, "_BOUND_ROUNDS", bounds)
    instants = InstantSolver(ContourSolver(scans, TrackingConfig()), Coordinates(jaw, scans))
    closed_mm, asked = instants.coordinates.closed_mm, np.r_[np.zeros(6), -2.0, 0.0, 0.0]
    d = np.array([closed_mm + 0.5, 0.0, 0.5])

    def system(fits, state, weight, motion, slow, bound_at):
        matrix, right = bound_equations(instants.coordinates, fits[0].pose.d, bound_at[0])
        step = np.linalg.solve(np.eye(9) + matrix, asked + right)
        return SimpleNamespace(solve=lambda: (step[None], np.zeros(0)))

    smoothing = Smoother(instants, None, range(1), 25.0, 1)
    monkeypatch.setattr(smoothing, "_system", system)
    none = np.zeros((2, 1), bool)
    fits = [FrameFit(Pose(truth[1][0], d), None, none, none, np.full(none.shape, np.nan))]
    step, _ = smoothing._step(fits, None, None, None, None)
    below_mm = closed_mm - (d + step[0, JAW])[0]
    assert below_mm == pytest.approx(0.0 if bounds > 1 else 1.5, abs=0.05)


@pytest.mark.parametrize(("judged_mm", "step_mm", "again"), [(0.0, 0.2, True), (0.3, 0.2, False), (0.3, 0.4, True)])
def test_residuals_are_looked_at_again_after_long_steps(jaw, scans, truth, monkeypatch, judged_mm, step_mm, again):
    solver = ContourSolver(scans, replace(TrackingConfig(), judged_mm=judged_mm))
    instants, finals = InstantSolver(solver, Coordinates(jaw, scans)), []
    monkeypatch.setattr(instants, "linearise", lambda *_, final=False: finals.append(final))
    equations = Equations(np.eye(9), np.r_[np.zeros(8), step_mm], SimpleNamespace(after=lambda step: np.zeros(6)))
    monkeypatch.setattr(instants, "equations", lambda *_: equations)
    start = Pose(truth[1][0], truth[0][0])
    found = instants.align(start, [], np.ones((2, 0), bool), (2.0,), Expected(start, np.zeros(9)), np.ones(2))
    assert finals == [False, True][: 1 + again]
    np.testing.assert_allclose(found.pose.d - start.d, [0, 0, step_mm], atol=1e-9)


def test_a_start_elsewhere_is_refused(jaw, scans, truth, folder):
    with pytest.raises(TrackingError, match="do not fit the masks"):
        solved(jaw, scans, truth, folder, small_take.CAMERAS, off_mm=25.0)


@pytest.mark.parametrize("seed", [2, 7, 11])
def test_a_wrong_start_is_refused_and_never_followed(jaw, scans, truth, folder, seed):
    try:
        found = solved(jaw, scans, truth, folder, small_take.CAMERAS[:1], off_mm=5.0, seed=seed)
    except TrackingError as error:
        assert "do not fit the masks" in str(error)
    else:
        assert tip_error_mm(jaw, found, truth)[seen()].max() < 1.5


def test_relative_poses_are_the_rigs(jaw, scans, truth):
    coordinates = Coordinates(jaw, scans)
    pose = Pose(truth[1][2], truth[0][2])
    np.testing.assert_allclose(relative_pose(*coordinates.arches(pose)), jaw.pose(pose.d), atol=1e-12)


def test_a_wrong_focal_length_is_found(jaw, scans, truth, folder):
    camera = small_take.CAMERAS[0]
    K = camera.K.copy()
    K[:2, :2] *= 1.06
    wrong = replace(camera, K=K)
    found = solved(jaw, scans, truth, folder, [wrong], free_focal=True)
    factor, sigma = found.notes["focal"][camera.name]
    assert abs(factor * 1.06 - 1) < 0.015 and sigma < 0.02
    assert tip_error_mm(jaw, found, truth)[seen()].max() < 0.5


def test_a_worn_camera_sees_one_head(jaw, scans, truth, tmp_path):
    """Motion with the head of the first frame in all frames."""
    still = (truth[0], np.repeat(truth[1][:1], COUNT, axis=0))
    write_masks(tmp_path, jaw, still, small_take.CAMERAS[:1])
    found = solved(jaw, scans, still, tmp_path, small_take.CAMERAS[:1], fixed_head=True)
    assert np.ptp(found.T_world_upper, axis=0).max() == 0.0
    assert tip_error_mm(jaw, found, truth)[seen()].max() < 0.4
    head = transform_points(found.T_world_upper[0], scans[0].vertices) - transform_points(
        still[1][0], scans[0].vertices
    )
    assert np.linalg.norm(head, axis=-1).max() < 0.5 and np.isfinite(found.covariance).all()
