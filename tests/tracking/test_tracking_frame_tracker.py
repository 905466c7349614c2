"""Tracking of single frames: escalation, and reasons for lost arches."""

import re
from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from bumpy_teeth import arch, disturbed, jaw_poses, make_cameras, render_masks, vertex_error_mm

from jawusd.formats.tracks import LOST, PARTIAL, RECOVERED, TRACKED, LostReason
from jawusd.geometry import make_transform, se3_exp
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.contour.quality import uncovered_px
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import View
from jawusd.tracking.sequence.frame_tracker import FrameTracker
from jawusd.tracking.sequence.history import History, _median

CONFIG = TrackingConfig()
MESHES = (arch(True), arch(False))
SCANS = tuple(prepare_scan(m, n) for m, n in zip(MESHES, ("upper", "lower")))
POSES = jaw_poses(3)


def _views(k):
    return [
        View(c.projection_matrix(), c.centre_world(), render_masks(MESHES, POSES[k], c, (7.5, -16.0)), np.ones(2, bool))
        for c in make_cameras()
    ]


@pytest.fixture
def tracker():
    """A tracker that has seen one good frame."""
    solver, views = ContourSolver(SCANS, CONFIG), _views(0)
    solution = solver.solve(POSES[0], views, CONFIG.gates_from(0.0))
    bare, total = uncovered_px(SCANS, solution.poses, views)
    history = History(CONFIG.history_frames, CONFIG.score_frames)
    history.add(FrameRecord(solution, np.full(2, TRACKED, np.int8), np.ones((2, 3), bool), bare / total))
    return FrameTracker(solver, history)


def _errors(record):
    return [vertex_error_mm(MESHES[r], record.solution.poses[r], POSES[1, r]) for r in (0, 1)]


def test_good_prediction_is_tracked(tracker):
    record = tracker.track([POSES[0]], _views(1), [])
    assert record.status.tolist() == [TRACKED, TRACKED] and record.used.all()
    assert max(_errors(record)) < 0.05


def test_a_mask_that_is_never_covered_is_excluded(tracker):
    """Masks of a knocked camera are never covered, so they are not unusual, but would lose every frame."""
    views = _views(1)
    masks = views[0].masks.copy()
    for row in masks:
        row[:, : row.shape[1] // 12] = 255
    views[0] = replace(views[0], masks=masks)
    first = tracker.track([POSES[0]], _views(0), [])
    coverage = np.where(np.arange(3) == 0, 0.9, first.coverage)
    tracker.history = History(CONFIG.history_frames, CONFIG.score_frames)
    tracker.history.add(replace(first, coverage=coverage))
    record = tracker.track([POSES[0]], views, [])
    assert record.status.tolist() == [PARTIAL, PARTIAL] and record.used.tolist() == [[False, True, True]] * 2
    assert (record.coverage[:, 0] > CONFIG.lost_coverage).all() and max(_errors(record)) < 0.1


def test_jaw_far_from_its_prediction_is_found(tracker):
    away = POSES[1].copy()
    away[1] = make_transform(np.eye(3), [1.0, 9.0, 1.0]) @ away[1] @ se3_exp([-0.08, 0, 0, 0, 0, 0])
    record = tracker.track([away], _views(1), [])
    # The upper arch may count as recovered too, since the misplaced jaw had hidden parts of it.
    assert record.status[1] in (RECOVERED, PARTIAL) and record.status[0] != LOST
    assert max(_errors(record)) < 0.1


def test_a_second_start_is_tried_before_costlier_attempts(tracker):
    bad = disturbed(POSES[1], 6.0, 0.15, np.random.default_rng(1))
    record = tracker.track([bad, POSES[1]], _views(1), None)
    assert (record.status != LOST).all() and max(_errors(record)) < 0.1


def test_empty_masks_lose_both_arches(tracker):
    rng = np.random.default_rng(2)
    views = [View(v.matrix, v.eye, np.zeros_like(v.masks), v.present) for v in _views(1)]
    for view in views:
        for mask in view.masks:
            x, y = rng.integers(40, 300, 2)
            mask[y : y + 12, x : x + 12] = 255
    assert tracker.track([POSES[1]], views, []).status.tolist() == [LOST, LOST]


def test_missing_masks_lose_only_their_arch(tracker):
    views = [View(v.matrix, v.eye, v.masks, np.array([True, False])) for v in _views(1)]
    record = tracker.track([POSES[1]], views, [])
    assert record.status.tolist() == [TRACKED, LOST] and np.isnan(record.coverage[1]).all()


def test_a_mask_that_biases_the_pose_is_finally_excluded(tracker):
    """Start at the wrong mask: all masks look wrong there, and the wrong one is found only later."""
    views, far = _views(1), _views(2)
    moved = np.roll(views[2].masks[0], (30, 45), axis=(0, 1))
    spoiled = np.stack([moved, views[2].masks[1]])
    views[2] = View(far[2].matrix, far[2].eye, spoiled, np.ones(2, bool))
    away = POSES[1].copy()
    away[0] = make_transform(np.eye(3), [5.0, 4.0, 2.0]) @ away[0]
    record = tracker.track([away], views, [])
    assert record.used[0].tolist() == [True, True, False] and record.status[0] == PARTIAL
    assert max(_errors(record)) < 0.15


def test_one_mask_does_not_outvote_two(tracker):
    """Start where the wrong mask fits exactly, and the two correct ones do not."""
    views = _views(1)
    away = POSES[1].copy()
    away[0] = make_transform(np.eye(3), [3.0, 2.5, 1.0]) @ away[0]
    spoiled = render_masks(MESHES, away, make_cameras()[2], (7.5, -16.0))[0]
    views[2] = View(views[2].matrix, views[2].eye, np.stack([spoiled, views[2].masks[1]]), np.ones(2, bool))
    record = tracker.track([away], views, [])
    assert record.used[0].tolist() == [True, True, False] and record.status[0] == PARTIAL
    assert max(_errors(record)) < 0.15


@pytest.mark.parametrize(("uncovered_px", "wrong"), [(250.0, False), (350.0, True)])
def test_a_mask_is_wrong_if_its_penalty_exceeds_its_matched_contour(tracker, uncovered_px, wrong):
    """The uncovered fraction and the matched contour are both within their own limits."""
    trial = tracker._try(POSES[1], _views(1), CONFIG.gates_from(0.0), np.ones((2, 3), bool))
    score_px, uncovered = trial.solution.outline.score_px.copy(), trial.uncovered.copy()
    score_px[0, 2], uncovered[0, 2] = 150.0, uncovered_px
    solution = replace(trial.solution, outline=trial.solution.outline._replace(score_px=score_px))
    spoiled = tracker._spoiled(replace(trial, solution=solution, uncovered=uncovered), 1)
    assert uncovered_px / trial.mask_px[0, 2] < CONFIG.suspect_coverage
    assert spoiled.tolist() == [[False, False, wrong], [False] * 3]


@pytest.mark.parametrize(
    ("reason", "limits", "words"),
    [
        (
            LostReason.LITTLE_CONTOUR,
            {"least_matched_px": 1e5},
            r"matched contour \d+ px; at least 100000 px is needed",
        ),
        (LostReason.ROUGH_FIT, {"suspect_residual": 0.1}, r"residual 0\.\d\d px; less than 0.0\d px is needed"),
        (
            LostReason.LOW_SCORE,
            {"suspect_residual": 0.1, "lost_residual": 50.0, "suspect_score": 1.8},
            r"matched contour 1?\d\d% of the usual; at least 180% is needed",
        ),
        (LostReason.UNCOVERED_MASK, {"lost_coverage": 1e-5}, r"\d\.\d% of a mask is not covered .*; at most 0%"),
        (LostReason.UNCERTAIN, {"lost_sigma_mm": 0.001}, r"expected error of the crowns 0\.\d\d mm; at most 0\.00 mm"),
    ],
)
def test_every_check_reports_its_value_and_limit(tracker, reason, limits, words):
    strict = FrameTracker(ContourSolver(SCANS, replace(CONFIG, **limits)), tracker.history)
    views = _views(1)
    for view in views:
        view.masks[:, 2, 2] = 255  # every mask has a pixel that no scan covers
    record = strict.track([POSES[1]], views, None)
    assert record.status.tolist() == [LOST, LOST] and {loss.reason for loss in record.losses} == {reason}
    for loss in record.losses:
        assert re.search(words, loss.reason.explain(loss.value, loss.limit))


def test_one_mask_is_too_few_for_an_arch(tracker):
    views = _views(1)
    for view in views[1:]:
        view.present[1] = False
    record = tracker.track([POSES[1]], views, None)
    assert record.status.tolist() == [TRACKED, LOST]
    assert record.losses[1] == (LostReason.FEW_MASKS, 1, 2) and record.losses[0].reason == LostReason.NONE
    assert str(LostReason.FEW_MASKS) == "few masks" and str(LOST) == "lost"


def test_medians_equal_those_of_numpy():
    rng = np.random.default_rng(5)
    for count in (1, 2, 7, 24):
        for missing in (0.0, 0.3, 0.9, 1.0):
            values = rng.normal(size=(count, 2, 3))
            values[rng.random(values.shape) < missing] = np.nan
            otherwise = rng.normal(size=(2, 3))
            expected = otherwise.copy()
            known = np.isfinite(values).any(0)
            expected[known] = np.nanmedian(values[:, known], axis=0)
            assert (_median(deque(values), otherwise) == expected).all()
    assert _median(deque(), 4.0) == 4.0
