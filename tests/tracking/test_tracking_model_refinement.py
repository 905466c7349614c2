"""The second pass with a jaw model as prior."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import small_take
from bumpy_teeth import jaw_poses, render_masks, vertex_error_mm
from example_model import LANDMARKS_ANATOMICAL, example_arrays, example_meta
from scipy.optimize import minimize

from jawusd.evaluator import JawRig
from jawusd.formats.tracks import LOST, RECOVERED
from jawusd.geometry import make_transform, relative_pose, se3_exp, transform_point, transform_points
from jawusd.tracking.contour.equations import NormalEquations, OutlineSums, Solution
from jawusd.tracking.sequence.model_refinement import KinematicPrior, hard_frames, refine_tracks

COUNT = 24
SPREAD_MM = 0.1
HIDDEN = (10, 11)
LIP_MM = 3.8  # height of the lower lip over the lower incisal point: crown edges stay visible


@pytest.fixture(scope="module")
def jaw():
    same = {"T_anatomical_skull": np.eye(4), "T_rest": np.eye(4), "landmarks": LANDMARKS_ANATOMICAL}
    return JawRig({**example_arrays(), **same}, example_meta())


@pytest.fixture(scope="module")
def truth(jaw):
    t = np.arange(COUNT)
    d = np.column_stack([7.0 + 2.5 * np.sin(0.3 * t), 1.2 * np.sin(0.25 * t), 0.6 + 0.5 * np.cos(0.2 * t)])
    head = jaw_poses(COUNT)[:, 0]
    return np.stack([head, head @ jaw.pose(d)], axis=1)


def terms(prior, poses, centres):
    """Return the precision and right side added by a prior."""
    equations = NormalEquations()
    prior.accumulate(
        Solution(
            poses,
            OutlineSums.zeros(0),
            centres,
            np.zeros((2, 6, 6)),
            np.zeros((2, 6, 6)),
            np.zeros((2, 0)),
        ),
        equations,
    )
    return equations.matrix, equations.right


def cost(prior, poses, centres, twists):
    """Distance of twisted poses to the model by brute force over d: mean squared landmark distance, whitened."""
    moved = []
    for pose, centre, twist in zip(poses, centres, twists.reshape(2, 6)):
        to, back = make_transform(np.eye(3), -centre), make_transform(np.eye(3), centre)
        moved.append(back @ se3_exp(twist) @ to @ pose)
    points = prior.jaw.landmarks
    target = transform_points(relative_pose(*moved), points)

    def distance(d):
        return float(np.mean(np.sum((transform_points(prior.jaw.pose(d), points) - target) ** 2, axis=1)))

    start = prior.jaw.encode(relative_pose(*moved))[0]
    best = minimize(distance, start, method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-16, "maxfev": 4000})
    return 3 / SPREAD_MM**2 * best.fun


def test_terms_are_slope_and_curvature_of_the_distance_to_the_model(jaw, truth):
    prior = KinematicPrior(jaw, SPREAD_MM)
    poses, centres = truth[4].copy(), np.array([[0, 4.0, -3], [0, -9.0, -4]])
    poses[1] = poses[1] @ se3_exp([0.004, -0.003, 0.005, 0.08, -0.05, 0.1])
    precision, right = terms(prior, poses, centres)
    rng = np.random.default_rng(0)
    for _ in range(4):
        direction = rng.normal(size=12) * np.tile([0.01, 0.01, 0.01, 0.3, 0.3, 0.3], 2)
        h = 0.05
        values = [cost(prior, poses, centres, s * h * direction) for s in (-1.0, 0.0, 1.0)]
        slope, bend = (values[2] - values[0]) / (2 * h), (values[2] - 2 * values[1] + values[0]) / h**2
        assert -2 * right @ direction == pytest.approx(slope, rel=0.03, abs=0.05 * abs(bend))
        assert 2 * direction @ precision @ direction == pytest.approx(bend, rel=0.08)


def test_motion_along_the_model_costs_nothing(jaw, truth):
    prior = KinematicPrior(jaw, SPREAD_MM)
    precision, right = terms(prior, truth[4], np.zeros((2, 3)))
    d = jaw.encode(relative_pose(*truth[4]))[0]
    for k in range(3):
        other = truth[4, 0] @ jaw.pose(d + 1e-4 * np.eye(3)[k])
        step = np.r_[np.zeros(6), small_log(other @ np.linalg.inv(truth[4, 1]))] / 1e-4
        assert step @ precision @ step < 1e-4 * (step @ step) * np.linalg.norm(precision, 2)
    assert np.abs(right).max() < 1e-4


def small_log(T):
    """Logarithm of a transform next to the identity, to first order."""
    R = T[:3, :3]
    return np.r_[0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]), T[:3, 3]]


@pytest.fixture(scope="module")
def take(jaw, truth, tmp_path_factory):
    """A take whose middle frames hide nearly all of the lower teeth."""
    folder = tmp_path_factory.mktemp("aided")
    rng = np.random.default_rng(0)
    for camera in small_take.CAMERAS:
        for row in small_take.ROWS:
            (folder / camera.name / row).mkdir(parents=True)
        for k, poses in enumerate(truth):
            tips_mm = transform_point(relative_pose(*poses), [0.0, 0.0, 1.0])[1]
            lips = (7.5, tips_mm + LIP_MM if k in HIDDEN else -17.0)
            masks = render_masks(small_take.MESHES, poses, camera, lips, 0.3, rng)
            for row, mask in zip(small_take.ROWS, masks):
                cv2.imwrite(str(small_take.png(folder, camera.name, row, k)), (mask > 127).astype(np.uint8) * 255)
    capture = small_take.make_capture(folder, COUNT, bootstrap=picks_of(truth))
    return capture, small_take.track(capture, threads=1)


def picks_of(truth):
    """Picks on the first frame."""
    picks = {}
    for r, row in enumerate(small_take.ROWS):
        vertices = small_take.MESHES[r].vertices
        places = [(k, transform_point(truth[0, r], vertices[k])) for k in (10, 900, 1500, 2000)]
        picks[row] = [
            {
                "vertex": k,
                "views": [
                    {"camera": c.name, "x": float(c.project(p)[0]), "y": float(c.project(p)[1])}
                    for c in small_take.CAMERAS[:2]
                ],
            }
            for k, p in places
        ]
    return {"frame": small_take.FIRST, **picks}


def aid(take, jaw, tracks=None):
    capture, first = take
    scene = (capture, small_take.CAMERAS, small_take.OFFSETS, *small_take.MESHES)
    return refine_tracks(first if tracks is None else tracks, jaw, *scene, threads=1)


def worst_mm(poses, truth):
    return max(vertex_error_mm(small_take.MESHES[1], poses[k], truth[k, 1]) for k in HIDDEN)


@pytest.mark.slow
def test_hidden_teeth_are_found_with_the_model(take, jaw, truth):
    first = take[1]
    assert hard_frames(first)[list(HIDDEN)].all() and not hard_frames(first)[:6].any()
    aided = aid(take, jaw)
    assert aided.prior_aided[list(HIDDEN)].all() and not aided.prior_aided[:6].any()
    assert worst_mm(aided.T_world_lower, truth) < 0.15
    before = relative_pose(truth[:, 0], truth[:, 1])
    condyle = jaw.landmarks[3]
    error = np.linalg.norm(
        transform_point(aided.T_upper_lower, condyle) - transform_point(before, condyle),
        axis=-1,
    )
    assert error[list(HIDDEN)].max() < 0.4


@pytest.mark.slow
def test_lost_frames_come_back_marked_and_raw_poses_stay(take, jaw, truth):
    first = take[1]
    gone = list(HIDDEN)
    status, lower, relative = first.status.copy(), first.T_world_lower.copy(), first.T_upper_lower.copy()
    raw_lower, raw_relative = first.raw_T_world_lower.copy(), first.raw_T_upper_lower.copy()
    status[gone, 1] = LOST
    for array in (lower, relative, raw_lower, raw_relative):
        array[gone] = np.nan
    sigma, covariance = first.sigma_mm.copy(), first.covariance_relative.copy()
    sigma[gone], covariance[gone] = np.nan, np.nan
    lost = replace(
        first,
        status=status,
        T_world_lower=lower,
        T_upper_lower=relative,
        raw_T_world_lower=raw_lower,
        raw_T_upper_lower=raw_relative,
        sigma_mm=sigma,
        covariance_relative=covariance,
    )
    aided = aid(take, jaw, lost)
    assert (aided.status[gone, 1] == RECOVERED).all() and aided.prior_aided[gone].all()
    assert np.isfinite(aided.sigma_mm).all() and worst_mm(aided.T_world_lower, truth) < 0.3
    assert np.isnan(aided.raw_T_upper_lower[gone]).all()
    kept = np.setdiff1d(np.arange(COUNT), gone)
    np.testing.assert_array_equal(aided.raw_T_upper_lower[kept], first.raw_T_upper_lower[kept])


@pytest.mark.slow
def test_a_model_of_another_jaw_changes_nothing(take, jaw, truth):
    """Its poses fit neither masks nor model, so the first pass is kept."""
    arrays = {**jaw.arrays, "residual_limit_mm": np.array(1e-6)}
    aided = aid(take, JawRig(arrays, jaw.meta))
    assert not aided.prior_aided.any()


@pytest.mark.slow
def test_without_hard_frames_tracks_are_unchanged(take, jaw):
    first = take[1]
    easy = replace(first, status=np.ones_like(first.status), sigma_mm=np.full_like(first.sigma_mm, 0.1))
    assert aid(take, jaw, easy) is easy
