"""Implausible calibrations are found from their numbers alone, without false alarms."""

from dataclasses import replace

import numpy as np
import pytest

from jawusd.capture.camera_checks import camera_findings, centre_findings, common_target, width_findings
from jawusd.geometry import Camera, make_transform, se3_exp

SIZE = (1280, 720)
TEETH = np.array([5.0, -8.0, 210.0])


def camera(name, at_mm, towards=TEETH):
    """Return a camera that looks at a point."""
    at, forward = np.asarray(at_mm, np.float64), np.asarray(towards, np.float64) - at_mm
    forward = forward / np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    K = np.array([[1500.0, 0, 639.5], [0, 1500.0, 359.5], [0, 0, 1]])
    return Camera(name, SIZE, K, np.array([-0.1, 0.02, 0, 0, 0]), make_transform(R, -R @ at))


CAMERAS = [camera("cam0", [0, 0, 0]), camera("cam1", [-120, 10, 30]), camera("cam2", [130, -20, 40])]


def kinds(cameras):
    return {finding.kind for finding in camera_findings(cameras, "calibration.toml")}


def changed(k, **values):
    return [replace(one, **values) if index == k else one for index, one in enumerate(CAMERAS)]


def with_matrix(k, row, column, value):
    K = CAMERAS[k].K.copy()
    K[row, column] = value
    return changed(k, K=K)


def in_metres():
    return [replace(c, T_cam_world=make_transform(c.T_cam_world[:3, :3], c.T_cam_world[:3, 3] / 1000)) for c in CAMERAS]


def test_good_cameras_are_not_accused():
    assert kinds(CAMERAS) == set()
    assert np.linalg.norm(common_target(CAMERAS) - TEETH) < 1e-6


@pytest.mark.parametrize(
    ("kind", "cameras"),
    [
        ("focal_length", with_matrix(1, 0, 0, 150.0)),
        ("pixels_not_square", with_matrix(1, 1, 1, 1650.0)),
        ("principal_point", with_matrix(2, 0, 2, 100.0)),
        ("distortion_folds", changed(1, distortion=np.array([-1.5, 0, 0, 0, 0]))),
        ("cameras_together", in_metres()),
        ("cameras_far_apart", changed(2, T_cam_world=make_transform(np.eye(3), [9000.0, 0, 0]))),
        ("camera_aim", changed(0, T_cam_world=make_transform(np.diag([-1.0, 1.0, -1.0]), [0.0, 0, 0]))),
        ("views_alike", [camera("cam0", [0, 0, 0]), camera("cam1", [10.5, 0, 0])]),
    ],
)
def test_each_kind_of_wrong_calibration_is_told(kind, cameras):
    assert kind in kinds(cameras)


def middles(cameras, place=TEETH):
    return {c.name: c.project(place) for c in cameras}


def test_masks_that_see_one_place_are_accepted_and_a_turned_camera_is_accused():
    table = {c.name: c for c in CAMERAS}
    instants = [[middles(CAMERAS, TEETH + [k, 2 * k, k])] for k in range(5)]
    assert not list(centre_findings(table, instants))
    turned = {**table, "cam1": replace(CAMERAS[1], T_cam_world=se3_exp([0.12, 0, 0, 0, 0, 0]) @ CAMERAS[1].T_cam_world)}
    (found,) = centre_findings(turned, instants)
    assert found.kind == "cameras_contradict" and found.camera == "cam1" and found.value > found.limit


def test_the_best_guess_of_the_offsets_counts():
    table = {c.name: c for c in CAMERAS}
    wrong = {name: px + [0, 150.0 if name == "cam1" else 0] for name, px in middles(CAMERAS).items()}
    assert list(centre_findings(table, [[wrong]]))
    assert not list(centre_findings(table, [[wrong, middles(CAMERAS)]]))


def test_teeth_of_impossible_size_are_told():
    table = {c.name: c for c in CAMERAS}
    mouth = TEETH + np.random.default_rng(0).uniform(-1, 1, (400, 3)) * [22, 5, 8]
    assert not list(width_findings(table, {c.name: c.project(mouth) for c in CAMERAS}))
    in_cm = {
        c.name: replace(c, T_cam_world=make_transform(c.T_cam_world[:3, :3], c.T_cam_world[:3, 3] / 10))
        for c in CAMERAS
    }
    (found,) = width_findings(in_cm, {c.name: c.project(mouth) for c in CAMERAS})
    assert found.kind == "teeth_size" and found.value < found.limit
