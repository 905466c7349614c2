"""Dragging in a view: what the pointer leaves open follows the subject's opening path."""

import numpy as np
import pytest
from example_model import example_arrays, example_meta
from example_rig import FPS, example_rig

from jawusd.evaluator import JawRig
from jawusd.fitting import FittingConfig, fit_model
from jawusd.geometry import LANDMARKS, make_transform
from jawusd.rig.layout import EXAMPLE_RIG
from jawusd.rig.read import load_rig
from jawusd.synthetic.exercises import record
from jawusd.synthetic.person import Person
from jawusd.viewer.readouts import INCISOR, landmark_places
from jawusd.viewer.session import Session

#: Directions of view, anatomical frame.
SIGHTS = {"front": [0.0, 0.0, -1.0], "left": [-1.0, 0.0, 0.0], "right": [1.0, 0.0, 0.0]}
#: Index in d of what a view leaves open.
OPEN = {"front": 2, "left": 1, "right": 1}


def with_path(bend):
    """Return the example rig of a person who opens along another path, by factors of its coefficients in x and z."""
    arrays = example_arrays()
    arrays["path_coefficients"] = arrays["path_coefficients"] * np.array(bend)[:, None]
    return JawRig(arrays, example_meta())


def fitted(seed):
    """Return the rig of a synthetic person, fitted to noisy poses."""
    person = Person(seed)
    T = record(person, 400, 1).T_noisy
    model = fit_model(
        (np.arange(len(T)), T),
        T_anatomical_skull=make_transform(np.eye(3), -person.landmarks[0]),
        landmarks=person.landmarks,
        mandible_vertices=person.mandible_points,
        config=FittingConfig(holdout_folds=0),
    )
    return JawRig(model.arrays, model.meta)


RIGS = {
    "example build": lambda: load_rig(EXAMPLE_RIG),
    "anchored": example_rig,
    "additive": lambda: example_rig("additive"),
    "bent to the side, opening straight down": lambda: with_path([3.0, -0.2]),
    "person 3": lambda: fitted(3),
    "person 12": lambda: fitted(12),
}


@pytest.fixture(scope="module", params=RIGS)
def rig(request):
    return RIGS[request.param]()


def dragged(rig, start, offset, sight):
    """Drag the incisal point by an offset [mm], and return the session and how far the point is seen off the pointer.

    Args:
        offset, sight: anatomical axes.
    """
    session, R, sight = Session(rig, FPS), rig.T_anatomical_skull[:3, :3], np.array(sight)
    session.set_pose(start)
    grabbed = landmark_places(rig, session.d)[INCISOR]
    session.grab(R.T @ (grabbed - rig.T_anatomical_skull[:3, 3]))
    for share in np.linspace(0.05, 1.0, 20):
        point = grabbed + share * np.array(offset)
        session.drag_to(R.T @ (point - rig.T_anatomical_skull[:3, 3]), 400.0 * R.T @ sight)
    off = landmark_places(rig, session.d)[INCISOR] - point
    return session, np.linalg.norm(off - sight * (sight @ off))


def path_place(rig, opening):
    return landmark_places(rig, np.array([opening, 0.0, 0.0]))[INCISOR]


def test_straight_down_from_the_front_opens_along_the_persons_path(rig):
    session, off = dragged(rig, [0.0, 0.0, 0.0], [0.0, -20.0, 0.0], SIGHTS["front"])
    assert off < 0.01 and session.d[0] > 15 and abs(session.d[2]) < 0.01 and session.readout().margin_mm > 0.1
    depth = landmark_places(rig, session.d)[INCISOR, 2] - path_place(rig, session.d[0])[2]
    assert abs(depth) < 1.0


def test_without_a_sight_the_depth_is_kept_instead(rig):
    """As the path leads back or forward, the jaw protrudes or retrudes."""
    session, R = Session(rig, FPS), rig.T_anatomical_skull[:3, :3]
    start = path_place(rig, 0.0)
    session.grab(R.T @ (start - rig.T_anatomical_skull[:3, 3]))
    for share in np.linspace(0.05, 1.0, 20):
        point = start + [0.0, -20.0 * share, 0.0]
        target = session.drag_to(R.T @ (point - rig.T_anatomical_skull[:3, 3]))
    np.testing.assert_allclose(R @ target + rig.T_anatomical_skull[:3, 3], point, atol=1e-9)
    assert abs(session.d[2]) > 0.5


def test_sideways_from_the_front_keeps_the_protrusion_of_the_path(rig):
    for side in (-4.0, 4.0):
        session, off = dragged(rig, [12.0, 0.0, 0.0], [side, 0.0, 0.0], SIGHTS["front"])
        assert off < 0.01 and abs(session.d[2]) < 0.01 and session.readout().margin_mm > 0


@pytest.mark.parametrize("view", ["left", "right"])
def test_along_the_path_from_the_side_there_is_no_laterotrusion(rig, view):
    way = path_place(rig, 20.0) - path_place(rig, 0.0)
    session, off = dragged(rig, [0.0, 0.0, 0.0], way, SIGHTS[view])
    np.testing.assert_allclose(session.d, [20.0, 0.0, 0.0], atol=0.02)
    assert off < 0.01 and session.readout().margin_mm > 0.1


@pytest.mark.parametrize("view", ["left", "right"])
@pytest.mark.parametrize("offset", [[0.0, -20.0, 0.0], [0.0, 0.0, 5.0]], ids=["down", "forward"])
def test_from_the_side_there_is_no_laterotrusion_off_the_path_either(rig, view, offset):
    session, off = dragged(rig, [10.0, 0.0, 0.0] if offset[2] else [0.0, 0.0, 0.0], offset, SIGHTS[view])
    inside = session.readout().margin_mm > 0.01
    assert abs(session.d[1]) < (0.01 if inside else 1.0) and session.readout().inside
    assert off < 0.01 or not inside


def test_a_slanted_view_leaves_the_path_across_it_alone(rig):
    session, off = dragged(rig, [12.0, 0.0, 0.0], [1.5, -1.5, -1.5], np.array([-1.0, -0.3, -1.0]) / np.sqrt(2.09))
    assert off < 0.01 and abs(session.d[1] + session.d[2]) < 0.01 and abs(session.d[1]) > 0.5


def test_from_above_the_opening_is_kept(rig):
    session, off = dragged(rig, [12.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, -1.0, 0.06])
    drop = landmark_places(rig, session.d)[INCISOR, 1] - path_place(rig, 12.0)[1]
    assert off < 0.2 and abs(drop) < 0.1


def test_a_pin_holds_in_depth_too(rig):
    moved = {}
    for pinned in (False, True):
        session, R = Session(rig, FPS), rig.T_anatomical_skull[:3, :3]
        session.set_pose([8.0, 0.0, 0.0])
        session.set_pin("condyle_left", pinned)
        before = landmark_places(rig, session.d)
        session.grab(R.T @ (before[INCISOR] - rig.T_anatomical_skull[:3, 3]))
        session.drag_to(R.T @ (before[INCISOR] + [0.0, -4.0, 0.0] - rig.T_anatomical_skull[:3, 3]), R.T @ [0, 0, -1.0])
        index = LANDMARKS.index("condyle_left")
        moved[pinned] = np.linalg.norm((landmark_places(rig, session.d) - before)[index])
    assert moved[True] < 0.35 * moved[False]
