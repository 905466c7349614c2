"""Drawings of a scan are warped to small motions of the scan."""

from dataclasses import replace

import numpy as np
import pytest
from bumpy_teeth import arch, jaw_poses, make_cameras, render_masks, vertex_error_mm

from jawusd.geometry import make_transform, se3_exp, se3_inverse, transform_point
from jawusd.tracking import TrackingConfig
from jawusd.tracking.contour import rendering as rendering_module
from jawusd.tracking.contour.rendering import Drawing, Drawings
from jawusd.tracking.contour.samples import INVERSE_DEPTH, NX, NY, U, V
from jawusd.tracking.contour.scan import CROWN, prepare_scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import View

MESHES = (arch(True), arch(False))
SCANS = tuple(prepare_scan(mesh, name) for mesh, name in zip(MESHES, ("upper", "lower")))
CAMERA = make_cameras()[1]
POSE = jaw_poses(3)[2][0]
SHAPE = CAMERA.size_px[::-1]


def seen(pose):
    """Return projection and eye for a pose, in scan coordinates."""
    return CAMERA.projection_matrix() @ pose, transform_point(se3_inverse(pose), CAMERA.centre_world())


def pictures():
    return np.zeros(SHAPE, np.uint8), np.zeros(SHAPE, np.float32)


def drawn_at(pose):
    """Return labels and inverse depth as drawn at a pose."""
    labels, depth = pictures()
    SCANS[0].draw(CAMERA.projection_matrix() @ pose, depth, labels)
    return labels, depth


def shown_at(pose):
    """Return the same warped from a drawing at POSE, and its rotation."""
    labels, depth = pictures()
    turned = Drawing(SCANS[0], *seen(POSE), SHAPE).show(seen(pose)[0], labels, depth)
    return labels, depth, turned


def moved(sideways_mm=0.0, roll_rad=0.0, turn_rad=0.0, away_mm=0.0):
    """Return POSE moved across the picture and away, rolled, and rotated about the vertical."""
    across, down, line = CAMERA.T_cam_world[:3, :3]
    place = transform_point(POSE, SCANS[0].centre)
    step = se3_exp(np.r_[roll_rad * line + turn_rad * down, 0, 0, 0])
    there = place + sideways_mm * across + away_mm * line
    return make_transform(np.eye(3), there) @ step @ make_transform(np.eye(3), -place) @ POSE


def test_at_its_own_pose_a_drawing_is_shown_as_drawn():
    labels, depth, turned = shown_at(POSE)
    expected = drawn_at(POSE)
    assert (labels == expected[0]).all() and turned == 0.0
    np.testing.assert_allclose(depth, expected[1], rtol=1e-5)  # another pixel origin, in single precision
    assert (labels == CROWN).sum() > 500


@pytest.mark.parametrize(
    "pose",
    [
        moved(sideways_mm=4.0),
        moved(roll_rad=0.1),
        moved(sideways_mm=4.0, away_mm=3.0),
        moved(sideways_mm=-3.0, roll_rad=-0.05, turn_rad=0.01),
    ],
)
def test_a_warped_drawing_equals_a_new_one(pose):
    labels, depth, turned = shown_at(pose)
    anew, depth_anew = drawn_at(pose)
    before, _ = drawn_at(POSE)
    assert (before != anew).sum() > 10 * (labels != anew).sum()
    both = (labels == anew) & (labels > 0)
    assert np.median(np.abs(1 / depth[both] - 1 / depth_anew[both])) < 0.15  # mm
    # Contours: their points lie where those of a new drawing do, and their normals have turned with the scan.
    solver = ContourSolver(SCANS, TrackingConfig())
    drawing = Drawing(SCANS[0], *seen(POSE), SHAPE)
    kept, count = drawing.samples(solver.contours[0], seen(pose)[0], SHAPE, turned)
    fresh, _ = Drawing(SCANS[0], *seen(pose), SHAPE).samples(solver.contours[0], seen(pose)[0], SHAPE, 0.0)
    assert 0 < count < len(kept)
    gap = np.linalg.norm(kept[:, None, [U, V]] - fresh[None, :, [U, V]], axis=2)
    nearest = gap.argmin(1)
    assert np.quantile(gap.min(1), 0.9) < 1.0  # px; samples lie up to 3 px apart
    along = (kept[:, [NX, NY]] * fresh[nearest][:, [NX, NY]]).sum(1)
    assert np.median(along) > 0.995
    assert np.quantile(np.abs(kept[:, INVERSE_DEPTH] / fresh[nearest, INVERSE_DEPTH] - 1.0), 0.9) < 0.005


def test_another_viewpoint_is_drawn_again():
    drawing = Drawing(SCANS[0], *seen(POSE), SHAPE)

    def shows(pose, shape=SHAPE):
        return drawing.shows(*seen(pose), shape, TrackingConfig())

    assert shows(POSE) and shows(moved(sideways_mm=1.0, roll_rad=0.02))
    assert not shows(moved(turn_rad=0.1))  # other sides are seen
    assert shows(moved(away_mm=-3.0)) and not shows(moved(away_mm=-20.0))
    assert not shows(moved(sideways_mm=60.0))  # parts of the window were not drawn
    assert not shows(POSE, (SHAPE[0] + 100, SHAPE[1]))


def test_contours_end_at_the_window():
    drawing, solver = Drawing(SCANS[0], *seen(POSE), SHAPE), ContourSolver(SCANS, TrackingConfig())
    whole, _ = drawing.samples(solver.contours[0], seen(POSE)[0], SHAPE, 0.0)
    middle = int(np.median(whole[:, U]))
    part, count = drawing.samples(solver.contours[0], seen(POSE)[0], (SHAPE[0], middle), 0.0)
    assert 0 < count < len(part) < len(whole) and part[:, U].max() < middle - 1


def test_drawings_are_reused_at_the_next_instant():
    view = View(CAMERA.projection_matrix(), CAMERA.centre_world(), np.zeros((2, *SHAPE), np.uint8), np.ones(2, bool))
    solver = ContourSolver(SCANS, TrackingConfig())
    poses = np.stack([POSE, jaw_poses(3)[2][1]])
    solver.rendering([view]).update(poses)
    known = dict(solver.drawings._kept)
    assert len(known) == 2
    solver.rendering([view]).update(np.stack([moved(sideways_mm=1.0), poses[1]]))
    assert solver.drawings._kept == known
    solver.rendering([view]).update(np.stack([moved(turn_rad=0.1), poses[1]]))
    assert [key for key in known if solver.drawings._kept[key] is not known[key]] == [next(iter(known))]


def test_drawings_of_removed_cameras_are_dropped():
    drawings = Drawings(SCANS, TrackingConfig())
    for k in range(70):
        camera = CAMERA.centre_world() + [1e-3 * k, 0, 0]
        drawings.of(0, 0, camera, POSE, seen(POSE)[0], (8, 8))
    assert len(drawings._kept) == 70
    drawings.forget_old()
    assert not drawings._kept


def test_the_next_alignment_is_the_same_without_cached_drawings():
    """Warping changes poses by less than 0.01 mm."""
    config, cameras, found = TrackingConfig(), make_cameras(), []
    for parallax_px in (0.0, config.parallax_px):
        solver = ContourSolver(SCANS, replace(config, parallax_px=parallax_px))
        for poses in jaw_poses(np.array([2.0, 2.1])):
            masks = [np.array(render_masks(MESHES, poses, camera)) for camera in cameras]
            views = [
                View(camera.projection_matrix(), camera.centre_world(), mask, np.ones(2, bool))
                for camera, mask in zip(cameras, masks)
            ]
            solution = solver.solve(poses, views, config.gates_from(0.0))
        found.append((len(solver.drawings._kept), solution.poses))
    assert found[0][0] == found[1][0] == 6
    for r in range(2):
        assert vertex_error_mm(MESHES[r], found[1][1][r], found[0][1][r]) < 0.01


def test_contours_are_sampled_while_threads_draw(monkeypatch):
    view = View(CAMERA.projection_matrix(), CAMERA.centre_world(), np.zeros((2, *SHAPE), np.uint8), np.ones(2, bool))
    solver, poses = ContourSolver(SCANS, TrackingConfig()), jaw_poses(3)[2]
    rendering = solver.rendering([view])
    rendering.update(poses)
    monkeypatch.setattr(rendering_module, "contour_samples", None)
    samples, silhouettes = rendering.samples(solver.contours[0], 0, 0, poses[0])
    assert 0 < silhouettes <= len(samples)
