"""Teeth of a synthetic person as solids: closed bite, clearances, scans that say nothing, the picture of contacts."""

import numpy as np
import pytest

from jawusd.formats.contact import TOUCHING
from jawusd.formats.mesh import Mesh
from jawusd.geometry import transform_points
from jawusd.imaging.contact import NoContact, find_teeth
from jawusd.imaging.contact_map import ContactMap
from jawusd.synthetic.anatomy import build_anatomy
from jawusd.synthetic.person import Person


def lifted(mm):
    T = np.eye(4)
    T[1, 3] = mm
    return T


@pytest.fixture(scope="module")
def anatomy():
    return build_anatomy(Person(3))


@pytest.fixture(scope="module")
def teeth(anatomy):
    return find_teeth(anatomy.upper.mesh, anatomy.lower.mesh, np.eye(4), np.eye(4))


def test_clearance_falls_as_the_lower_teeth_rise(anatomy, teeth):
    # the vertical gap of the anatomy's own height map, at a raise at which it is closed to within its cells
    gap = anatomy.occlusion.gap(np.eye(4))
    assert -0.2 < teeth.closed_mm < 0.1 and gap >= 0
    clear = teeth.clearances(np.array([lifted(mm) for mm in (-0.5, 0.0, 0.2, 0.5, 1.0)]))
    assert clear[1] == pytest.approx(0.0, abs=1e-9)
    assert (np.diff(clear) < 0).all() and clear[0] > 0.2 and -1.0 < clear[4] < -0.5


def test_scans_in_another_frame_are_as_clear(anatomy, teeth):
    turn = np.array([[0.0, 0, 1, 20], [0, 1, 0, -5], [-1, 0, 0, 7], [0, 0, 0, 1]])  # scan to anatomical axes
    back = np.linalg.inv(turn)
    scans = [Mesh(transform_points(back, m.vertices), m.faces) for m in (anatomy.upper.mesh, anatomy.lower.mesh)]
    other = find_teeth(*scans, turn, np.eye(4))
    poses = np.array([lifted(mm) for mm in (-0.3, 0.4)])
    moved = back @ poses @ turn
    np.testing.assert_allclose(other.clearances(moved), teeth.clearances(poses), atol=0.06)


def test_teeth_wound_inside_out_are_the_same(anatomy, teeth):
    scans = [Mesh(m.vertices, m.faces[:, ::-1]) for m in (anatomy.upper.mesh, anatomy.lower.mesh)]
    assert find_teeth(*scans, np.eye(4), np.eye(4)).closed_mm == pytest.approx(teeth.closed_mm, abs=1e-6)


def test_scans_that_say_nothing_are_refused(anatomy):
    upper, lower = anatomy.upper.mesh, anatomy.lower.mesh
    with pytest.raises(NoContact, match="leaves more than 1 mm"):
        find_teeth(upper, lower, np.eye(4), lifted(-3.0))
    with pytest.raises(NoContact, match="into each other"):
        find_teeth(upper, lower, np.eye(4), lifted(6.0))
    with pytest.raises(NoContact, match="upper scan is coarse"):
        find_teeth(Mesh(5 * upper.vertices, upper.faces), lower, np.eye(4), np.eye(4))
    flips = np.random.default_rng(0).random(len(upper.faces)) < 0.5
    torn = np.where(flips[:, None], upper.faces[:, ::-1], upper.faces)
    with pytest.raises(NoContact, match="not wound alike"):
        find_teeth(Mesh(upper.vertices, torn), lower, np.eye(4), np.eye(4))


def test_marks_lie_where_the_teeth_meet(teeth):
    drawn = ContactMap(teeth)

    def marked(T):
        return (drawn.draw(T) == TOUCHING[0].color).all(axis=2)

    closed, apart = marked(lifted(0.0)), marked(lifted(-3.0))
    assert closed.sum() > 50 and not apart.any()
    half = closed.shape[1] // 2
    assert closed[:, :half].any() and closed[:, half:].any()  # upper teeth and lower teeth
    raised = marked(lifted(0.3))
    assert raised.sum() > closed.sum()
