"""The first pose of a take of a jaw with a rig, searched with one camera."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import small_take
from bumpy_teeth import make_cameras
from rig_take import COUNT, write_masks

from jawusd.evaluator import JawRig
from jawusd.geometry import transform_point
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import masked_sources
from jawusd.tracking.initialization.footage import Footage
from jawusd.tracking.initialization.pose_search import Candidate
from jawusd.tracking.performance import single_start
from jawusd.tracking.performance.coordinates import Coordinates, Pose
from jawusd.tracking.performance.single_start import SingleStart


def prepared(jaw, scans, truth, folder, camera):
    """Return the search with one camera, and the masks it searches."""
    source = small_take.source(folder, camera.name)
    capture = small_take.make_capture(folder, COUNT, cameras=[source], bootstrap=None)
    with_d = JawRig({**jaw.arrays, "codes": np.vstack([truth[0], [[2.0, 0, 0], [14.0, 1, 1]]])}, jaw.meta)
    table = {camera.name: camera}
    footage = Footage(
        masked_sources(capture.cameras, table, small_take.OFFSETS, 1), table, small_take.OFFSETS, capture.frames, 1
    )
    return SingleStart(small_take.MESHES, ContourSolver(scans, TrackingConfig()), with_d, np.eye(4)), footage


def begun(jaw, scans, truth, folder, camera):
    """Search for the start with one camera; return the step from the true pose of the frame found."""
    search, footage = prepared(jaw, scans, truth, folder, camera)
    found = search.find(footage)
    k = found.frame - small_take.FIRST
    return Coordinates(jaw, scans).step(Pose(truth[1][k], truth[0][k]), found.pose)


@pytest.mark.parametrize(("arch", "off"), [(0, [-15.0, 0, 0]), (1, [18.0, 8, 0])])
def test_a_start_in_which_only_one_arch_is_in_place_is_aligned_from_other_jaws(jaw, scans, truth, folder, arch, off):
    camera, coordinates, k = small_take.CAMERAS[0], Coordinates(jaw, scans), int(truth[0][:, 0].argmax())
    search, footage = prepared(jaw, scans, truth, folder, camera)
    true = Pose(truth[1][k], truth[0][k])
    start = coordinates.with_jaw(true, true.d + off, arch)
    frame, px_per_mm = small_take.FIRST + k, TrackingConfig().working_px_per_mm
    with footage.views(transform_point(true.head, scans[0].centre), px_per_mm) as masks:
        views = masks.at(frame)
    assert not search._fine.near(start, search._fine.instant(views)).found.all()
    away = coordinates.step(true, search._refined(start, views, frame).pose)
    assert np.abs(away[:3]).max() < 0.03 and np.abs(away[3:]).max() < 1.5


@pytest.mark.parametrize("arch", [0, 1])
def test_other_jaw_parameters_leave_an_arch_in_place(jaw, scans, truth, arch):
    coordinates = Coordinates(jaw, scans)
    pose = Pose(truth[1][0], truth[0][0], np.array([0.01, 0, 0, 0.2, 0, 0]))
    moved = coordinates.with_jaw(pose, pose.d + [6.0, 1, 0], arch)
    np.testing.assert_allclose(coordinates.arches(moved)[arch], coordinates.arches(pose)[arch], atol=1e-9)
    assert moved.d == pytest.approx(pose.d + [6.0, 1, 0])


@pytest.mark.parametrize(("kept", "arch"), [(1.0, 0), (0.2, 1)])
def test_poses_of_the_lower_teeth_are_searched_if_lips_hide_most_upper_ones(
    jaw, scans, truth, folder, tmp_path, monkeypatch, kept, arch
):
    camera, hidden, searched = small_take.CAMERAS[0], shutil.copytree(folder, tmp_path / "hidden"), []
    for path in (hidden / camera.name / "upper").glob("*.png"):
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        rows = np.flatnonzero(mask.any(1))
        mask[: int(rows[-1] - kept * np.ptp(rows))] = 0
        cv2.imwrite(str(path), mask)
    search, footage = prepared(jaw, scans, truth, hidden, camera)
    monkeypatch.setattr(single_start, "search_arch", lambda scan, which, *rest: searched.append(which) or [])
    assert search.at(footage, small_take.FIRST) is None and set(searched) == {arch}


@pytest.mark.parametrize("arch", [0, 1])
def test_jaw_poses_are_tried_around_the_pose_of_either_arch(jaw, scans, truth, folder, arch):
    camera, coordinates, k = small_take.CAMERAS[0], Coordinates(jaw, scans), int(truth[0][:, 0].argmax())
    search, footage = prepared(jaw, scans, truth, folder, camera)
    true = coordinates.arches(Pose(truth[1][k], truth[0][k]))
    with footage.views(transform_point(true[0], scans[0].centre), 2.0) as masks:
        views = masks.at(small_take.FIRST + k)
    pairs = search._with_jaws(views, arch, Candidate(100.0, true[arch]))
    for _, pose in pairs:
        np.testing.assert_allclose(coordinates.arches(pose)[arch], true[arch], atol=1e-6)
    off = transform_point(coordinates.arches(pairs[0][1])[1 - arch], scans[0].centre) - transform_point(
        true[1 - arch], scans[0].centre
    )
    assert np.linalg.norm(off) < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("turns", [0, 1])
def test_one_camera_finds_where_to_begin(jaw, scans, truth, folder, tmp_path, turns):
    """The camera may lie on its side."""
    camera = small_take.CAMERAS[0]
    turned_folder = shutil.copytree(folder, tmp_path / "turned")
    for path in turned_folder.rglob("*.png"):
        cv2.imwrite(str(path), np.rot90(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), turns))
    away = begun(jaw, scans, truth, turned_folder, turned(camera, turns))
    assert np.abs(away[:3]).max() < 0.03 and np.abs(away[3:]).max() < 1.5


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_the_distances_tried_do_not_depend_on_how_the_camera_is_turned(folder, turns):
    """The width of the teeth is measured along the arches, not along the rows of the image."""
    camera, k = small_take.CAMERAS[0], small_take.START
    masks = np.stack([cv2.imread(str(small_take.png(folder, camera.name, row, k)), 0) for row in ("upper", "lower")])
    upright, sideways = (
        single_start._places(
            SimpleNamespace(
                masks=np.rot90(masks, n, axes=(1, 2)), matrix=view.projection_matrix(), eye=view.centre_world()
            )
        )
        for n, view in ((0, camera), (turns, turned(camera, turns)))
    )
    np.testing.assert_allclose(sideways, upright, atol=1.0)


def turned(camera, turns):
    """Return a camera turned about its axis, whose images are those of the given one after `np.rot90`."""
    for _ in range(turns):
        (width, height), K = camera.size_px, camera.K.copy()
        K[[0, 1], [0, 1]], K[:2, 2] = camera.K[[1, 0], [1, 0]], (camera.K[1, 2], width - 1 - camera.K[0, 2])
        quarter = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        camera = replace(camera, K=K, T_cam_world=quarter @ camera.T_cam_world, size_px=(height, width))
    return camera


@pytest.mark.slow
def test_a_side_camera_finds_where_to_begin_from_half_of_the_teeth(jaw, scans, truth, tmp_path, monkeypatch):
    """The centres of the masks lie far beside the front teeth; only one frame is searched."""
    monkeypatch.setattr("jawusd.tracking.performance.single_start._MOST_TRIED", 1)
    camera = make_cameras((45.0,))[0]
    folder = write_masks(tmp_path, jaw, truth, [camera])
    for path in folder.rglob("*.png"):
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        mask[:, : int(np.percentile(np.nonzero(mask)[1], 45))] = 0
        cv2.imwrite(str(path), mask)
    away = begun(jaw, scans, truth, folder, camera)
    assert np.abs(away[:3]).max() < 0.05 and np.abs(away[3:]).max() < 2.0
