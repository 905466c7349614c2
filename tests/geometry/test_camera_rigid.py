"""Cameras against OpenCV; alignment and triangulation against known answers."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jawusd.geometry import Camera, make_transform, random_rotation, rigid_fit, transform_points, triangulate

DISTORTIONS = [(), (-0.2, 0.1, 0.001, -0.002), (-0.15, 0.05, 0.001, 0.002, 0.01), (-0.2, 0.1, 0.001, 0, 0, 0.1, 0, 0)]


def camera(distortion=(), seed=0):
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec(rng.normal(size=3) * 0.3).as_matrix()
    K = np.array([[1500.0, 0, 970], [0, 1490, 530], [0, 0, 1]])
    return Camera("c", (1920, 1080), K, np.array(distortion), make_transform(R, [5.0, -8, 200]))


def points(n=200):
    return np.random.default_rng(1).uniform(-40, 40, (n, 3))


@pytest.mark.parametrize("distortion", DISTORTIONS)
def test_projection_is_opencvs(distortion):
    c, p = camera(distortion), points()
    rvec = cv2.Rodrigues(c.T_cam_world[:3, :3])[0]
    expected = cv2.projectPoints(p, rvec, c.T_cam_world[:3, 3], c.K, c.distortion if len(distortion) else None)[0][:, 0]
    np.testing.assert_allclose(c.project(p), expected, atol=1e-9)
    np.testing.assert_allclose(c.undistort_pixels(expected), c.project_pinhole(p), atol=1e-9)


def test_scaled_camera_sees_the_area_averaged_picture():
    """A disc drawn large and averaged down must appear where the scaled camera puts it."""
    c = camera()
    p = np.array([[3.0, -2.0, 1.0]])
    u, v = c.project_pinhole(p)[0]
    y, x = np.mgrid[0:1080, 0:1920]
    picture = np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 6.0**2)).astype(np.float32)
    small = cv2.resize(picture, (640, 360), interpolation=cv2.INTER_AREA)
    y, x = np.mgrid[0:360, 0:640]
    found = np.array([(small * x).sum(), (small * y).sum()]) / small.sum()
    np.testing.assert_allclose(c.scaled((640, 360)).project_pinhole(p)[0], found, atol=0.01)


def test_cropped_camera_shifts_pixels_and_keeps_distortion():
    c = camera(DISTORTIONS[2])
    np.testing.assert_allclose(c.cropped(100, 50, (300, 200)).project(points()), c.project(points()) - [100, 50])


def test_camera_centre_projects_from_nowhere():
    c = camera()
    np.testing.assert_allclose(c.T_cam_world @ np.append(c.centre_world(), 1), [0, 0, 0, 1], atol=1e-12)
    assert c.depth(points(3)).shape == (3,)


def test_unknown_distortion_count_is_refused():
    with pytest.raises(ValueError, match="distortion"):
        camera((0.1, 0.2, 0.3))


def test_rigid_fit_recovers_a_motion_and_never_mirrors():
    rng = np.random.default_rng(3)
    T = make_transform(random_rotation(rng), rng.normal(size=3) * 50)
    p = points(4)
    np.testing.assert_allclose(rigid_fit(p, transform_points(T, p)), T, atol=1e-10)
    assert np.linalg.det(rigid_fit(p, p * [-1, 1, 1])[:3, :3]) == pytest.approx(1)
    q = transform_points(T, p)
    q[0] += 10
    np.testing.assert_allclose(rigid_fit(p, np.stack([q, p])), [rigid_fit(p, q), np.eye(4)], atol=1e-12)
    weighted = rigid_fit(p, q, weights=[0, 1, 1, 1])
    np.testing.assert_allclose(weighted, T, atol=1e-10)


def test_rigid_fit_refuses_a_line():
    line = np.arange(5)[:, None] * np.array([[1.0, 2, 3]])
    with pytest.raises(ValueError, match="line"):
        rigid_fit(line, line)


def test_triangulation_meets_exact_views_and_averages_noisy_ones():
    cameras = [camera(seed=s) for s in range(4)]
    M = np.stack([c.projection_matrix() for c in cameras])
    p = np.array([1.0, 2.0, 3.0])
    x = np.stack([c.project_pinhole(p) for c in cameras])
    np.testing.assert_allclose(triangulate(M[:2], x[:2]), p, atol=1e-9)
    rng = np.random.default_rng(4)
    errors = [np.linalg.norm(triangulate(M, x + rng.normal(size=x.shape)) - p) for _ in range(50)]
    assert np.median(errors) < 0.4
    with pytest.raises(ValueError, match="C >= 2"):
        triangulate(M[:1], x[:1])
