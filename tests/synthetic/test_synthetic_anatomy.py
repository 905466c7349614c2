"""Teeth and bones: sizes, closed outward surfaces, occlusion, consistency with the kinematics."""

import numpy as np
import pytest
import trimesh

from jawusd.geometry import anatomical_frame, find_landmarks, transform_points
from jawusd.meshes.bones import JOINT_SPACE_MM
from jawusd.synthetic.anatomy import PersonAnatomy, build_anatomy, opened_bite
from jawusd.synthetic.dental_arch import GREEN, GREY, RED, DentalArch
from jawusd.synthetic.person import Person

SEEDS = (0, 3)


@pytest.fixture(scope="module")
def people() -> list[tuple[Person, PersonAnatomy]]:
    return [(Person(seed), build_anatomy(Person(seed))) for seed in SEEDS]


def _crowns(arch: DentalArch) -> np.ndarray:
    return arch.mesh.vertices[arch.tooth != 0]


def test_meshes_are_closed_and_turned_outward(people: list[tuple[Person, PersonAnatomy]]) -> None:
    for _, anatomy in people:
        for mesh in (anatomy.upper.mesh, anatomy.lower.mesh, anatomy.mandible, anatomy.skull):
            solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
            parts = solid.split(only_watertight=False)
            assert len(parts) >= 3
            for part in parts:
                assert part.is_watertight and part.is_winding_consistent and part.volume > 0


def test_scans_have_the_promised_size_and_colours(people: list[tuple[Person, PersonAnatomy]]) -> None:
    for _, anatomy in people:
        for arch in (anatomy.upper, anatomy.lower):
            assert 10_000 <= len(arch.mesh.faces) <= 30_000
            assert {tuple(c) for c in np.unique(arch.mesh.colors, axis=0)} == {RED, GREEN, GREY}
            np.testing.assert_array_equal((arch.mesh.colors == GREY).all(1), arch.tooth == 0)
            assert sorted(np.unique(arch.tooth)) == [-7, -6, -5, -4, -3, -2, -1, 0, 1, 2, 3, 4, 5, 6, 7]
            width, _, depth = np.ptp(_crowns(arch), axis=0)
            assert 52 < width < 72 and 42 < depth < 58
            boundary = (arch.mesh.colors == GREEN).all(1)
            assert set(np.abs(arch.tooth[boundary])) == {1, 2, 3}


def test_origin_and_axes_are_those_of_the_scan_frame(people: list[tuple[Person, PersonAnatomy]]) -> None:
    for _, anatomy in people:
        upper, lower = _crowns(anatomy.upper), _crowns(anatomy.lower)
        front = upper[np.abs(upper[:, 0]) < 8]
        edge = front[front[:, 1].argmin()]
        assert abs(edge[1]) < 0.35 and abs(edge[2]) < 1.0
        T_anatomical_skull = anatomical_frame(upper, lower)
        np.testing.assert_allclose(T_anatomical_skull, np.eye(4), atol=0.6)
        np.testing.assert_allclose(T_anatomical_skull[:3, :3], np.eye(3), atol=0.05)


def test_landmarks_found_on_the_meshes_are_the_persons_own(people: list[tuple[Person, PersonAnatomy]]) -> None:
    for person, anatomy in people:
        upper, lower = _crowns(anatomy.upper), _crowns(anatomy.lower)
        found = find_landmarks(lower, anatomy.mandible.vertices, anatomical_frame(upper, lower))
        distance = np.linalg.norm(found - person.landmarks, axis=1)
        assert distance[0] < 0.6 and (distance[3:] < 1.0).all() and (distance[1:3] < 3.0).all()


def test_teeth_meet_in_occlusion_without_cutting(people: list[tuple[Person, PersonAnatomy]]) -> None:
    for _, anatomy in people:
        gaps = anatomy.occlusion.gaps(np.eye(4))
        assert gaps.min() > 0.0
        assert (gaps[:, 3:] < 0.25).all()  # every back tooth has a contact


def test_gum_hides_the_crown_bases(people: list[tuple[Person, PersonAnatomy]]) -> None:
    for _, anatomy in people:
        for arch, up in ((anatomy.upper, 1.0), (anatomy.lower, -1.0)):
            gum = arch.mesh.vertices[arch.tooth == 0] * [1, up, 1]
            for k in (1, -1, 3, 4, -6):
                crown = arch.mesh.vertices[arch.tooth == k] * [1, up, 1]
                base = crown[crown[:, 1].argmax()]
                near = gum[np.linalg.norm((gum - base)[:, [0, 2]], axis=1) < 8]
                assert near[:, 1].min() < base[1] - 1.5 and near[:, 1].max() > base[1] + 3


def test_sockets_follow_the_condylar_paths(people: list[tuple[Person, PersonAnatomy]]) -> None:
    for person, anatomy in people:
        bone = anatomy.skull.vertices
        opening = np.linspace(0.0, 1.0, 9)
        centres = transform_points(person.pose(opening, 0.0 * opening, 0.0 * opening), person.joint.condyles)
        for side in (0, 1):
            near = bone[np.abs(bone[:, 0] - person.joint.condyles[side, 0]) < 1.3]
            for centre in centres[:, side]:
                distance = np.linalg.norm((near - centre)[:, 1:], axis=1).min()
                assert distance == pytest.approx(JOINT_SPACE_MM, abs=0.5)


def test_condylar_heads_sit_on_the_condyles(people: list[tuple[Person, PersonAnatomy]]) -> None:
    for person, anatomy in people:
        for centre in person.joint.condyles:
            head = anatomy.mandible.vertices[np.linalg.norm(anatomy.mandible.vertices - centre, axis=1) < 12]
            assert head[:, 1].max() == pytest.approx(centre[1] + 4.2, abs=0.1)


def test_lifted_bite_removes_collisions_and_little_else() -> None:
    person = Person(1)
    anatomy = build_anatomy(person)
    controls = np.concatenate([np.linspace([0, -0.6, 0], [0, 0.6, 0], 13), np.linspace([0, 0, 0], [0.5, 0, 1], 7)])
    still = np.zeros((20, 3))
    lifted = opened_bite(person, anatomy.occlusion, controls, still)
    before = [anatomy.occlusion.gap(T) for T in person.pose_with_extra(controls, still)]
    after = [anatomy.occlusion.gap(T) for T in person.pose_with_extra(lifted, still)]
    assert min(before) < 0.0 <= min(after)
    np.testing.assert_array_equal(lifted[:, 1:], controls[:, 1:])
    free = np.array(before) >= 0.0
    np.testing.assert_array_equal(lifted[free], controls[free])
    assert (lifted[:, 0] - controls[:, 0]).max() < 0.05


def test_same_seed_same_person_other_seed_another(people: list[tuple[Person, PersonAnatomy]]) -> None:
    again = build_anatomy(Person(SEEDS[0])).upper.mesh.vertices
    np.testing.assert_array_equal(again, people[0][1].upper.mesh.vertices)
    assert np.abs(people[1][1].upper.mesh.vertices - again).max() > 0.3
