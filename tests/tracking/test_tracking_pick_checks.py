"""Masks that lie elsewhere than the picks place the scans are told, and which exchange explains them."""

import numpy as np
import pytest
from small_take import CAMERAS, MESHES, jaw_poses

from jawusd.formats.capture import Bootstrap
from jawusd.geometry import transform_point, transform_points
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.initialization.pick_checks import exchanged_by_picks, picked_poses, placed_findings

SCANS = [prepare_scan(mesh, name) for mesh, name in zip(MESHES, ("upper", "lower"), strict=True)]
TABLE = {camera.name: camera for camera in CAMERAS}
POSES = jaw_poses(3)[2]


def pixels():
    """Return some recorded pixels of both arches in every camera."""
    rng = np.random.default_rng(0)
    crowns = [transform_points(pose, scan.crown_vertices()) for pose, scan in zip(POSES, SCANS, strict=True)]
    return {
        name: tuple(camera.project(points[rng.choice(len(points), 300)]) for points in crowns)
        for name, camera in TABLE.items()
    }


def found(seen, *more):
    return list(placed_findings(SCANS, POSES, TABLE, [seen, *more], 7))


def test_masks_where_the_picks_place_the_scans_are_accepted():
    assert not found(pixels())


def test_missing_masks_are_no_contradiction():
    seen = pixels()
    seen["cam1"] = (np.empty((0, 2)), seen["cam1"][1])
    del seen["cam2"]
    assert not found(seen)


def test_arches_exchanged_in_one_camera_or_in_all_are_told():
    seen = pixels()
    one = {name: pair[::-1] if name == "cam1" else pair for name, pair in seen.items()}
    (only,) = found(one)
    assert (only.kind, only.severity, only.camera) == ("masks_arches_exchanged", "error", "cam1")
    every = found({name: pair[::-1] for name, pair in seen.items()})
    assert len(every) == len(TABLE) and all("in every camera" in finding.message for finding in every)


def test_exchanged_cameras_are_told():
    seen = pixels()
    (only,) = found({**seen, "cam0": seen["cam1"], "cam1": seen["cam0"]})
    assert only.kind == "masks_cameras_exchanged" and only.severity == "error" and "cam1" in only.message


def test_masks_elsewhere_are_a_warning_and_the_best_guess_counts():
    seen = pixels()
    away = {name: tuple(p + [0, 300.0 if name == "cam1" else 0] for p in pair) for name, pair in seen.items()}
    (only,) = found(away)
    assert (only.kind, only.severity, only.camera) == ("masks_off_picks", "warning", "cam1")
    assert only.value == pytest.approx(0.0) and not found(away, seen)


def test_cameras_exchanged_in_the_calibration_are_told_by_the_picks():
    rng = np.random.default_rng(1)
    arches = {}
    for mesh, pose, name in zip(MESHES, POSES, ("upper", "lower"), strict=True):
        chosen = rng.choice(len(mesh.vertices), 5, replace=False)
        views = [[(c.name, c.project(transform_point(pose, mesh.vertices[k]))) for c in CAMERAS] for k in chosen]
        arches[name] = [
            {"vertex": int(k), "views": [{"camera": n, "x": float(p[0]), "y": float(p[1])} for n, p in seen]}
            for k, seen in zip(chosen, views, strict=True)
        ]
    picks = Bootstrap.model_validate({"frame": 7, **arches})
    assert picked_poses(picks, MESHES, TABLE)[1] == []
    wrong = {**TABLE, "cam0": TABLE["cam1"], "cam1": TABLE["cam0"]}
    assert exchanged_by_picks(picks, MESHES, wrong) == ("cam0", "cam1")
