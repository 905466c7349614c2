"""Selection of training data, and detection of mistakes in it."""

import numpy as np
import pytest

from jawusd.base.errors import FittingError
from jawusd.evaluator import JawRig
from jawusd.fitting import FittingConfig, fit_model
from jawusd.fitting.checks import bound_not_reached, check_anatomy, missing_movements, shown_parameters
from jawusd.fitting.data import SubjectAnatomy, select_poses, select_tracks
from jawusd.formats.tracks import Tracks
from jawusd.geometry import landmark_frame, make_transform, random_rotation, se3_exp, so3_exp, transform_points
from jawusd.synthetic.exercises import record
from jawusd.synthetic.person import Person


@pytest.fixture(scope="module")
def person():
    return Person(0)


@pytest.fixture(scope="module")
def take(person):
    return record(person, 400, 1).T_noisy


@pytest.fixture(scope="module")
def anatomy(person):
    to_anatomical = make_transform(np.eye(3), -person.landmarks[0])
    return SubjectAnatomy.of(to_anatomical, person.landmarks, person.mandible_points, None)


def tracks_of(T, covariance=None):
    count = len(T)
    small = np.broadcast_to(np.diag([1e-8] * 3 + [1e-4] * 3), (count, 6, 6)).copy()
    return Tracks(
        frames=np.arange(100, 100 + count),
        T_world_upper=np.broadcast_to(np.eye(4), T.shape).copy(),
        T_world_lower=T.copy(),
        T_upper_lower=np.full_like(T, np.nan),  # must be ignored
        raw_T_world_upper=np.broadcast_to(np.eye(4), T.shape).copy(),
        raw_T_world_lower=T.copy(),
        raw_T_upper_lower=T.copy(),
        status=np.ones((count, 2), dtype=np.int8),
        prior_aided=np.zeros(count, dtype=bool),
        coverage_error=np.zeros((count, 2, 3)),
        masks_used=np.ones((count, 2, 3), bool),
        covariance_upper=small,
        covariance_lower=small,
        covariance_relative=small if covariance is None else covariance,
        sigma_mm=np.full((count, 5), 0.1),
        residual_px=np.zeros((count, 2)),
        matched_px=np.zeros((count, 2)),
        camera_names=("a", "b", "c"),
    )


def test_only_measured_and_certain_frames_are_used(take, anatomy):
    tracks = tracks_of(take[:100])
    tracks.status[3, 1] = 0
    tracks.raw_T_upper_lower[4] = np.nan
    tracks.prior_aided[5:8] = True
    tracks.covariance_relative[9] *= 1e6
    tracks.frames[20] = tracks.frames[19]
    tracks.raw_T_upper_lower[30] = tracks.raw_T_upper_lower[29]
    selection = select_tracks(tracks, anatomy)
    excluded = {frame for frames in selection.excluded.values() for frame in frames}
    assert excluded == {103, 104, 105, 106, 107, 109, 119, 130}
    assert selection.used.sum() == len(selection.data) == 92
    assert set(selection.excluded) >= {"lost", "no pose", "prior aided", "frame number repeated"}


def test_uncertain_frames_weigh_less(take, anatomy):
    tracks = tracks_of(take[:50])
    tracks.covariance_relative[10] *= 1000
    weights = select_tracks(tracks, anatomy).data.weights
    assert weights[10] < 0.6 < 0.95 < np.delete(weights, 10).min()


def test_uncertainty_over_the_mandible_is_that_of_drawn_poses(person, take, anatomy):
    rng = np.random.default_rng(1)
    root = rng.normal(size=(6, 6)) * np.array([1e-3] * 3 + [0.2] * 3)[:, None]
    covariance = np.broadcast_to(root @ root.T, (40, 6, 6)).copy()
    weights = select_tracks(tracks_of(take[:40], covariance), anatomy).data.weights
    drawn = se3_exp(rng.normal(size=(4000, 6)) @ root.T) @ take[7]
    moved = transform_points(drawn, person.mandible_points) - transform_points(take[7], person.mandible_points)
    variance = (moved**2).sum(-1).mean()
    assert weights[7] == pytest.approx(0.09 / (0.09 + variance), rel=0.05)


def test_motion_starts_at_the_closed_bite_in_anatomical_axes(person):
    rng = np.random.default_rng(2)
    A, rest = (make_transform(random_rotation(rng), rng.normal(size=3) * 50) for _ in range(2))
    anatomy = SubjectAnatomy.of(A, person.landmarks, None, rest)
    np.testing.assert_allclose(anatomy.motion(rest), np.eye(4), atol=1e-12)
    T = se3_exp(rng.normal(size=6) * 0.1) @ rest
    at_rest = anatomy.at_rest(person.landmarks)
    posed = transform_points(A @ T, person.landmarks)
    np.testing.assert_allclose(transform_points(anatomy.motion(T), at_rest), posed, atol=1e-9)


def test_unusable_poses_are_refused_by_name(take, anatomy):
    frames = np.arange(len(take))
    with pytest.raises(FittingError, match="14 poses are usable; at least 15"):
        select_poses(frames[:14], take[:14], anatomy)
    scaled = take.copy()
    scaled[5, :3, :3] *= 1.05
    with pytest.raises(FittingError, match="frame 5 is not rigid"):
        select_poses(frames, scaled, anatomy)
    jitter = se3_exp(np.random.default_rng(3).normal(size=(100, 6)) * [1e-4, 1e-4, 1e-4, 0.02, 0.02, 0.02])
    with pytest.raises(FittingError, match="hardly differ"):
        select_poses(frames[:100], take[50] @ jitter, anatomy)
    with pytest.raises(ValueError, match="poses must have shape"):
        select_poses(frames, take[:, :3], anatomy)


def codes(person, T, change=None):
    to_anatomical = make_transform(np.eye(3), -person.landmarks[0])
    landmarks = person.landmarks
    if change is not None:
        to_anatomical, landmarks = change(to_anatomical, landmarks)
    anatomy = SubjectAnatomy.of(to_anatomical, landmarks, person.mandible_points, None)
    return [warning.code for warning in check_anatomy(select_poses(np.arange(len(T)), T, anatomy).data, anatomy)]


def turned(rotation_vector):
    return lambda A, landmarks: (make_transform(so3_exp(np.array(rotation_vector)), np.zeros(3)) @ A, landmarks)


def test_a_human_jaw_raises_no_warning(person, take):
    assert codes(person, take) == []


@pytest.mark.parametrize(
    ("factor", "name"), [(1e-3, "metres"), (1e-1, "centimetres"), (1 / 25.4, "inches"), (1e3, "micrometres")]
)
def test_translations_in_other_units_are_recognised(person, take, anatomy, factor, name):
    wrong = take.copy()
    wrong[:, :3, 3] *= factor
    (warning,) = check_anatomy(select_poses(np.arange(len(wrong)), wrong, anatomy).data, anatomy)
    assert warning.code == "pose_units" and f"are in {name}" in warning.message


def test_mistaken_frames_are_recognised(person, take):
    assert codes(person, np.linalg.inv(take)) == ["swapped_jaws"]
    assert codes(person, take, turned([0, np.pi, 0])) == ["front_back_flip"]
    assert codes(person, take, turned([0, 0, np.pi])) == ["left_right_flip"]
    assert codes(person, take, lambda A, lm: (A, lm[[0, 2, 1, 4, 3]])) == ["left_right_flip"]
    exchanged = [0, 2, 1, 4, 3]  # in a frame derived from the landmarks, which flips with them
    assert codes(person, take, lambda A, lm: (landmark_frame(lm), lm)) == []
    assert codes(person, take, lambda A, lm: (landmark_frame(lm[exchanged]), lm[exchanged])) == ["left_right_flip"]
    assert codes(person, take, turned([np.pi, 0, 0])) == ["front_back_flip"]
    assert codes(person, take, lambda A, lm: (A, lm / 1000)) == ["scan_units"]


def test_inhuman_ranges_are_named(person, take):
    wide = np.stack([make_transform(so3_exp(np.array([a, 0, 0])), np.zeros(3)) for a in np.linspace(0, 1.2, 60)])
    centre = person.landmarks[3:].mean(0)
    wide[:, :3, 3] = centre - wide[:, :3, :3] @ centre
    assert codes(person, wide) == ["rotation_range"]
    low = take.copy()
    low[:, 1, 3] -= np.linspace(0, 80, len(low))
    assert "opening_range" in codes(person, low)
    sideways = take.copy()
    sideways[100:140, 0, 3] += 40.0
    assert {"laterotrusion_range", "condylar_translation_range"} <= set(codes(person, sideways))


def fit(person, T, method="anchored"):
    return fit_model(
        (np.arange(len(T)), T),
        T_anatomical_skull=make_transform(np.eye(3), -person.landmarks[0]),
        landmarks=person.landmarks,
        mandible_vertices=person.mandible_points,
        config=FittingConfig(method=method, holdout_folds=2),
    )


def noisy(T, rng):
    return T @ se3_exp(rng.normal(size=(len(T), 6)) * [1e-3, 1e-3, 1e-3, 0.05, 0.05, 0.05])


SWING = np.sin(np.linspace(0, 8 * np.pi, 160))
NOTHING = np.zeros(160)


@pytest.mark.parametrize(
    ("controls", "hidden"),
    [
        ((SWING**2, NOTHING, NOTHING), ["laterotrusion", "protrusion"]),
        ((NOTHING, SWING, NOTHING), ["opening", "protrusion"]),
        ((NOTHING, NOTHING, SWING), ["opening", "laterotrusion"]),
        ((SWING**2, SWING, NOTHING), ["protrusion"]),
    ],
)
def test_takes_that_lack_an_exercise_give_a_model_of_the_rest(person, controls, hidden):
    T = noisy(person.pose(*controls), np.random.default_rng(4))
    model = fit(person, T)
    said = [w["message"] for w in model.meta["warnings"] if w["code"] == "not_shown"]
    assert len(said) == len(hidden)
    assert all(f"do not show {name}" in sentence for name, sentence in zip(hidden, said, strict=True))
    assert model.meta["errors"]["train"]["mandible"]["mean"] < 0.35
    rig = JawRig(model.arrays, model.meta)
    inside = model.d[model.trained]
    assert (rig.margin(inside) > 0).mean() > 0.98
    np.testing.assert_allclose(rig.encode(rig.pose(inside))[0], inside, atol=1e-6)
    slider = {"opening": 0, "laterotrusion": 1, "protrusion": 2}
    turning = rig.jacobian(inside)[:, :3]
    for name in hidden:  # the other parameters' slopes include the path, so only the hidden ones must not turn the jaw
        if name != "opening":
            assert np.abs(turning[:, :, slider[name]]).max() < 1e-6


@pytest.mark.parametrize("method", ["pca", "additive"])
def test_other_models_also_do_without_an_exercise(person, method):
    T = noisy(person.pose(SWING**2, NOTHING, NOTHING), np.random.default_rng(6))
    model = fit(person, T, method=method)
    assert model.meta["errors"]["train"]["mandible"]["mean"] < (0.6 if method == "pca" else 0.3)
    assert len([w for w in model.meta["warnings"] if w["code"] == "not_shown"]) == 2


def test_wrong_units_explain_why_nothing_is_shown(person, take):
    wrong = take.copy()
    wrong[:, :3, 3] /= 1000
    with pytest.raises(FittingError, match=r"show neither opening.*are in metres"):
        fit(person, wrong)


def test_pure_hinge_is_fitted(person):
    centre = person.landmarks[3:].mean(0)
    T = make_transform(so3_exp(np.stack([0.25 * SWING**2, NOTHING, NOTHING], axis=1)), np.zeros(3))
    T[:, :3, 3] = centre - T[:, :3, :3] @ centre
    model = fit(person, noisy(T, np.random.default_rng(5)))
    assert model.meta["errors"]["train"]["mandible"]["mean"] < 0.35
    said = " ".join(w["message"] for w in model.meta["warnings"] if w["code"] == "not_shown")
    assert "do not show laterotrusion" in said and "do not show protrusion" in said


def test_twenty_poses_and_gaps_are_enough_for_a_coarse_model(person, take):
    model = fit(person, take[:: len(take) // 20][:20])
    assert len(model.frames) == 20 and model.trained.all()
    assert "few_poses" in [w["code"] for w in model.meta["warnings"]]
    gappy = take.copy()
    gappy[::5] = np.nan
    model = fit(person, gappy)
    assert np.isnan(model.d[::5]).all() and not model.trained[::5].any()
    assert model.meta["errors"]["train"]["mandible"]["mean"] < 0.33


def test_repeated_takes_change_nothing(person, take):
    once, twice = fit(person, take), fit(person, np.concatenate([take, take]))
    np.testing.assert_allclose(once.d, twice.d[: len(take)], atol=1e-9)
    assert not twice.trained[len(take) :].any()


def test_shown_parameters_of_a_full_take(take, anatomy):
    shown, sentences = shown_parameters(select_poses(np.arange(len(take)), take, anatomy).data)
    assert shown.all() and sentences == []


@pytest.mark.slow
def test_full_take_lacks_nothing_and_poor_takes_are_told_what_to_record(person):
    full = fit(person, record(person, 1200, 1, "hidden").T_noisy)  # with wandering through the whole envelope
    assert [w for w in full.meta["warnings"] if w["code"] == "take_lacks"] == []
    said = [w["message"] for w in fit(person, record(person, 833, 1).T_noisy).meta["warnings"]]
    assert len(said) == 1 and "record ten seconds of circling" in said[0]
    d, shown = full.d[full.trained], np.ones(3, dtype=bool)
    half = (d[:, 0] > 10) & (d[:, 0] < 33)
    cases = {
        "widest opening is": d[d[:, 0] < 25],
        "near full opening": d[(d[:, 0] < 0.84 * d[:, 0].max()) | (np.arange(len(d)) == d[:, 0].argmax())],
        "to the right": d[d[:, 1] > -3],
        "mm forward": d[d[:, 2] < 3],
        "no protrusion between": d[~half | (d[:, 2] < 1)],
        "no slide to the left between": d[~half | (d[:, 1] < 1)],
        "no frames between": d[~half],
        "directions are covered": d[~half | (np.abs(d[:, 1]) < 0.3)],
    }
    assert missing_movements(d, shown) == []
    for words, poor in cases.items():
        assert any(words in sentence for sentence in missing_movements(poor, shown)), words
    assert missing_movements(d[~half], np.array([True, True, False])) == []


def test_a_bound_with_room_for_uncaptured_poses_is_named_with_the_openings_to_record():
    none, places = np.empty((0, 2)), np.array([[12.0, 3.0], [26.4, 3.5]])
    assert bound_not_reached((none, none), (0.0, 0.0)) == []
    assert bound_not_reached((places, places), (0.01, 0.15)) == []
    (said,) = bound_not_reached((none, places), (0.0, 0.184))
    assert said.startswith("18 % of the bound of opening and protrusion") and "between 12 and 26 mm of opening" in said
