"""Photographs of closed teeth: lines, lens, contact, and the bite of scans in frames of their own."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from jawusd.errors import TrackingError
from jawusd.geometry import make_transform, random_rotation, se3_exp, se3_inverse, so3_exp, transform_point
from jawusd.imaging.raster import draw_depth_labels, project
from jawusd.synthetic.bite import build_bite
from jawusd.synthetic.dentition import without_gum
from jawusd.synthetic.population import draw_traits
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.photographs import align, read_lines, search, start
from jawusd.tracking.photographs.contact import Contact
from jawusd.tracking.photographs.lens import UNKNOWNS, PhotoPose
from jawusd.tracking.photographs.search import usual_bites
from jawusd.tracking.photographs.solve import Aligner, Bite, Photo
from jawusd.tracking.photographs.start import Rows

SIZE, FOCAL = (720, 540), 1500.0
VIEWS = {"front": 0.0, "left": 0.9, "right": -0.9}  # yaw


class Mouth:
    """A person of the population: both crowns moved to frames of their own, and pictures of the teeth together."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        self.bite = build_bite(replace(draw_traits(seed), gums="crowns"))
        self.T_own = [make_transform(random_rotation(rng), rng.normal(size=3) * 20) for _ in range(2)]
        self.meshes = []
        for arch, T in zip((self.bite.upper, self.bite.lower), self.T_own):
            crowns = without_gum(arch)
            self.meshes.append(replace(crowns, vertices=crowns.vertices @ T[:3, :3].T + T[:3, 3], colors=None))
        self.T_upper_lower = self.T_own[0] @ se3_inverse(self.T_own[1])
        self.incisor = transform_point(self.T_own[1], self.bite.incisor)

    def pose(self, yaw):
        """Return T_cam_world of a view; the world is the frame of the bite."""
        R = so3_exp([0.08, 0, 0]) @ np.diag([1.0, -1.0, -1.0]) @ so3_exp([0, yaw, 0])
        return make_transform(R, np.array([0.0, -2.0, 150.0]) - R @ [0.0, 0.0, -15.0])

    def draw(self, yaw):
        """Return lines as a person draws them, 3 px wide: where one tooth, gum or nothing meets another tooth."""
        K = np.array([[FOCAL, 0, 359.5], [0, FOCAL, 269.5], [0, 0, 1]])
        depth, labels = np.zeros(SIZE[::-1], np.float32), np.zeros(SIZE[::-1], np.uint8)
        for r, arch in enumerate((self.bite.upper, self.bite.lower)):
            points = np.empty((len(arch.mesh.vertices), 3), np.float32)
            project(arch.mesh.vertices.astype(np.float32), (K @ self.pose(yaw)[:3]).astype(np.float32), points)
            numbers = arch.tooth[arch.mesh.faces[:, 0]]
            for tooth in np.unique(numbers):
                label = 0 if tooth == 0 else int(tooth) + 20 + 40 * r
                draw_depth_labels(points, arch.mesh.faces[numbers == tooth], 0, 0, False, depth, labels, label)
        edge = np.zeros(labels.shape, np.uint8)
        edge[:, 1:][labels[:, 1:] != labels[:, :-1]] = 255
        edge[1:][labels[1:] != labels[:-1]] = 255
        return cv2.dilate(edge, np.ones((2, 2), np.uint8))

    def off_mm(self, T_upper_lower):
        """Return how far a bite puts the lower incisal point from where it is."""
        return float(
            np.linalg.norm(
                transform_point(T_upper_lower, self.incisor) - transform_point(self.T_upper_lower, self.incisor)
            )
        )


@pytest.fixture(scope="module")
def mouth():
    return Mouth(9)


@pytest.fixture(scope="module")
def rows(mouth):
    scans = [prepare_scan(mesh, name) for mesh, name in zip(mouth.meshes, ("upper", "lower"))]
    # of both sides that either row may stand on, the true ones
    usual = min(usual_bites(scans), key=lambda one: mouth.off_mm(one.T_upper_lower) - 50 * one.T_anatomical_upper[1, :3]
                @ mouth.T_own[0][:3, :3][:, 1])
    return Rows.of(scans, usual), Contact(scans)


def test_lines_are_found_to_a_fraction_of_a_pixel():
    picture = np.zeros((400, 500), np.uint8)
    cv2.circle(picture, (250 * 16 + 5, 200 * 16 + 11), 120 * 16, 255, 3, cv2.LINE_AA, 4)
    picture[20, 20:40] = 255  # a slip of the pen
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
    with pytest.raises(TrackingError, match="front: 0 px of lines"):
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


def aligned(mouth, rows, contact, names, seed=0):
    """Return photographs begun a few degrees and millimetres off, with a focal length 20 % off."""
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
    bite = aligner.aligned(Bite(tuple(photos), T, np.zeros(2)), [2.0] * 4 + [1.2] * 4 + [0.8] * 6)
    return bite, aligner


def test_three_photographs_tell_the_bite_and_the_focal_length(mouth, rows):
    rows, contact = rows
    bite, aligner = aligned(mouth, rows, contact, VIEWS)
    assert mouth.off_mm(bite.T_upper_lower) < 0.2
    for photo in bite.photos:
        assert abs(photo.pose.focal_px / FOCAL - 1.0) < 0.05
    assert aligner.misfit(bite, 0.5).max() < 0.2


def test_one_photograph_with_contact_tells_the_bite(mouth, rows):
    rows, contact = rows
    bite, _ = aligned(mouth, rows, contact, ["left"], seed=2)
    assert mouth.off_mm(bite.T_upper_lower) < 0.6


@pytest.fixture
def small_search(monkeypatch):
    """Search few directions, from small pictures, on the true side of either row."""
    monkeypatch.setattr(search, "_YAW", np.radians([-50.0, 0.0, 50.0]))
    monkeypatch.setattr(search, "_PITCH", np.radians([0.0]))
    monkeypatch.setattr(search, "_ROLL", np.radians([0.0]))
    monkeypatch.setattr(start, "_CANDIDATES", 2)
    monkeypatch.setattr(start, "_FINALISTS", 1)
    monkeypatch.setattr(align, "_STAGES", ((0.25, (2.5, 2.0, 2.0, 1.5)), (0.5, (1.5, 1.2, 1.0, 1.0, 1.0))))


def with_gum(mouth):
    """Return the scans with gum, which says which side of either row is up, painted."""
    out = []
    for arch, T in zip((mouth.bite.upper, mouth.bite.lower), mouth.T_own):
        mesh = arch.mesh
        out.append(replace(mesh, vertices=mesh.vertices @ T[:3, :3].T + T[:3, 3]))
    return out


def quiet(stage, done, total):
    pass


def test_photographs_are_aligned_from_nothing_one_over_a_mirror(mouth, small_search):
    drawings = [read_lines(mouth.draw(VIEWS["front"]), "front"), read_lines(mouth.draw(VIEWS["left"]), "left").mirrored()]
    found = align.align_photographs(drawings, with_gum(mouth), quiet).result
    assert [photo.mirrored for photo in found.photos] == [False, True]
    assert mouth.off_mm(found.T_upper_lower) < 0.5
    assert not [finding for finding in found.findings if finding.severity == "error"]
    for photo in found.photos:
        assert photo.outline_rms_px < 8.0 and abs(photo.focal_px / FOCAL - 1.0) < 0.1


def test_crowns_of_somebody_else_are_named(mouth, small_search):
    found = align.align_photographs(
        [read_lines(mouth.draw(VIEWS["front"]), "front")], with_gum(Mouth(10)), quiet
    ).result
    errors = [finding for finding in found.findings if finding.severity == "error"]
    assert [error.kind for error in errors] == ["photo_unfit"] and errors[0].camera == "front"
