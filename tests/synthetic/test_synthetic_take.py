"""Takes, mask jitter and picks."""

import numpy as np
import pytest

from jawusd.formats.mesh import Mesh
from jawusd.geometry import se3_inverse, se3_log, transform_point, transform_points
from jawusd.synthetic.anatomy import Face, LipState, PersonAnatomy, build_anatomy, palate, tongue
from jawusd.synthetic.annotations import Outline, choose_picks, drawn_mask
from jawusd.synthetic.person import Person
from jawusd.synthetic.take import LEAD, T_WORLD_SCAN, TAIL, Take, build_cameras, perform

PERSON = Person(0)


@pytest.fixture(scope="module")
def anatomy() -> PersonAnatomy:
    return build_anatomy(PERSON)


@pytest.fixture(scope="module")
def take(anatomy: PersonAnatomy) -> Take:
    return perform(PERSON, anatomy.occlusion, 240, (0, 5, -3), 1)


def test_every_frame_of_every_camera_has_its_instant(take: Take) -> None:
    frames = LEAD + 240 + TAIL
    for offset in (0, 5, -3):
        assert take.first_instant <= offset
        assert frames - 1 + offset < take.first_instant + len(take.phase)
    assert take.tracked == (LEAD, LEAD + 240)


def test_both_flashes_are_in_every_video(take: Take) -> None:
    for offset in (0, 5, -3):
        for first, last in take.dark - offset:
            assert 0 < first < last < LEAD + 240 + TAIL
            assert not (take.tracked[0] - offset < last and first < take.tracked[1] - offset)
    dark_rows = np.flatnonzero(take.light < 0.5) + take.first_instant
    np.testing.assert_array_equal(dark_rows, np.concatenate([np.arange(*d) for d in take.dark]))


def test_the_rest_frame_is_the_closed_bite(take: Take) -> None:
    row = take.rest_frame - take.first_instant
    assert take.phase[row] == "rest"
    assert np.linalg.norm(se3_log(take.T_skull_mandible[row])) < 0.2


def test_the_exercises_cover_the_envelope(take: Take) -> None:
    phases = set(take.phase)
    assert {"open", "lateral", "protrude", "frontal border", "chew", "circumduct", "rest"} <= phases
    opening, lateral, protrusion = take.controls.T
    assert opening.max() > 0.8 and np.ptp(lateral) > 1.5 and protrusion.max() > 0.7 and protrusion.min() < -0.4


def test_teeth_never_run_into_each_other(take: Take, anatomy: PersonAnatomy) -> None:
    assert min(anatomy.occlusion.gap(T) for T in take.T_skull_mandible) > -0.02


def test_the_head_moves_a_few_millimetres_and_degrees_smoothly(take: Take) -> None:
    motion = se3_inverse(T_WORLD_SCAN) @ take.T_world_skull
    angle_deg = np.rad2deg(np.linalg.norm(se3_log(motion)[:, :3], axis=1))
    assert 1.0 < angle_deg.max() < 8.0
    mouth = transform_point(motion, np.zeros(3))
    assert 1.0 < np.ptp(mouth, axis=0).max() < 20.0
    assert np.linalg.norm(np.diff(mouth, 2, axis=0), axis=1).max() < 0.2


def test_lips_hold_still_enough_to_show_teeth(take: Take) -> None:
    upper = np.array([lips.upper_mm for lips in take.lips])
    assert upper.min() > 3.0 and upper.max() < 12.0 and upper.std() > 0.3


def test_the_lower_lip_follows_the_jaw_and_the_upper_does_not() -> None:
    face, lips = Face(PERSON.joint.incisor), LipState(8.0, 8.0, 27.0, 0.0)
    T = PERSON.pose(0.8, 0.0, 0.0)
    rest, open_ = (face.posed(lips, pose).reshape(face.rows, -1, 3) for pose in (np.eye(4), T))
    edge = 7  # row of the lips' edge: four rows of lining, three of the wet side
    columns = rest.shape[1]
    top, bottom = columns // 4, 3 * columns // 4
    np.testing.assert_allclose(open_[edge, top], rest[edge, top], atol=1e-9)
    np.testing.assert_allclose(open_[edge, bottom], transform_point(T, rest[edge, bottom]), atol=1e-9)
    assert rest[edge, top, 1] - rest[edge, bottom, 1] > 12
    assert open_[edge, top, 1] - open_[edge, bottom, 1] > 40


def test_surfaces_of_the_mouth_have_sound_faces() -> None:
    for surface in (palate(), tongue(3.0, 4.0, 1.0)):
        assert surface.faces.max() == len(surface.vertices) - 1
        assert np.isfinite(surface.vertices).all()
        assert surface.colors.shape == surface.vertices.shape


def test_outline_jitter_has_the_stated_size_and_constant_share() -> None:
    outline = Outline((1920, 1080), np.random.default_rng(0))
    fields = np.stack([outline.next() for _ in range(60)])
    assert fields.std() == pytest.approx(0.7, rel=0.06)
    now, later = fields[:-10].ravel(), fields[10:].ravel()
    assert 0.35 < np.corrcoef(now, later)[0, 1] < 0.65  # half of the variance is constant
    cell = fields[0, :, :, 0]
    assert np.corrcoef(cell[:, :-1].ravel(), cell[:, 1:].ravel())[0, 1] > 0.9  # smooth within a cell
    assert abs(np.corrcoef(cell[:, :-12].ravel(), cell[:, 12:].ravel())[0, 1]) < 0.2
    assert Outline((960, 540), np.random.default_rng(0)).next().std() == pytest.approx(0.35, rel=0.2)


def test_drawn_masks_are_binary_with_rare_small_blemishes() -> None:
    coverage = np.zeros((540, 960), np.uint8)
    coverage[200:300, 300:600] = 255
    rng = np.random.default_rng(2)
    changed = []
    for _ in range(200):
        mask = drawn_mask(coverage, rng)
        assert set(np.unique(mask)) <= {0, 255}
        changed.append((mask != coverage).sum())
    changed = np.array(changed)
    assert 0.05 < (changed > 0).mean() < 0.4
    assert 0 < changed.max() < 200
    assert not drawn_mask(np.zeros_like(coverage), rng).any()


def _occluders(anatomy: PersonAnatomy, T_jaw: np.ndarray) -> list[Mesh]:
    parts = ((T_WORLD_SCAN, anatomy.upper.mesh), (T_WORLD_SCAN @ T_jaw, anatomy.lower.mesh))
    return [Mesh(transform_points(T, mesh.vertices), mesh.faces) for T, mesh in parts]


def test_picks_are_spread_tips_near_their_projections(anatomy: PersonAnatomy) -> None:
    cameras = build_cameras((1280, 720))
    T_jaw = PERSON.pose(0.2, 0.0, 0.0)
    rng = np.random.default_rng(0)
    picks = choose_picks(anatomy.lower, T_WORLD_SCAN @ T_jaw, cameras, _occluders(anatomy, T_jaw), 4, 1.0, rng)
    points = anatomy.lower.mesh.vertices[[pick.vertex for pick in picks]]
    assert len(picks) == 4 and np.ptp(points[:, 0]) > 25
    for pick, point in zip(picks, points, strict=True):
        assert anatomy.lower.tooth[pick.vertex] != 0 and len(pick.views) == 2
        for view in pick.views:
            camera = next(c for c in cameras if c.name == view.camera)
            miss = camera.project(transform_point(T_WORLD_SCAN @ T_jaw, point)) - [view.x, view.y]
            assert 0 < np.abs(miss).max() < 5


def test_hidden_teeth_cannot_be_picked(anatomy: PersonAnatomy) -> None:
    cameras = build_cameras((1280, 720))
    wall = np.array([[-90, -90, 150], [90, -90, 150], [-90, 90, 150], [90, 90, 150.0]])
    everything = [*_occluders(anatomy, np.eye(4)), Mesh(wall, np.array([[0, 1, 2], [1, 3, 2]], np.int32))]
    with pytest.raises(ValueError, match="visible in two cameras"):
        choose_picks(anatomy.upper, T_WORLD_SCAN, cameras, everything, 4, 1.0, np.random.default_rng(0))
