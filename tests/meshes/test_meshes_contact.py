"""Teeth of a synthetic person as solids: closed bite, clearances, scans that say nothing, the picture of contacts."""

import numpy as np
import pytest

from jawusd.formats.mesh import TOUCHING, Mesh
from jawusd.geometry import transform_points
from jawusd.meshes.contact import ContactMap, NoContact, find_teeth
from jawusd.synthetic.anatomy import build_anatomy
from jawusd.synthetic.person import Person


def lifted(mm):
    T = np.eye(4)
    T[1, 3] = mm
    return T


def side_of(mesh):
    """Return the left back teeth: half an arch is as good, and quicker."""
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    return Mesh(mesh.vertices, mesh.faces[(middle[:, 0] > 12) & (middle[:, 2] > -42)])


@pytest.fixture(scope="module")
def scans():
    anatomy = build_anatomy(Person(3))
    return side_of(anatomy.upper.mesh), side_of(anatomy.lower.mesh)


@pytest.fixture(scope="module")
def teeth(scans):
    return find_teeth(*scans, np.eye(4), np.eye(4))


def test_clearance_falls_as_the_lower_teeth_rise(teeth):
    assert -0.2 < teeth.closed_mm < 0.1  # the anatomy leaves 0.05 mm between teeth that meet
    clear = teeth.clearances(np.array([lifted(mm) for mm in (-0.5, 0.0, 0.2, 0.5, 1.0)]))
    assert clear[1] == pytest.approx(0.0, abs=1e-9)
    assert (np.diff(clear) < 0).all() and clear[0] > 0.2 and -1.0 < clear[4] < -0.5


def test_scans_in_another_frame_are_as_clear(scans, teeth):
    turn = np.array([[0.0, 0, 1, 20], [0, 1, 0, -5], [-1, 0, 0, 7], [0, 0, 0, 1]])  # scan to anatomical axes
    back = np.linalg.inv(turn)
    placed = [Mesh(transform_points(back, m.vertices), m.faces) for m in scans]
    other = find_teeth(*placed, turn, np.eye(4))
    poses = np.array([lifted(mm) for mm in (-0.3, 0.4)])
    moved = back @ poses @ turn
    np.testing.assert_allclose(other.clearances(moved), teeth.clearances(poses), atol=0.06)


def test_teeth_wound_inside_out_are_the_same(scans, teeth):
    turned = [Mesh(m.vertices, m.faces[:, ::-1]) for m in scans]
    assert find_teeth(*turned, np.eye(4), np.eye(4)).closed_mm == pytest.approx(teeth.closed_mm, abs=1e-6)


def test_scans_that_say_nothing_are_refused(scans):
    upper, lower = scans
    with pytest.raises(NoContact, match="are more than 1 mm apart"):
        find_teeth(upper, lower, np.eye(4), lifted(-3.0))
    with pytest.raises(NoContact, match="penetrate each other"):
        find_teeth(upper, lower, np.eye(4), lifted(6.0))
    with pytest.raises(NoContact, match="upper scan is too coarse"):
        find_teeth(Mesh(5 * upper.vertices, upper.faces), lower, np.eye(4), np.eye(4))
    flips = np.random.default_rng(0).random(len(upper.faces)) < 0.5
    torn = np.where(flips[:, None], upper.faces[:, ::-1], upper.faces)
    with pytest.raises(NoContact, match="not consistently wound"):
        find_teeth(Mesh(upper.vertices, torn), lower, np.eye(4), np.eye(4))


def test_marks_lie_where_the_teeth_meet(teeth):
    drawn = ContactMap(teeth)

    def marked(T):
        return (drawn.draw(T) == TOUCHING[0].color).all(axis=2)

    closed, apart = marked(lifted(0.0)), marked(lifted(-3.0))
    assert closed.sum() > 20 and not apart.any()
    half = closed.shape[1] // 2
    assert closed[:, :half].any() and closed[:, half:].any()  # upper teeth and lower teeth
    raised = marked(lifted(0.3))
    assert raised.sum() > closed.sum()
