"""Photographs of closed teeth: lines, lens, contact, and the bite of scans in arbitrary frames."""

import cv2
import numpy as np
import pytest
from closed_mouth import FOCAL, SIZE, VIEWS, Mouth, search_little

from jawusd.base.errors import TrackingError
from jawusd.geometry import make_transform, se3_exp, se3_inverse, transform_point
from jawusd.photographs import align
from jawusd.photographs.drawing import read_lines
from jawusd.photographs.search import ArchPair, typical_bites
from jawusd.photographs.solve import UNKNOWNS, Aligner, Bite, Contact, Photo, PhotoPose
from jawusd.tracking.contour.scan import prepare_scan


@pytest.fixture(scope="module")
def mouth():
    return Mouth(9)


@pytest.fixture(scope="module")
def rows(mouth):
    scans = [prepare_scan(mesh, name) for mesh, name in zip(mouth.meshes, ("upper", "lower"))]
    # of the possible vertical directions of both arches, the true ones
    usual = min(
        typical_bites(scans),
        key=lambda one: (
            mouth.off_mm(one.T_upper_lower) - 50 * one.T_anatomical_upper[1, :3] @ mouth.T_own[0][:3, :3][:, 1]
        ),
    )
    return ArchPair.of(scans, usual), Contact(scans)


def test_lines_are_found_to_a_fraction_of_a_pixel():
    picture = np.zeros((400, 500), np.uint8)
    cv2.circle(picture, (250 * 16 + 5, 200 * 16 + 11), 120 * 16, 255, 3, cv2.LINE_AA, 4)
    picture[20, 20:40] = 255  # a stray stroke
    lines = read_lines(picture, "circle")
    away = lines.pixels - [250 + 5 / 16, 200 + 11 / 16]
    radius = np.linalg.norm(away, axis=1)
    assert np.abs(radius - 120).max() < 0.3 and abs(radius.mean() - 120) < 0.12
    assert len(lines.pixels) > 0.8 * 2 * np.pi * 120
    assert np.abs((lines.normals * away).sum(1) / radius).min() > 0.98
    mirror = lines.mirrored()
    assert np.allclose(mirror.pixels[:, 0], 499 - lines.pixels[:, 0])
    assert np.allclose(lines.shrunk(0.5).size_px, (250, 200))


def test_an_empty_picture_is_refused():
    with pytest.raises(TrackingError, match="front: the drawn lines cover 0 px"):
        read_lines(np.zeros((300, 400), np.uint8), "front")


def test_slopes_of_a_lens_are_those_of_differences():
    rng = np.random.default_rng(1)
    pose = PhotoPose(se3_exp(np.r_[rng.normal(size=3), 5, -3, 140.0]), 1300.0, -0.07)
    p = rng.normal(size=(5, 3)) * 12
    centre = transform_point(pose.T_cam_upper, p[0])
    cam = np.array([transform_point(pose.T_cam_upper, x) for x in p])
    n = rng.normal(size=(5, 2))
    by_point, by_lens = pose.slopes(cam, n, SIZE, centre[2])
    J = np.hstack([np.cross(cam - centre, by_point), by_point, by_lens])
    for k in range(UNKNOWNS):
        ends = []
        for h in (-1e-6, 1e-6):
            other = pose.stepped(centre, h * np.eye(UNKNOWNS)[k])
            moved = np.array([transform_point(other.T_cam_upper, x) for x in p])
            ends.append((other.pixels(moved, SIZE) * n).sum(1))
        assert np.allclose((ends[1] - ends[0]) / 2e-6, J[:, k], rtol=1e-5, atol=1e-4)


def test_distortion_is_written_as_opencv_knows_it():
    pose = PhotoPose(np.eye(4), 900.0, 0.05)
    points = np.array([[20.0, 10, 100], [-30, 5, 90]])
    K = pose.camera_matrix(SIZE)
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array([pose.opencv_k1(SIZE), 0, 0, 0]))[0]
    assert np.allclose(pose.pixels(points, SIZE), theirs[:, 0])


def test_contact_holds_teeth_together(mouth, rows):
    _, contact = rows
    centre = transform_point(mouth.T_upper_lower, mouth.incisor)
    up = mouth.T_own[0][:3, 1]

    def cost(mm):
        _, away, weight = contact.equations(make_transform(np.eye(3), mm * up) @ mouth.T_upper_lower, centre)
        return float((weight * away**2).sum())

    assert cost(0.0) < min(cost(-0.8), cost(0.8))
    assert contact.depth_mm(mouth.T_upper_lower) < 0.2
    assert contact.depth_mm(make_transform(np.eye(3), 1.0 * up) @ mouth.T_upper_lower) > 0.6


def aligned(mouth, rows, contact, names, seed=0, last=6):
    """Return photographs with starts a few degrees and millimetres off, and a focal length 20 % off."""
    rng = np.random.default_rng(seed)
    photos = []
    for name in names:
        lines = read_lines(mouth.draw(VIEWS[name]), name)
        T = mouth.pose(VIEWS[name]) @ se3_inverse(mouth.T_own[0])
        centre = transform_point(T, rows.fine[0].scan.centre)
        step = np.r_[rng.normal(size=3) * 0.05, rng.normal(size=3) * 0.5, 0.2, 0.0]
        photos.append(Photo(lines, PhotoPose(T, FOCAL, 0.0).stepped(centre, step)))
    T = make_transform(np.eye(3), rng.normal(size=3) * 0.7) @ mouth.T_upper_lower
    aligner = Aligner(rows.thin, rows.usual.T_upper_lower, contact)
    bite = aligner.aligned(Bite(tuple(photos), T, np.zeros(2)), [2.0] * 4 + [1.2] * 4 + [0.8] * last)
    return bite, aligner


@pytest.mark.slow
def test_three_photographs_tell_the_bite_and_the_focal_length(mouth, rows):
    rows, contact = rows
    bite, aligner = aligned(mouth, rows, contact, VIEWS)
    assert mouth.off_mm(bite.T_upper_lower) < 0.2
    for photo in bite.photos:
        assert abs(photo.pose.focal_px / FOCAL - 1.0) < 0.05
    assert aligner.misfit(bite, 0.5).max() < 0.2


@pytest.mark.slow
def test_one_photograph_tells_the_bite_across_its_line_of_sight(mouth, rows):
    rows, contact = rows
    bite, _ = aligned(mouth, rows, contact, ["left"], seed=2, last=20)
    away = transform_point(bite.T_upper_lower, mouth.incisor) - transform_point(mouth.T_upper_lower, mouth.incisor)
    across = bite.photos[0].pose.T_cam_upper[:2, :3] @ away
    # The arches also touch elsewhere if one of them moves along the line of sight.
    assert np.linalg.norm(across) < 0.6 and np.linalg.norm(away) < 2.5


@pytest.fixture
def small_search(monkeypatch):
    """Search few directions, in small images."""
    search_little(monkeypatch)


def quiet(stage, done, total):
    pass


@pytest.mark.slow
def test_photographs_are_aligned_from_nothing_one_over_a_mirror(mouth, small_search):
    drawings = [
        read_lines(mouth.draw(VIEWS["front"]), "front"),
        read_lines(mouth.draw(VIEWS["left"]), "left").mirrored(),
    ]
    found = align.align_photographs(drawings, mouth.with_gum(), quiet).result
    assert [photo.mirrored for photo in found.photos] == [False, True]
    assert mouth.off_mm(found.T_upper_lower) < 0.3
    assert not [finding for finding in found.findings if finding.severity == "error"]
    for photo in found.photos:
        assert photo.outline_rms_px < 4.0 and abs(photo.focal_px / FOCAL - 1.0) < 0.1
        assert photo.misfit < 0.15 and photo.alone_off_mm < 0.5


@pytest.mark.slow
def test_crowns_of_somebody_else_are_named(mouth, small_search):
    found = align.align_photographs(
        [read_lines(mouth.draw(VIEWS["front"]), "front")], Mouth(10).with_gum(), quiet
    ).result
    errors = [finding for finding in found.findings if finding.severity == "error"]
    assert [error.kind for error in errors] == ["photo_unfit"] and errors[0].camera == "front"
