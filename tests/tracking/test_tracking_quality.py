"""Covariances, correlation length, prediction, and the views of a take."""

import numpy as np
import pytest
from bumpy_teeth import arch, jaw_poses, make_cameras, render_masks
from small_take import CAMERAS, FIRST, MESHES, OFFSETS, make_capture, write_masks

from jawusd.base.errors import TrackingError
from jawusd.formats.tracks import TRACKED
from jawusd.geometry import make_transform, relative_pose, se3_exp, se3_inverse, se3_log, transform_points
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.equations import motion_about, translation, twist_between
from jawusd.tracking.contour.frame_record import FrameSummary
from jawusd.tracking.contour.quality import (
    correlation_px,
    crown_sigma_mm,
    landmark_sigmas,
    relative_covariance,
    residual_px,
    twist_covariance,
    uncovered_px,
)
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import MaskViews, View, working_size
from jawusd.tracking.initialization.pose_search import shift_to_masks
from jawusd.tracking.sequence.history import History, MotionPredictor, SearchBudget

CONFIG = TrackingConfig()
SCANS = tuple(prepare_scan(m, n) for m, n in zip(MESHES, ("upper", "lower")))


def _random_covariance(rng, scale):
    A = rng.normal(size=(6, 6)) * scale
    return A @ A.T


def test_relative_covariance_agrees_with_sampling():
    rng = np.random.default_rng(0)
    scale = np.array([1e-3] * 3 + [0.05] * 3)[:, None]
    upper, lower = jaw_poses(3)[2]
    Cu, Cl = _random_covariance(rng, scale), _random_covariance(rng, scale)
    true_u = se3_exp(rng.multivariate_normal(np.zeros(6), Cu, 20000)) @ upper
    true_l = se3_exp(rng.multivariate_normal(np.zeros(6), Cl, 20000)) @ lower
    relative = relative_pose(upper, lower)
    twists = se3_log(relative_pose(true_u, true_l) @ se3_inverse(relative))
    C = relative_covariance(upper, Cu, Cl)
    assert np.abs(np.cov(twists.T) - C).max() / np.abs(C).max() < 0.05
    landmarks = np.array([[0, 0, 0], [45, 30, -70.0]])
    moved = transform_points(se3_exp(twists) @ relative, landmarks)
    spread = np.sqrt(moved.var(0).sum(-1))
    assert landmark_sigmas(relative, C, landmarks) == pytest.approx(spread, rel=0.03)


def test_landmark_sigmas_do_not_pair_poses_with_landmarks():
    poses = np.stack([make_transform(np.eye(3), [k, 0, 0]) for k in range(5)])
    C = np.tile(np.diag([0.01, 0, 0, 0, 0, 0]), (5, 1, 1))
    out = landmark_sigmas(poses, C, np.array([[0, k, 0.0] for k in range(5)]))
    assert out == pytest.approx(0.1 * np.tile(np.arange(5), (5, 1)))


@pytest.fixture(scope="module")
def noisy_fits():
    """Solutions and true poses for outline errors of 0.4 px, correlated over about 25 px, as in drawn masks."""
    rng = np.random.default_rng(6)
    solver, out = ContourSolver(SCANS, CONFIG), []
    for poses in jaw_poses(12):
        views = [
            View(
                c.projection_matrix(),
                c.centre_world(),
                render_masks(MESHES, poses, c, None, 0.4, rng, smooth_px=8.0),
                np.ones(2, bool),
            )
            for c in make_cameras()
        ]
        out.append((solver.solve(poses, views, CONFIG.gates_from(0.0)), poses))
    return out


def test_covariances_match_the_errors_made(noisy_fits):
    length = np.median([correlation_px(s, CONFIG) for s, _ in noisy_fits])
    assert 4 < length < 20
    nees = []
    for solution, truth in noisy_fits:
        for r in (0, 1):
            C = twist_covariance(solution, r, residual_px(solution)[r], length)
            x = se3_log(truth[r] @ se3_inverse(solution.poses[r]))
            nees.append(x @ np.linalg.solve(C, x) / 6)
    assert 0.5 < np.mean(nees) < 2


def test_sigma_of_the_crowns_follows_the_information(noisy_fits):
    solution, _ = noisy_fits[0]
    sigma = crown_sigma_mm(SCANS[0], solution, 0, CONFIG)
    assert 0.005 < sigma < 0.1
    for sums in solution.outline:
        sums[0, 1:] = 0  # with one view, depth is nearly unconstrained
    assert crown_sigma_mm(SCANS[0], solution, 0, CONFIG) > 3 * sigma
    for sums in solution.outline:
        sums[0] = 0
    assert np.isinf(crown_sigma_mm(SCANS[0], solution, 0, CONFIG))
    assert np.isinf(np.diag(twist_covariance(solution, 0, 0.4, 10.0))).all()


def test_uncovered_pixels_are_those_off_the_crowns():
    poses = jaw_poses(2)[1]
    views = []
    for k, camera in enumerate(CAMERAS):
        masks = (render_masks(MESHES, poses, camera) > 127).astype(np.uint8) * 255
        masks[0, 5:15, 20 : 30 + k] = 255
        views.append(View(camera.projection_matrix(), camera.centre_world(), masks, np.array([True, k != 2])))
    solution = ContourSolver(SCANS, CONFIG).solve(poses, views, (2.5,))
    bare, total = uncovered_px(SCANS, solution.poses, views)
    assert total[0] == pytest.approx([(v.masks[0] > 0).sum() for v in views])
    assert total[1, 2] == 0 and bare[1, 2] == 0
    assert (bare[0] - [100, 110, 120] >= 0).all() and (bare[0] - [100, 110, 120] < 0.02 * total[0]).all()


BOTH, UPPER = np.array([True, True]), np.array([True, False])


def _motion(poses):
    return MotionPredictor(poses, np.zeros((2, 3, 3)) + np.eye(3) * 10)


def test_motions_about_a_point_are_motions_there_carried_to_it():
    rng = np.random.default_rng(3)
    centre, start = np.array([40.0, -25.0, 310.0]), jaw_poses(3)[2][1]
    for twist in rng.normal(size=(20, 6)) * ([0.3] * 3 + [5.0] * 3):
        there = translation(centre) @ se3_exp(twist) @ translation(-centre)
        np.testing.assert_allclose(motion_about(centre, twist), there, atol=1e-12)
        np.testing.assert_allclose(twist_between(start, there @ start, centre), twist, atol=1e-10)


def test_medians_are_updated_every_frame():
    history, medians = History(5, 3), []
    for k in (4.0, 8.0, 6.0, 10.0):
        view, arch = np.full((2, 3), k), np.full(2, k)
        status, used = np.full(2, TRACKED, np.int8), np.ones((2, 3), bool)
        history.add_summary(FrameSummary(np.tile(np.eye(4), (2, 1, 1)), status, used, view, view, arch))
        usual = (history.usual_score(), history.usual_residual(), history.usual_coverage())
        medians.append([float(x.ravel()[0]) for x in usual])
    assert medians == [[4, 4, 4], [6, 6, 6], [6, 6, 6], [8, 7, 7]]


def test_prediction_keeps_velocity_and_starts_include_rest():
    step = se3_exp([0.01, 0, 0.02, 1.0, -2.0, 0.5])
    poses = jaw_poses(1)[0]
    motion = _motion(poses)
    assert len(motion.starts()) == 1
    motion.update(step @ poses, BOTH, BOTH)
    assert motion.predict() == pytest.approx(step @ step @ poses)
    going, resting, half = motion.starts()
    assert going == pytest.approx(step @ step @ poses) and resting == pytest.approx(step @ poses)
    assert half[:, :3, 3] == pytest.approx(0.5 * (going + resting)[:, :3, 3], abs=1e-6)
    assert motion.miss_mm() == pytest.approx(np.linalg.norm((step @ poses - poses)[0] @ [10, 0, 0, 1]), rel=0.3)


def test_a_lost_jaw_moves_with_the_head():
    poses = jaw_poses(1)[0]
    motion = _motion(poses)
    head = se3_exp([0, 0.05, 0, 3.0, 0, 0])
    motion.update(np.stack([head @ poses[0], np.full((4, 4), 7.0)]), UPPER, BOTH)
    relative = se3_inverse(poses[0]) @ poses[1]
    assert se3_inverse(motion.predict()[0]) @ motion.predict()[1] == pytest.approx(relative, abs=1e-9)


def test_history_keeps_distinct_jaw_poses_relative_to_the_head():
    poses = jaw_poses(1)[0]
    motion = _motion(poses)
    for k in range(30):
        motion.remember(np.stack([poses[0], poses[1] @ se3_exp([0, 0, 0, 0, -0.5 * k, 0])]), np.array([True, True]))
    assert 6 < len(motion.pose_history()) <= 16
    motion.update(se3_exp([0, 0.1, 0, 5, 0, 0]) @ poses, BOTH, BOTH)
    head = motion.predict()[0]
    for entry in motion.pose_history():
        jaw = se3_inverse(head) @ entry[1]
        assert jaw[:3, :3] == pytest.approx((se3_inverse(poses[0]) @ poses[1])[:3, :3], abs=1e-6)


def test_searches_become_rarer_while_lost():
    motion = _motion(jaw_poses(1)[0])
    due = []
    for _ in range(40):
        due.append(motion.search_is_due())
        motion.update(motion.predict(), UPPER, BOTH)
    assert due[:5] == [True, True, True, False, True] and sum(due) < 10


def test_failed_searches_exhaust_the_budget():
    searches = SearchBudget(384)
    for frame in range(searches.most):
        assert searches.allows(frame)
        searches.note(frame, found=False)
    assert searches.most == 20 and not searches.allows(20) and not searches.allows(19)
    assert searches.left_out == {20}  # on the other one it ran
    searches.note(20, found=True)
    assert searches.allows(21) and searches.fruitless == 20


def test_searches_stay_due_while_nothing_is_visible():
    motion = _motion(jaw_poses(1)[0])
    for _ in range(7):
        motion.update(motion.predict(), UPPER, UPPER)
        assert motion.search_is_due()


def test_shift_brings_crowns_back_onto_their_masks():
    poses = jaw_poses(2)[1]
    views = [
        View(c.projection_matrix(), c.centre_world(), render_masks(MESHES, poses, c), BOTH) for c in make_cameras()
    ]
    away = np.array([3.0, 9.0, 0.0])
    moved = make_transform(np.eye(3), away) @ poses[1]
    use = np.ones((2, 3), bool)
    assert shift_to_masks(SCANS[1], moved, 1, views, use) == pytest.approx(-away, abs=2.5)
    assert (shift_to_masks(SCANS[1], moved, 1, views, ~use) == 0).all()


def test_walking_backwards_gives_the_same_views(tmp_path):
    capture = make_capture(write_masks(tmp_path / "take", 5), 5)
    table = {c.name: c for c in CAMERAS}
    with MaskViews(capture.cameras, table, OFFSETS, np.array([0, 0, 0.0]), 5.0) as masks:
        forwards = dict(masks.walk(FIRST, FIRST + 5))
        backwards = list(masks.walk(FIRST + 4, FIRST - 1, -1))
    assert [f for f, _ in backwards] == [FIRST + k for k in (4, 3, 2, 1, 0)]
    for frame, views in backwards:
        for a, b in zip(views, forwards[frame]):
            assert (a.masks == b.masks).all() and (a.matrix == b.matrix).all()


def test_views_around_an_instant_are_those_of_each(tmp_path):
    capture = make_capture(write_masks(tmp_path / "take", 5), 5)
    table = {c.name: c for c in CAMERAS}
    with MaskViews(capture.cameras, table, OFFSETS, np.array([0, 0, 0.0]), 5.0) as masks:
        for frame in (FIRST, FIRST + 2, FIRST + 5):  # the last one shows none
            for k, views in enumerate(masks.around(frame, 1)):
                for a, b in zip(views, masks.at(frame - 1 + k), strict=True):
                    assert (a.masks == b.masks).all() and (a.matrix == b.matrix).all()
                    assert (a.present == b.present).all()


def test_views_keep_the_geometry_of_the_camera(tmp_path):
    capture = make_capture(write_masks(tmp_path / "take", 4), 4)
    table = {c.name: c for c in CAMERAS}
    poses = jaw_poses(2)[1]
    with MaskViews(capture.cameras, table, OFFSETS, poses[0][:3, 3], 4.0) as masks:
        views = masks.at(FIRST + 1)
    for view, camera in zip(views, CAMERAS):
        h = view.matrix @ np.append(poses[0][:3, 3], 1.0)
        inside = render_masks(MESHES, poses, camera).any(0)
        assert view.masks.shape[1:] < inside.shape  # cropped to the teeth, and smaller
        scale = 4.0 / (1250 / 200)
        centre = np.argwhere(view.masks[0] > 127).mean(0)[::-1] - h[:2] / h[2]
        full = np.argwhere(render_masks(MESHES, poses, camera, (7.5, -16.0))[0] > 127).mean(0)[::-1]
        assert centre == pytest.approx((full - camera.project(poses[0][:3, 3])) * scale, abs=0.5)


def test_working_size_follows_resolution_and_never_enlarges():
    camera = CAMERAS[0]  # 6.25 px/mm at the origin
    assert working_size(camera, np.zeros(3), 3.125) == (320, 200)
    assert working_size(camera, np.zeros(3), 20.0) == camera.size_px
    with pytest.raises(TrackingError, match="camera cam0: the teeth are 100 mm behind this camera"):
        working_size(camera, camera.centre_world() + se3_inverse(camera.T_cam_world)[:3, 2] * -100, 3.0)


def test_gates_open_with_the_reach():
    assert CONFIG.gates_from(0.0)[0] == CONFIG.first_gate_px
    assert CONFIG.gates_from(9.0)[0] == 8.0
    assert CONFIG.gates_from(99.0) == CONFIG.wide_gates_px


def test_scans_of_the_example_meet_the_assumptions_of_tests():
    assert arch(True).faces.shape == MESHES[0].faces.shape
    assert all(s.painted and len(s.gingival_margin) > 100 for s in SCANS)
