"""Extrapolation beyond the captured poses by the condylar paths."""

import numpy as np
import pytest

from jawusd.fitting.anchored import CondylarGuidance, fit_anchored
from jawusd.fitting.data import SubjectAnatomy, select_poses
from jawusd.geometry import make_transform, so3_exp, so3_log
from jawusd.synthetic.exercises import record
from jawusd.synthetic.person import Person

INCISOR = np.zeros(3)
CONDYLES = np.array([[50.0, 40.0, -90.0], [-50.0, 40.0, -90.0]])


def hinge_and_slide(opening_rad, slides_mm):
    """Return motions of a jaw that rotates about its condyles, which slide down a curved eminence together."""
    forward = np.asarray(slides_mm, dtype=float)
    down = -0.5 * forward - 0.02 * forward**2
    R = so3_exp(np.stack([opening_rad, 0 * forward, 0 * forward], axis=-1))
    centre = CONDYLES.mean(0)
    return make_transform(R, centre + np.stack([0 * forward, down, forward], axis=-1) - R @ centre)


def displacement(motion):
    return motion[:, :3, :3] @ INCISOR + motion[:, :3, 3] - INCISOR


@pytest.fixture(scope="module")
def captured():
    rng = np.random.default_rng(0)
    # opening with little protrusion, and protrusion with little opening
    openings = np.concatenate([rng.uniform(0, 0.5, 150), rng.uniform(0, 0.1, 150)])
    slides = np.concatenate([12 * openings[:150], rng.uniform(-1, 9, 150)])
    return hinge_and_slide(openings, slides)


def test_guidance_knows_combinations_nobody_captured(captured):
    guidance = CondylarGuidance.of_motion(captured, np.ones(len(captured)), INCISOR, CONDYLES)
    unseen = hinge_and_slide(np.linspace(0.3, 0.5, 9), np.linspace(8.5, 7.0, 9))
    found, known = guidance.rotation(displacement(unseen), so3_log(captured[:9, :3, :3]))
    assert known.all() and guidance.misfit_mm < 0.02
    assert np.abs(found - so3_log(unseen[:, :3, :3])).max() < 2e-3


def test_kinematic_centre_is_found_from_a_wrong_landmark(captured):
    guidance = CondylarGuidance.of_motion(captured, np.ones(len(captured)), INCISOR, CONDYLES + [0.0, 6.0, -6.0])
    assert np.linalg.norm(guidance.centres - CONDYLES, axis=1).max() < 3.0  # from 8.5


def test_positions_out_of_the_condyles_reach_are_refused(captured):
    guidance = CondylarGuidance.of_motion(captured, np.ones(len(captured)), INCISOR, CONDYLES)
    _, known = guidance.rotation(np.array([[0.0, -10.0, 40.0], [0.0, -10.0, -60.0]]), np.zeros((2, 3)))
    assert not known.any()


def test_border_movements_are_foretold_by_the_other_exercises():
    person = Person(3)
    take = record(person, 833, 1)
    anatomy = SubjectAnatomy.of(
        make_transform(np.eye(3), -person.landmarks[0]), person.landmarks, person.mandible_points, None
    )
    data = select_poses(np.arange(833), take.T_noisy, anatomy).data
    border = np.char.endswith(take.phase, "border")
    model = fit_anchored(data.select(~border), np.ones(3, bool), 4.5).model
    unseen = data.select(border)
    error = data.metric.largest(data.metric.nearest(model, unseen.motion)[1], unseen.motion)
    assert len(unseen) > 100 and error.mean() < 0.45 and error.max() < 1.5
