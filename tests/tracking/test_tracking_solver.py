"""Contour samples, edge search, normal equations and the joint solver."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from bumpy_teeth import arch, disturbed, jaw_poses, make_cameras, render_masks, vertex_error_mm
from scipy import ndimage

from jawusd.geometry import make_transform, rigidity_defect, se3_exp, se3_inverse, transform_point, transform_points
from jawusd.meshes.raster import draw_depth_labels, project
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.correspondences import accumulate, linear_terms, search_edges
from jawusd.tracking.contour.equations import NormalEquations, OutlineSums, OutlineTerm
from jawusd.tracking.contour.samples import (
    COLUMNS,
    CROWN,
    EDGE_SHARE,
    GUM,
    GUM_SHARE,
    HABITS,
    INVERSE_DEPTH,
    LENGTH,
    NX,
    NY,
    U,
    V,
    contour_samples,
)
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import View

CONFIG = TrackingConfig()
USUAL = CONFIG.gates_from(0.0)
MESHES = (arch(True), arch(False))
SCANS = tuple(prepare_scan(m, n) for m, n in zip(MESHES, ("upper", "lower")))
CAMERAS = make_cameras()
POSES = jaw_poses(8)


def _views(k, meshes=MESHES, **noise):
    present = np.array([True, True])
    return [
        View(c.projection_matrix(), c.centre_world(), render_masks(meshes, POSES[k], c, **noise), present)
        for c in CAMERAS
    ]


def _samples(r, pose, camera, scan=None):
    scan = scan or SCANS[r]
    labels = np.zeros(camera.size_px[::-1], np.uint8)
    depth = np.zeros(camera.size_px[::-1], np.float32)
    points = np.empty((len(scan.vertices), 3), np.float32)
    project(scan.vertices_single, (camera.projection_matrix() @ pose).astype(np.float32), points)
    draw_depth_labels(points, scan.crown_faces, 0, 0, False, depth, labels, CROWN)
    draw_depth_labels(points, scan.gum_faces, 0, 0, False, depth, labels, GUM)
    eye = transform_point(se3_inverse(pose), camera.centre_world())
    matrix = camera.projection_matrix() @ pose
    return contour_samples(scan, matrix, eye, labels, depth, 3.0, 1.5)[0], labels


def test_samples_lie_on_the_outline_of_the_rendered_crowns():
    camera, pose = CAMERAS[1], POSES[2, 0]
    samples, labels = _samples(0, pose, camera)
    assert samples.shape[1] == COLUMNS and len(samples) > 300
    pixels = camera.project(transform_points(pose, samples[:, :3]))
    assert np.abs(pixels - samples[:, [U, V]]).max() < 1e-9
    depth = camera.depth(transform_points(pose, samples[:, :3]))
    assert np.allclose(samples[:, INVERSE_DEPTH], 1 / depth)
    normal = samples[:, [NX, NY]]
    assert np.allclose(np.linalg.norm(normal, axis=1), 1)
    inside = np.round(pixels - 1.6 * normal).astype(int)
    outside = np.round(pixels + 1.6 * normal).astype(int)
    assert (labels[inside[:, 1], inside[:, 0]] == CROWN).mean() > 0.97
    assert (labels[outside[:, 1], outside[:, 0]] != CROWN).mean() > 0.97
    # Part of it is the crown-gum line.
    assert (labels[outside[:, 1], outside[:, 0]] == GUM).mean() > 0.1


def test_samples_of_a_rough_scan_are_not_inside_its_outline():
    rng, mesh, off, length = np.random.default_rng(5), MESHES[0], [], []
    rough = replace(mesh, vertices=mesh.vertices + 0.04 * rng.normal(size=mesh.vertices.shape))
    scan = prepare_scan(rough, "upper")
    for camera in CAMERAS:
        for k in (0, 4):
            samples, _ = _samples(0, POSES[k, 0], camera, scan)
            samples = samples[samples[:, EDGE_SHARE] == 1.0]
            mask = render_masks((rough, MESHES[1]), POSES[k], camera, fine=9)[0]
            out = np.empty(len(samples))
            search_edges(samples, mask, np.zeros_like(mask), np.zeros(mask.shape, np.float32), 2.0, 0.4, 0.7, out)
            off.append(out)
            length.append(samples[:, LENGTH])
    off, length = np.concatenate(off), np.concatenate(length)
    found = np.isfinite(off)
    assert found.sum() > 1000
    assert abs(np.average(off[found], weights=length[found])) < 0.02  # 0.06 with all samples within a pixel of it


def test_contours_move_with_a_scan_until_it_is_drawn_again():
    views, solver = _views(2), ContourSolver(SCANS, replace(CONFIG, redraw_px=2.0))
    rendering, moved = solver.rendering(views), POSES[2].copy()
    rendering.update(POSES[2])
    moved[0] = moved[0] @ make_transform(se3_exp(np.r_[0.002, 0.0, 0.001, np.zeros(3)])[:3, :3], [0.05, 0.05, 0.0])
    before = rendering.labels[1][0].copy()
    rendering.update(moved)
    kept, count = rendering.samples(solver.contours[0], 0, 1, moved[0])
    assert (rendering.labels[1][0] == before).all()  # not drawn again
    at = CAMERAS[1].project(transform_points(moved[0], kept[:, :3]))
    assert np.abs(at - kept[:, [U, V]]).max() < 1e-9
    anew, _ = _samples(0, moved[0], CAMERAS[1])
    assert 0 < count < len(kept)
    assert kept[:, LENGTH].sum() == pytest.approx(anew[:, LENGTH].sum(), rel=0.05)


def test_edge_search_on_soft_straight_edges():
    height, width = 40, 60
    errors = []
    for edge in 30 + np.linspace(0, 1, 11)[:-1]:  # px: teeth to the left of it
        cover = np.clip(edge + 0.5 - np.arange(width), 0, 1)
        mask = np.tile(np.round(255 * cover).astype(np.uint8), (height, 1))
        rows = np.zeros((5, COLUMNS))
        rows[:, U] = [28.0, 31.2, 33.5, 20.0, 45.0]
        rows[:, V], rows[:, NX], rows[:, INVERSE_DEPTH] = 20.0, 1.0, 0.005
        out = np.empty(5)
        nothing = np.zeros((height, width), np.float32)
        search_edges(rows, mask, np.zeros_like(mask), nothing, 5.0, 0.4, 0.7, out)
        errors.append(out[:3] - (edge - rows[:3, U]))
        assert np.isposinf(out[3]) and np.isnan(out[4])
    # Linear interpolation of area averages is off by up to an eighth of a pixel, symmetrically.
    assert np.abs(errors).max() < 0.125 and np.abs(np.mean(errors)) < 0.02


def test_edges_across_the_contour_and_hidden_samples_are_ignored():
    mask = np.tile((np.arange(60) < 30).astype(np.uint8) * 255, (40, 1))
    rows = np.zeros((2, COLUMNS))
    rows[:, U], rows[:, V], rows[:, INVERSE_DEPTH] = 29.0, 20.0, 0.005
    rows[0, [NX, NY]] = np.cos(1.1), np.sin(1.1)
    rows[1, NX] = 1.0
    out = np.empty(2)
    none, nothing = np.zeros_like(mask), np.zeros(mask.shape, np.float32)
    search_edges(rows, mask, none, nothing, 5.0, 0.4, 0.7, out)
    assert np.isnan(out[0]) and np.isfinite(out[1])
    in_front, behind = np.full(mask.shape, 1 / 198.0, np.float32), np.full(mask.shape, 1 / 202.0, np.float32)
    search_edges(rows[1:], mask, none, in_front, 5.0, 0.4, 0.7, out)
    assert np.isnan(out[0])
    search_edges(rows[1:], mask, none, behind, 5.0, 0.4, 0.7, out)
    assert np.isfinite(out[0])
    # The other arch's mask begins at the edge, but that arch may not be behind: the edge may be its own.
    other = np.where(mask > 0, 0, 255).astype(np.uint8)
    search_edges(rows[1:], mask, other, nothing, 5.0, 0.4, 0.7, out)
    assert np.isnan(out[0])
    search_edges(rows[1:], mask, other, behind, 5.0, 0.4, 0.7, out)
    assert np.isfinite(out[0])


def test_outlines_near_visible_gum_are_gum_line_as_scipy_measures_it():
    camera, pose = CAMERAS[1], POSES[2, 0]
    samples, labels = _samples(0, pose, camera)
    to_gum_px = ndimage.distance_transform_edt(labels != GUM)
    at = np.floor(samples[:, [U, V]] + 0.5).astype(int)
    px_per_mm = camera.K[0, 0] / camera.depth(transform_point(pose, SCANS[0].centre))
    far_mm = to_gum_px[at[:, 1], at[:, 0]] / px_per_mm
    for distance_mm, share in ((far_mm > 1.05, 0.0), (far_mm < 0.5, 1.0)):
        assert distance_mm.sum() > 20 and (samples[distance_mm, GUM_SHARE] == share).mean() > 0.99
    between = samples[(far_mm > 0.6) & (far_mm < 0.95), GUM_SHARE]
    assert ((between > 0) & (between < 1)).any()


def test_normal_equations_agree_with_finite_differences():
    camera, pose = CAMERAS[2], POSES[3, 1]
    samples, _ = _samples(1, pose, camera)
    rng = np.random.default_rng(1)
    distances = rng.normal(size=len(samples)) * 0.5
    centre = transform_point(pose, SCANS[1].centre)
    where, found = (pose, camera.projection_matrix(), centre), OutlineSums.zeros(1)
    terms = linear_terms(samples, distances, (2.0, 2.5, 0.0), where, found, 1, 0)
    accumulate(terms, terms.rows, found, 1, 0)
    precision, gradient, habit_slope, habit_distance, habit_weight, *sums = (table[1, 0] for table in found)
    h, J = 1e-5, np.empty((len(samples), 6))
    to, back = make_transform(np.eye(3), -centre), make_transform(np.eye(3), centre)
    for k in range(6):
        ends = [
            camera.project(transform_points(back @ se3_exp(s * h * np.eye(6)[k]) @ to @ pose, samples[:, :3]))
            for s in (1, -1)
        ]
        J[:, k] = ((ends[0] - ends[1]) / (2 * h) * samples[:, [NX, NY]]).sum(1)
    weight = np.clip(1 - (distances / 2.0) ** 2, 0, None) ** 2 * samples[:, LENGTH]
    scale = np.abs(J).max(0) * weight.sum()
    assert np.abs(precision - J.T @ (J * weight[:, None])).max() / scale.max() ** 2 < 1e-6
    assert (np.abs(gradient - J.T @ (weight * distances)) / scale < 1e-6).all()
    habits = samples[:, HABITS]
    assert np.ptp(habits, axis=0).min() > 0.5  # free edges and gum line are both visible
    assert np.abs(habit_slope - habits.T @ (J * weight[:, None])).max() / scale.max() < 1e-5
    assert np.allclose(habit_distance, habits.T @ (weight * distances))
    assert np.allclose(habit_weight, habits.T @ (habits * weight[:, None]))
    matched = samples[np.abs(distances) < 2.0, LENGTH].sum()
    score = np.clip(1 - (distances / 2.5) ** 2, 0, None) ** 3 @ samples[:, LENGTH]
    expected = [weight.sum(), weight @ distances**2, matched, score]
    assert sums == pytest.approx(expected)


@pytest.mark.parametrize("k", [0, 4])
def test_solver_finds_exact_masks_to_a_hundredth_of_a_millimetre(k):
    start = disturbed(POSES[k], 0.5, 0.01, np.random.default_rng(k))
    solution = ContourSolver(SCANS, CONFIG).solve(start, _views(k), USUAL)
    for r in (0, 1):
        assert vertex_error_mm(MESHES[r], solution.poses[r], POSES[k, r]) < 0.015
        assert rigidity_defect(solution.poses[r]) < 1e-12


def test_solver_is_robust_to_noise_and_lips():
    rng = np.random.default_rng(2)
    views = _views(1, lips_mm=(6.5, -14.0), noise_px=0.4, rng=rng)
    start = disturbed(POSES[1], 0.7, 0.012, rng)
    solution = ContourSolver(SCANS, CONFIG).solve(start, views, USUAL)
    for r in (0, 1):
        assert vertex_error_mm(MESHES[r], solution.poses[r], POSES[1, r]) < 0.08


def test_wide_gates_reach_farther_than_narrow_ones():
    rng = np.random.default_rng(7)
    views = _views(2)
    solver = ContourSolver(SCANS, CONFIG)
    found = np.zeros(2)
    for _ in range(4):
        start = disturbed(POSES[2], 2.5, 0.05, rng)
        for g, gates in enumerate((USUAL, CONFIG.wide_gates_px)):
            poses = solver.solve(start, views, gates).poses
            found[g] += all(vertex_error_mm(MESHES[r], poses[r], POSES[2, r]) < 0.1 for r in (0, 1))
    assert found[1] == 4 and found[1] >= found[0]


def test_threads_do_not_change_the_result():
    rng = np.random.default_rng(4)
    views = _views(5, noise_px=0.3, rng=rng)
    start = disturbed(POSES[5], 0.5, 0.01, rng)
    alone = ContourSolver(SCANS, CONFIG).solve(start, views, USUAL)
    with ThreadPoolExecutor(3) as pool:
        together = ContourSolver(SCANS, CONFIG, pool).solve(start, views, USUAL)
    assert (alone.poses == together.poses).all()
    assert all((a == b).all() for a, b in zip(alone.outline, together.outline))


def test_excluded_masks_have_no_effect():
    views = _views(6)
    broken = [*views[:2], View(views[2].matrix, views[2].eye, np.roll(views[2].masks, 9, axis=2), views[2].present)]
    use = np.array([[True, True, False]] * 2)
    solver = ContourSolver(SCANS, CONFIG)
    a, b = (solver.solve(POSES[6], v, USUAL, use) for v in (views, broken))
    assert (a.poses[0] == b.poses[0]).all()
    assert not b.outline.precision[:, 2].any() and b.outline.precision[:, :2].any()


def test_crown_gum_lines_constrain_the_poses_besides_silhouettes():
    solver, views = ContourSolver(SCANS, replace(CONFIG, smooth_errors=None)), _views(2)
    whole = solver.solve(POSES[2], views, ()).outline
    bare = [replace(scan, gingival_margin=scan.gingival_margin[:0]) for scan in SCANS]
    without = ContourSolver(bare, replace(CONFIG, smooth_errors=None)).solve(POSES[2], views, ()).outline
    equations, parts = NormalEquations(), [np.trace(table.precision.sum((0, 1))) for table in (without, whole)]
    assert 0.02 * parts[1] < parts[1] - parts[0] < 0.98 * parts[1]
    OutlineTerm().accumulate(solver.solve(POSES[2], views, ()), equations)
    np.testing.assert_allclose(np.trace(equations.matrix), parts[1], rtol=1e-12)


def test_an_arch_without_masks_stays_in_place():
    views = [
        View(v.matrix, v.eye, v.masks * np.array([1, 0], np.uint8)[:, None, None], np.array([True, False]))
        for v in _views(3)
    ]
    start = disturbed(POSES[3], 0.4, 0.01, np.random.default_rng(0))
    solution = ContourSolver(SCANS, CONFIG).solve(start, views, USUAL)
    assert vertex_error_mm(MESHES[1], solution.poses[1], start[1]) < 1e-6
    assert vertex_error_mm(MESHES[0], solution.poses[0], POSES[3, 0]) < 0.02


def test_crowns_without_gum_have_edges_only_where_they_face_away_from_the_gum():
    camera, pose = CAMERAS[1], POSES[2, 0]
    labels, depth = np.zeros(camera.size_px[::-1], np.uint8), np.zeros(camera.size_px[::-1], np.float32)
    matrix = camera.projection_matrix() @ pose
    up = SCANS[0].vertices[np.unique(SCANS[0].gum_faces)].mean(0) - SCANS[0].centre
    up /= np.linalg.norm(up)
    replace(SCANS[0], gum_faces=np.zeros((0, 3), np.int32)).draw(matrix, depth, labels)
    eye = transform_point(se3_inverse(pose), camera.centre_world())
    samples, _ = contour_samples(SCANS[0], matrix, eye, labels, depth, 3.0, 1.5, up)
    moved = (
        camera.project(transform_points(pose, samples[:, :3] + 0.01 * up)) - samples[:, [U, V]]
    ) / 0.01  # px per mm towards the gum
    along = (moved * samples[:, [NX, NY]]).sum(1)
    gum = samples[:, GUM_SHARE] == 1.0
    edge = samples[:, EDGE_SHARE] == 1.0
    assert gum.sum() > 50 and edge.sum() > 50
    assert along[edge].max() < 0 < np.median(along[gum])
    assert gum[along > 0].all()  # beside the gum, papillae hide the sides of teeth
