"""Motion carried to other bones: known cases, and leaving one person out by hand."""

import numpy as np
import pytest
from example_people import person
from scipy.spatial.transform import Rotation

from jawusd.base.errors import FittingError
from jawusd.geometry import make_transform, random_rotation, rigid_fit, so3_exp, transform_points
from jawusd.library.personal import Donor, displacements, landmark_distance_mm, leave_one_out, personal_motion

D = np.array([[0.0, 0, 0], [20, 2, 1], [8, -4, 0.5], [38, 0, 0], [3, 1, 3]])


@pytest.fixture(scope="module")
def donor():
    return Donor("one", person("one"))


def motions(donor, d):
    """Poses relative to the closed bite, skull frame."""
    return donor.rig.pose(d) @ np.linalg.inv(donor.rig.T_rest)


def carried(donor, target, d):
    shares = donor.rig.normalized(d)
    return rigid_fit(target, target + displacements(donor, target, shares))


def test_to_the_same_bones_a_motion_is_carried_unchanged(donor):
    np.testing.assert_allclose(carried(donor, donor.landmarks, D), motions(donor, D), atol=1e-9)


def test_where_the_other_head_is_does_not_matter(donor):
    B = make_transform(random_rotation(np.random.default_rng(1)), [30.0, -200, 5])
    moved = carried(donor, transform_points(B, donor.landmarks), D)
    np.testing.assert_allclose(moved, B @ motions(donor, D) @ np.linalg.inv(B), atol=1e-8)


def test_a_larger_head_moves_by_as_much_more(donor):
    larger = 1.1 * donor.landmarks
    expected = motions(donor, D)
    expected[:, :3, 3] *= 1.1
    np.testing.assert_allclose(carried(donor, larger, D), expected, atol=1e-8)


def test_a_wider_jaw_opens_alike_and_slides_its_condyles_apart_no_farther(donor):
    wider = person("wide", wider_mm=4.0)
    target = Donor("wide", wider).landmarks
    moved = transform_points(carried(donor, target, D[[1, 3]]), target) - target
    own = transform_points(motions(donor, D[[1, 3]]), donor.landmarks) - donor.landmarks
    np.testing.assert_allclose(moved[:, 0], own[:, 0], atol=1.0)
    assert np.linalg.norm(moved[:, 3:] - own[:, 3:], axis=-1).max() < 1.0


def test_poses_of_landmarks_agree_with_scipy():
    rng = np.random.default_rng(2)
    rest = rng.normal(scale=40, size=(5, 3))
    moved = transform_points(make_transform(so3_exp([0.3, -0.1, 0.2]), [1.0, 2, 3]), rest) + rng.normal(size=(5, 3))
    found = rigid_fit(rest, moved[None])[0]
    expected, _ = Rotation.align_vectors(moved - moved.mean(0), rest - rest.mean(0))
    np.testing.assert_allclose(found[:3, :3], expected.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(found @ np.append(rest.mean(0), 1), np.append(moved.mean(0), 1), atol=1e-9)


def test_landmarks_moved_rigidly_are_not_unlike(donor):
    B = make_transform(random_rotation(np.random.default_rng(3)), [1.0, 2, 3])
    assert landmark_distance_mm(donor.landmarks, transform_points(B, donor.landmarks)) < 1e-9
    other = donor.landmarks + np.array([[0, 0, 0]] * 4 + [[5.0, 0, 0]])
    assert 0.5 < landmark_distance_mm(donor.landmarks, other) < 5 / np.sqrt(5)


def test_twins_predict_each_other_without_error_and_count_alike(donor):
    twins = [donor, Donor("two", person("two")), Donor("three", person("three"))]
    made = personal_motion(twins, donor.landmarks, leave_one_out(twins))
    assert sum(made.weights.values()) == pytest.approx(1) and len(made.weights) == 3
    assert made.learned.summary()["max"] < 1e-6
    d, residual_mm = donor.rig.encode(made.poses @ donor.rig.T_rest)
    assert residual_mm.max() < 1e-6
    assert donor.rig.margin(d).min() > -0.5


def test_the_expected_error_of_a_person_does_not_use_that_person(donor):
    odd = Donor("odd", person("odd", ranges=0.7, opening=0.85, wider_mm=2.0))
    learned = leave_one_out([donor, Donor("two", person("two")), odd])
    codes = odd.rig.captured_d
    codes = codes[:: -(-len(codes) // 120)]
    shares = odd.rig.normalized(codes)
    predicted = rigid_fit(odd.landmarks, odd.landmarks + displacements(donor, odd.landmarks, shares))
    truth = transform_points(odd.rig.pose(codes), odd.rig.landmarks)
    by_hand = np.linalg.norm(transform_points(predicted, odd.landmarks) - truth, axis=-1)
    np.testing.assert_allclose(learned.errors_mm["odd"], by_hand, atol=1e-6)
    assert by_hand.mean() > 1


def test_the_closest_person_is_the_one_with_those_landmarks(donor):
    people = [donor, Donor("wide", person("wide", wider_mm=5.0)), Donor("wider", person("wider", wider_mm=9.0))]
    made = personal_motion(people, people[1].landmarks, leave_one_out(people, closest=True))
    assert made.weights == {"wide": 1.0}


def test_one_person_gives_a_motion_but_no_expected_error(donor):
    learned = leave_one_out([donor])
    assert learned.errors_mm == {}
    assert personal_motion([donor], donor.landmarks, learned).weights == {"one": 1.0}
    with pytest.raises(FittingError, match="no subject"):
        leave_one_out([])
