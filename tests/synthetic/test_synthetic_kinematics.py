"""Synthetic persons have published ranges of motion and exact joint mechanics."""

import numpy as np
import pytest
from possible_poses import CompetingPerson, PossiblePoses

from jawusd.geometry import rigidity_defect, se3_exp, se3_log, transform_point, transform_points
from jawusd.synthetic.exercises import record
from jawusd.synthetic.kinematics import eminence
from jawusd.synthetic.person import Person

SEEDS = range(8)


@pytest.fixture(scope="module")
def people() -> list[Person]:
    return [Person(seed) for seed in SEEDS]


def _controls(n: int) -> np.ndarray:
    rng = np.random.default_rng(4)
    return rng.uniform([0, -1, -1], [1, 1, 1], (n, 3))


def test_zero_controls_are_the_closed_bite(people: list[Person]) -> None:
    for person in people:
        np.testing.assert_allclose(person.pose(0.0, 0.0, 0.0), np.eye(4), atol=1e-12)


def test_poses_are_rigid_and_keep_any_batch_shape(people: list[Person]) -> None:
    controls = _controls(60).reshape(5, 4, 3, 3)
    T = people[0].pose(*np.moveaxis(controls, -1, 0))
    assert T.shape == (5, 4, 3, 4, 4)
    assert np.abs(rigidity_defect(T)).max() < 1e-9
    np.testing.assert_allclose(T[2, 1, 0], people[0].pose(*controls[2, 1, 0]), atol=1e-12)


def test_condyles_ride_their_eminences(people: list[Person]) -> None:
    for person in people:
        T = person.pose(*_controls(300).T)
        moved = transform_points(T, person.joint.condyles) - person.joint.condyles
        for side, towards_midline in ((0, -1.0), (1, 1.0)):
            expected = eminence(person.joint, side, moved[:, side, 2], towards_midline * moved[:, side, 0])
            np.testing.assert_allclose(moved[:, side, 1], expected, atol=1e-6)


def test_the_eminence_is_a_fossa_a_slope_and_a_crest(people: list[Person]) -> None:
    slide = np.linspace(0, 13, 200)
    for person in people:
        for side in (0, 1):
            height = eminence(person.joint, side, slide)
            curvature = np.gradient(np.gradient(height, slide), slide)
            assert (np.diff(height) < 0).all()
            assert curvature[10] < 0 < curvature[-10]


def test_opening_lies_in_the_human_range(people: list[Person]) -> None:
    # Hirsch 2006: 50.6 +- 6.4; Zawawi 2003: 48.8; interincisal distance includes the overbite.
    opening = [np.linalg.norm(p.incisor(p.pose(1.0, 0.0, 0.0))) for p in people]
    assert min(opening) > 40 and max(opening) < 62
    rotation = [np.rad2deg(np.linalg.norm(se3_log(p.pose(1.0, 0.0, 0.0))[:3])) for p in people]
    assert min(rotation) > 26 and max(rotation) < 45  # Muto and Kanazawa 1996: 36 to 39 +- 6


def test_condylar_travel_lies_in_the_human_range(people: list[Person]) -> None:
    for person in people:
        moved = transform_points(person.pose(1.0, 0.0, 0.0), person.joint.condyles) - person.joint.condyles
        assert (moved[:, 2] > 8).all() and (moved[:, 2] < 20).all()
        assert (moved[:, 1] < -5).all() and (moved[:, 1] > -12).all()


def test_condylar_inclination_and_bennett_angle_lie_in_the_human_range(people: list[Person]) -> None:
    for person in people:
        for side in (0, 1):
            inclination = [np.rad2deg(np.arctan2(-eminence(person.joint, side, x), x)) for x in (3.0, 5.0, 8.0)]
            assert min(inclination) > 20 and max(inclination) < 62
        for lateral, balancing, towards_midline in ((1.0, 1, 1.0), (-1.0, 0, -1.0)):
            T = person.pose(0.0, lateral, 0.0)
            moved = transform_point(T, person.joint.condyles[balancing]) - person.joint.condyles[balancing]
            assert 3 < np.rad2deg(np.arctan2(towards_midline * moved[0], moved[2])) < 25


def test_excursions_lie_in_the_human_range_and_shrink_with_opening(people: list[Person]) -> None:
    for person in people:
        closed = [person.incisor(person.pose(0.0, *c)) for c in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))]
        left, right, forward, back = closed
        assert 6 < left[0] < 15 and 6 < -right[0] < 15  # Hirsch 2006: 10.2 +- 2.2 and 10.6 +- 2.3
        assert 5 < forward[2] < 13  # 8.2 +- 2.5
        assert 0.5 < -back[2] < 2.0  # textbook (Posselt): retruded contact 1 mm behind
        opening = np.array([0.0, 0.4, 0.8, 1.0])
        reach = person.incisor(person.pose(opening, 1.0, 0.0)) - person.incisor(person.pose(opening, -1.0, 0.0))
        assert (np.diff(reach[:, 0]) < 0).all() and reach[-1, 0] < 0.35 * reach[0, 0]


def test_closed_glides_drop_the_incisors(people: list[Person]) -> None:
    for person in people:
        for control in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0)):
            drop = -person.incisor(person.pose(0.0, *control))[1]
            assert 0.5 < drop < 4.0


def test_left_and_right_are_not_swapped(people: list[Person]) -> None:
    T = people[0].pose(0.0, 1.0, 0.0)
    assert people[0].incisor(T)[0] > 5  # the chin moves to the subject's left
    moved = transform_points(T, people[0].joint.condyles) - people[0].joint.condyles
    assert moved[1, 2] > 3 * abs(moved[0, 2])  # the right condyle moves forward, the left one rotates


@pytest.mark.parametrize("kind", ["training", "hidden"])
def test_recordings_have_the_stated_noise_and_stay_possible(kind: str) -> None:
    person = Person(1)
    take = record(person, 833, 7, kind=kind)
    points = person.mandible_points

    def worst(A: np.ndarray, B: np.ndarray) -> np.ndarray:
        return np.linalg.norm(transform_points(A, points) - transform_points(B, points), axis=-1).max(-1)

    assert 0.25 < worst(take.T_noisy, take.T_true).mean() < 0.37
    assert 0.12 < worst(take.T_true, person.pose(*take.controls.T)).mean() < 0.35
    assert PossiblePoses(person).nearest(person.pose(*take.controls.T))[1].max() < 0.02
    assert PossiblePoses(person).include(take.T_true).mean() > 0.99
    assert take.T_noisy.shape == (833, 4, 4) and take.controls.shape == (833, 3) and take.phase.shape == (833,)
    assert (np.ptp(take.controls, axis=0) > [0.9, 1.5, 1.5]).all()
    speed = np.linalg.norm(np.diff(person.incisor(take.T_true), axis=0), axis=-1) * 24
    chewing = speed[take.phase[1:] == "chew"].max()
    assert 60 < chewing < 260  # 80 to 200 mm/s at the peak of a cycle
    np.testing.assert_array_equal(take.T_noisy, record(person, 833, 7, kind=kind).T_noisy)


def test_hidden_recordings_reach_further_than_training() -> None:
    person = Person(2)
    assert "explore" in record(person, 2000, 1, kind="hidden").phase
    assert "explore" not in record(person, 2000, 1, kind="training").phase


def test_noise_scale_scales_the_tracking_noise_only() -> None:
    person = Person(3)
    quiet, loud = (record(person, 100, 5, noise_scale=s) for s in (0.0, 4.0))
    np.testing.assert_allclose(quiet.T_noisy, quiet.T_true, atol=1e-12)
    np.testing.assert_array_equal(quiet.T_true, loud.T_true)
    assert np.linalg.norm(loud.T_noisy[:, :3, 3] - loud.T_true[:, :3, 3], axis=1).mean() > 0.5


def test_impossible_poses_are_refused(people: list[Person]) -> None:
    for person in people:
        good = person.pose(0.4, 0.3, 0.2)
        twists = [[0, 0, 0, 0, 3.0, 0], [0, 0, 0, 6.0, 0, 0], [0, 0.1, 0, 0, 0, 0], [0, 0, 0.06, 0, 0, 0]]
        beyond = person.pose([1.15, 0.0, 0.0], [0.0, 1.4, 0.0], [0.0, 0.0, 1.4])
        verdicts = PossiblePoses(person).include(np.concatenate([good[None], se3_exp(twists) @ good, beyond]))
        np.testing.assert_array_equal(verdicts, [True] + 7 * [False])


def test_nearest_finds_the_controls_again(people: list[Person]) -> None:
    controls = _controls(200) * [0.9, 0.95, 0.95]
    for person in people[:3]:
        found, distance_mm = PossiblePoses(person).nearest(person.pose(*controls.T))
        assert distance_mm.max() < 1e-2
        np.testing.assert_allclose(person.pose(*found.T), person.pose(*controls.T), atol=2e-2)


def test_unbounded_nearest_is_never_further_than_bounded(people: list[Person]) -> None:
    T = people[0].pose(np.array([1.08, 0.2]), np.array([0.0, 1.3]), np.array([0.0, 0.0]))
    possible = PossiblePoses(people[0])
    bounded, free = possible.nearest(T)[1], possible.nearest(T, bounded=False)[1]
    assert (free < 0.05).all() and (bounded > 0.5).all()


def test_competing_envelope_refuses_the_corner_of_the_box() -> None:
    box, competing = Person(5), CompetingPerson(5)
    corner = box.pose(0.1, 0.95, 0.95)
    assert PossiblePoses(box).include(corner) and not PossiblePoses(competing).include(corner)
    take = record(competing, 400, 3)
    size = np.abs(take.controls[:, 1]) ** 1.3 + np.maximum(take.controls[:, 2], 0) ** 1.3
    assert size.max() < 1 + 1e-9


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="kind"):
        record(Person(0), 10, 0, kind="secret")
    with pytest.raises(ValueError, match="at least one frame"):
        record(Person(0), 0, 0)
