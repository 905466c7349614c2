"""Mappings from ARKit weights to d: against synthetic persons whose weights come from the chin, and refusals."""

import numpy as np
import pytest
from face_takes import JAW_FPS, Performer

from jawusd.base.errors import FittingError
from jawusd.fitting.face import fit_arkit
from jawusd.formats.arkit import FaceCapture, shares_of


@pytest.fixture(scope="module")
def take():
    """Return a person, its face capture, and times and d of the jaw."""
    performer = Performer(5)  # of twelve, the one whom fixed shares fit best
    face, _, measured = performer.perform("training")
    d, _ = performer.rig.encode(measured)
    return performer, face, np.arange(len(d)) / JAW_FPS, d


def test_mappings_pose_the_mandible_better_than_fixed_shares(take):
    """On other exercises; clocks 1.7 s apart, and frames without a face or a jaw."""
    performer, face, times, d = take
    weights, lost = face.weights.copy(), d.copy()
    weights[300:330] = np.nan
    lost[500:520] = np.nan
    gaps = FaceCapture(face.frames, weights, face.fps, face.timecode)
    fit = fit_arkit(performer.rig, gaps, times + 1.7, lost)
    assert abs(fit.offset_s - 1.7) < 0.012
    other, truth, _ = performer.perform("hidden", 2000, 2)
    at = other.frames / other.fps
    shares = performer.incisal_error(performer.rig.denormalized(shares_of(other.weights)), at, truth)
    own = performer.incisal_error(fit.mapping.d(other.weights), at, truth)
    assert own <= 0.6 * shares
    assert fit.error_mm < 0.6 * fit.shares_error_mm and 0.7 < fit.error_mm / own < 1.3


def test_an_exact_mapping_is_found_again(take):
    """Weights made from d by a known mapping: gains, cross-talk and neutral values come back."""
    performer, face, times, d = take
    d = np.column_stack([d[:, 0], d[:, 1], np.maximum(d[:, 2], 0)])
    moved = np.stack([d[:, 0] / 40, np.maximum(d[:, 1], 0) / 10, np.maximum(-d[:, 1], 0) / 12, d[:, 2] / 8], 1)
    moved[:, 3] += 0.2 * moved[:, 0]
    weights = moved + [0.02, 0.01, 0.03, 0.04]
    fit = fit_arkit(performer.rig, FaceCapture(np.arange(len(d)) * 1.0, weights, JAW_FPS, ""), times, d, 0.0)
    np.testing.assert_allclose(fit.mapping.d(weights), d, atol=0.35)
    np.testing.assert_allclose(np.diag(np.array(fit.mapping.gain_mm)[:, [0, 1, 3]]), [40, 10, 8], rtol=0.05)
    assert fit.mapping.gain_mm[2][0] == pytest.approx(-8 * 0.2 * 40 / 40 * 1, abs=0.4)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda face, times, d: (face, times[:200], d[:200]), "at least 10 s"),
        (lambda face, times, d: (face, times, d * [1, 1, 0.1]), "range of movement forward"),
        (lambda face, times, d: (face, times, np.minimum(d, [99, 0.5, 99])), "range of movement to the left"),
        (lambda face, times, d: (face, times, np.maximum(d, [-99, -0.5, -99])), "range of movement to the right"),
        (lambda face, times, d: (face, times, d[np.random.default_rng(0).permutation(len(d))]), "does not follow"),
        (lambda face, times, d: (still(face, 3), times, d), "movement forward never changes"),
        (lambda face, times, d: (face, times, np.full_like(d, np.nan)), "at least 10 s"),
    ],
)
def test_takes_that_cannot_tell_are_refused(take, change, said):
    performer, *take = take
    with pytest.raises(FittingError, match=said):
        fit_arkit(performer.rig, *change(*take))


def still(face, weight):
    """Return the capture with one weight at rest."""
    weights = face.weights.copy()
    weights[:, weight] = 0.02
    return FaceCapture(face.frames, weights, face.fps, face.timecode)


def test_a_mapping_no_better_than_shares_is_refused(take):
    """Weights that are the shares themselves leave nothing to learn."""
    performer, face, times, d = take
    rig = performer.rig
    shares = rig.normalized(rig.project(d))
    d = rig.denormalized(np.column_stack([shares[:, :2], np.maximum(shares[:, 2], 0)]))
    opening, side, forward = rig.normalized(d).T
    weights = np.stack([opening, np.maximum(side, 0), np.maximum(-side, 0), forward], axis=1)
    with pytest.raises(FittingError, match="would not be an improvement"):
        fit_arkit(rig, FaceCapture(np.arange(len(d)) * 1.0, weights, JAW_FPS, ""), times, d, 0.0)
