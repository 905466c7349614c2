"""The stated error of models of short takes, at poses inside and far outside the captured range."""

import numpy as np
import pytest
from subjects.short_capture import ShortConfig, draw_capture, draw_shot
from subjects.short_take import SIZES_PX

from jawusd.evaluator import JawRig
from jawusd.evaluator.authoring import error_growth_at
from jawusd.fitting import FittingConfig, fit_model
from jawusd.formats.mesh import tooth_labels
from jawusd.geometry import se3_exp, se3_inverse, transform_point
from jawusd.geometry.anatomy import anatomical_frame, find_landmarks

SEEDS = (304, 307, 308)  # takes that open by 13 mm, while their other shots open by up to 22 mm
FRAMES, SHOTS = 48, 8
NOISE = np.repeat([3e-4, 0.02], 3)  # of tracked poses [rad, mm]


def true_poses(capture, count):
    """Return T_upper_lower (count, 4, 4) of the scans."""
    poses = (capture.poses(float(k)) for k in range(count))
    return np.array([se3_inverse(upper) @ lower for upper, lower in poses])


@pytest.fixture(scope="module")
def ratios():
    """Errors at the landmarks over their stated rms, rms over the landmarks (n,), and margins (n,) [mm]."""
    found = []
    for seed in SEEDS:
        capture = draw_capture(ShortConfig(seed, FRAMES, cameras=3, size_px=SIZES_PX[0]))
        upper, lower = (scan.vertices[tooth_labels(scan) > 0] for scan in capture.scans)
        axes = anatomical_frame(upper, lower)
        landmarks = find_landmarks(lower, None, axes, None)
        noise = se3_exp(np.random.default_rng(seed).normal(size=(FRAMES, 6)) * NOISE)
        take = (np.arange(FRAMES), true_poses(capture, FRAMES) @ noise)
        where = {"T_anatomical_skull": axes, "landmarks": landmarks, "mandible_vertices": capture.scans[1].vertices}
        model = fit_model(take, **where, config=FittingConfig())
        rig = JawRig(model.arrays, model.meta)
        unseen = np.concatenate([true_poses(draw_shot(capture, k + 1, 36), 36) for k in range(SHOTS)])
        d = rig.encode(unseen)[0]
        difference = transform_point(rig.pose(d)[:, None], landmarks) - transform_point(unseen[:, None], landmarks)
        z = np.linalg.norm(difference, axis=-1) / rig.landmark_sigma_mm(d)
        found.append((np.sqrt((z**2).mean(axis=1)), rig.margin(d)))
    return [np.concatenate(values) for values in zip(*found, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize("low_mm, high_mm", [(0.0, np.inf), (-3.0, 0.0), (-np.inf, -3.0)])
def test_stated_error_is_the_true_one_inside_the_bound_and_outside(ratios, low_mm, high_mm):
    """Growth in proportion to the distance gave 0.7, 2.0 and 4.9; the ratios are 0.9, 1.0 and 1.4."""
    ratio, margin = ratios
    within = (margin >= low_mm) & (margin < high_mm)
    assert within.sum() > 20
    assert 0.8 < np.sqrt((ratio[within] ** 2).mean()) < 1.6


def test_error_grows_slowly_at_first_and_fastest_beyond_the_widest_opening():
    captured = np.array([[0.0, 0.0, 0.0], [20.0, 0.0, 0.0]])
    distance = np.array([0.0, 1.0, 2.0, 100.0, 101.0])
    factor, reach = error_growth_at(captured, np.tile([10.0, 1.0, 0.0], (5, 1)), distance)
    np.testing.assert_array_equal(factor, 1.0)
    assert reach[0] == 0.0 and reach[1] < reach[2] - reach[1] < 1.0
    assert reach[4] - reach[3] == pytest.approx(1.0, abs=1e-3)
    wider = np.array([[20.0, 0.0, 0.0], [21.0, 0.0, 0.0], [22.0, 0.0, 0.0]])
    assert error_growth_at(captured, wider, np.zeros(3))[0] == pytest.approx([1.0, 3.0, 5.0])
    barely = np.zeros((1, 3))  # no opening was captured
    assert np.isfinite(error_growth_at(barely, wider, wider[:, 0])[0]).all()
