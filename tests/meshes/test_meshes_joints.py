"""Condyles that are balls under a flat skull: depths in closed form; bones that show no joint; a synthetic person's."""

import numpy as np
import pytest
import trimesh

from jawusd.formats.mesh import Mesh
from jawusd.geometry import transform_points
from jawusd.meshes.contact import NoContact, find_joints
from jawusd.synthetic.anatomy import build_anatomy
from jawusd.synthetic.person import Person

RADIUS, GAP = 5.0, 0.4
LANDMARKS = np.array([[0.0, 0, 0], [24, 4, -32], [-24, 4, -32], [50, 38, -88], [-50, 38, -88]])


def mesh_of(*shapes):
    found = trimesh.util.concatenate(shapes)
    return Mesh(np.array(found.vertices), np.array(found.faces))


def ball(centre, subdivisions=4):
    shape = trimesh.creation.icosphere(subdivisions, RADIUS)
    shape.apply_translation(centre)
    return shape


def mandible(subdivisions=4):
    return mesh_of(*(ball(place, subdivisions) for place in LANDMARKS[3:]))


def skull(gap_mm=GAP, rounds=6):
    """Return a flat slab over both condyles."""
    shape = trimesh.creation.box((150.0, 20.0, 60.0))
    for _ in range(rounds):
        shape = shape.subdivide()
    shape.apply_translation([0.0, 38.0 + RADIUS + gap_mm + 10.0, -88.0])
    return mesh_of(shape)


def lifted(*heights):
    T = np.tile(np.eye(4), (len(heights), 1, 1))
    T[:, 1, 3] = heights
    return T


@pytest.fixture(scope="module")
def joints():
    return find_joints(skull(), mandible(), LANDMARKS, np.eye(4), np.eye(4))


@pytest.mark.slow
def test_clearance_is_what_is_left_under_the_skull(joints):
    np.testing.assert_allclose(joints.closed, -GAP, atol=0.03)
    heights = np.array([-0.5, 0.0, 0.3, 0.7, 1.2])
    np.testing.assert_allclose(joints.clearances(lifted(*heights)), GAP - heights, atol=0.04)
    assert joints.clearances(lifted(-30.0)) == pytest.approx(1.5)


@pytest.mark.slow
def test_what_the_closed_bite_overlaps_is_allowed():
    joints = find_joints(skull(-0.6), mandible(), LANDMARKS, np.eye(4), np.eye(4))
    assert joints.closed_mm == pytest.approx(0.6, abs=0.04)
    np.testing.assert_allclose(joints.clearances(lifted(0.0, 0.5, -0.5)), [0.0, -0.5, 0.5], atol=0.04)


@pytest.mark.slow
def test_one_side_is_enough_and_frames_do_not_matter(joints):
    tilt = np.eye(4)
    tilt[:2, :2] = [[np.cos(0.02), -np.sin(0.02)], [np.sin(0.02), np.cos(0.02)]]  # left side up: 1 mm at 50 mm
    tilt[1, 3] = 38.0 * (1 - np.cos(0.02))
    expected = GAP - (tilt @ [*LANDMARKS[3], 1.0])[1] + 38.0
    np.testing.assert_allclose(joints.clearances(tilt[None]), expected, atol=0.04)
    A = np.array([[0.0, 0, 1, 20], [0, 1, 0, -5], [-1, 0, 0, 7], [0, 0, 0, 1]])  # skull to anatomical axes
    back = np.linalg.inv(A)
    meshes = [Mesh(transform_points(back, m.vertices), m.faces[:, ::-1]) for m in (skull(), mandible())]
    turned = find_joints(*meshes, transform_points(back, LANDMARKS), A, np.eye(4))
    np.testing.assert_allclose(turned.clearances(back @ tilt[None] @ A), expected, atol=0.06)


@pytest.mark.parametrize(
    ("bones", "words"),
    [
        (lambda: (skull(), mesh_of(ball([0.0, 0.0, 0.0]))), "mandible has no bone at the condyles"),
        (lambda: (skull(40.0), mandible()), "skull has no bone at the condyles"),
        (lambda: (skull(12.0), mandible()), "12.* mm from the skull"),
        (lambda: (skull(-4.0), mandible()), "penetrates the skull by 4"),
        (lambda: (skull(rounds=3), mandible()), "skull is too coarse"),
    ],
)
def test_bones_that_show_no_joint_are_told(bones, words):
    with pytest.raises(NoContact, match=words):
        find_joints(*bones(), LANDMARKS, np.eye(4), np.eye(4))


@pytest.mark.slow
def test_condyles_of_a_synthetic_person_slide_along_their_sockets():
    person = Person(1)
    anatomy = build_anatomy(person)
    joints = find_joints(anatomy.skull, anatomy.mandible, person.landmarks, np.eye(4), np.eye(4))
    controls = np.array([[0.0, 0, 0], [0.5, 0, 0], [1.0, 0, 0], [0.2, 0.7, 0], [0.2, 0, 0.8]])
    poses = person.pose_with_extra(controls, np.zeros((5, 3)))
    assert (joints.clearances(poses) > 0.9).all()  # the disc is 1.5 mm thick and more
    raised = lifted(*np.linspace(0.0, 5.0, 11)) @ poses[0]
    assert (np.diff(joints.clearances(raised)) <= 0).all() and joints.clearances(raised)[-1] < -1.0
