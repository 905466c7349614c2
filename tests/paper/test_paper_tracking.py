"""The paper's energy counted by hand, its optimiser on energies with a known minimum, and a small take."""

import cv2
import numpy as np
import pytest
from bumpy_teeth import arch, jaw_poses, make_cameras, render_masks, vertex_error_mm
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from jawusd.base.errors import MissingDependencyError, TrackingError
from jawusd.formats.capture import Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import LOST, PARTIAL, TRACKED, load_tracks, save_tracks
from jawusd.geometry import make_transform, transform_point, transform_points
from jawusd.paper.energy import PaperEnergy, RasterCounter, paper_scan
from jawusd.paper.take import PaperConfig, golden_section, solve_paper, track_capture_paper
from jawusd.tracking.contour.views import View

RED, GREEN, GREY = (215, 45, 40), (40, 200, 60), (150, 150, 150)
LAMBDA = 0.4


# ---- energy


def strip(top: int, bottom: int, colour: tuple[int, int, int]) -> Mesh:
    """Make a plate 40 mm wide between two heights, of squares of 1 mm, facing a camera that looks along z."""
    x, y = np.meshgrid(np.arange(-20.0, 21), np.arange(top, bottom + 1.0))
    vertices = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    columns = x.shape[1]
    k = (np.arange(bottom - top)[:, None] * columns + np.arange(40)).ravel()
    faces = np.concatenate([np.c_[k, k + columns, k + 1], np.c_[k + 1, k + columns, k + columns + 1]])
    return Mesh(vertices, faces.astype(np.int32), np.tile(np.uint8(colour), (len(vertices), 1)))


def plate() -> Mesh:
    """Make a plate of 40 x 24 mm with y down: red, with a green lower third."""
    red, green = strip(-12, 4, RED), strip(4, 12, GREEN)
    return Mesh(
        np.concatenate([red.vertices, green.vertices]),
        np.concatenate([red.faces, green.faces + len(red.vertices)]).astype(np.int32),
        np.concatenate([red.colors, green.colors]),
    )


def plate_view(mask: np.ndarray, other: np.ndarray | None = None) -> View:
    """View the plate from 100 mm at 1 px/mm, centred at (31.5, 31.5), so that no pixel centre lies on an edge."""
    matrix = np.array([[100.0, 0, 31.5, 3150], [0, 100, 31.5, 3150], [0, 0, 1, 100]])
    masks = np.stack([mask, np.zeros_like(mask) if other is None else other]).astype(np.uint8) * 255
    return View(matrix, np.array([0, 0, -100.0]), masks, np.array([True, True]))


def box(rows: slice, columns: slice) -> np.ndarray:
    out = np.zeros((64, 64), bool)
    out[rows, columns] = True
    return out


PLATE = box(slice(20, 44), slice(12, 52))  # image of the plate; rows 36 to 43 are green


def shifted(x_mm: float, y_mm: float) -> np.ndarray:
    return make_transform(np.eye(3), [x_mm, y_mm, 0.0])


def energy_of(views, poses, row=0):
    scan = paper_scan(plate(), "upper")
    energy = PaperEnergy(RasterCounter(scan), scan, LAMBDA)
    energy.show(views, row, np.eye(4))
    return energy(np.stack(poses)), [energy.uncovered_px(pose) for pose in poses]


def test_the_energy_is_white_pixels_plus_lambda_times_dark_green_ones() -> None:
    poses = [np.eye(4), shifted(5, 0), shifted(0, -3), shifted(0, 2)]
    values, bare = energy_of([plate_view(PLATE)], poses)
    # Right: 5 columns of the mask uncovered, 5 columns of 8 green rows outside. Up: 3 rows uncovered, all green inside.
    # Down: 2 rows uncovered at the top, 2 green rows outside at the bottom.
    expected_bare = [0, 5 * 24, 3 * 40, 2 * 40]
    expected_green = [0, 5 * 8, 0, 2 * 40]
    np.testing.assert_array_equal(np.ravel(bare), expected_bare)
    np.testing.assert_allclose(values, np.add(expected_bare, np.multiply(LAMBDA, expected_green)))


def test_lips_cost_nothing_over_red_and_lambda_over_green() -> None:
    covered = PLATE & box(slice(26, 42), slice(0, 64))  # an upper lip over red, a lower one over two green rows
    values, _ = energy_of([plate_view(covered)], [np.eye(4)])
    np.testing.assert_allclose(values, LAMBDA * 2 * 40)


def test_views_add_up_and_a_crop_of_the_picture_changes_nothing() -> None:
    whole, crop = plate_view(PLATE), slice(18, 46)
    cut = View(
        np.array([[1, 0, -10], [0, 1, -18], [0, 0, 1.0]]) @ whole.matrix, whole.eye, whole.masks[:, crop, 10:54],
        whole.present,
    )  # fmt: skip
    poses = [shifted(9, 7), shifted(-14, 3)]  # green lies outside the crop
    one, _ = energy_of([whole], poses)
    both, bare = energy_of([whole, cut], poses)
    np.testing.assert_allclose(both, 2 * one)
    np.testing.assert_array_equal(bare[0], [bare[0][0]] * 2)


def test_the_boundary_counts_behind_the_other_row() -> None:
    other = box(slice(40, 50), slice(0, 64))
    mine = PLATE & ~other
    view = plate_view(mine, other)
    np.testing.assert_allclose(energy_of([view], [np.eye(4)])[0], LAMBDA * 4 * 40)
    swapped = View(view.matrix, view.eye, view.masks[::-1], view.present)
    np.testing.assert_allclose(energy_of([swapped], [np.eye(4)], row=1)[0], LAMBDA * 4 * 40)


def test_red_and_green_are_taken_by_majority_and_grey_is_left_out() -> None:
    mesh = plate()
    colors = mesh.colors.copy()
    colors[mesh.vertices[:, 1] < -8] = GREY
    scan = paper_scan(Mesh(mesh.vertices, mesh.faces, colors), "upper")
    middle = np.sort(mesh.vertices[scan.plain_faces][..., 1])[:, 1]
    assert middle.min() >= -8 and mesh.vertices[scan.plain_faces][..., 1].min() == -9
    assert len(scan.plain_faces) == 2 * 40 * 12 + 40  # and one triangle per square with two grey corners
    assert len(scan.boundary_faces) == 2 * 40 * 8 and mesh.vertices[scan.boundary_faces][..., 1].min() == 4
    assert not scan.cull  # a plate has no inside


def test_only_consistent_outward_scans_are_culled() -> None:
    mesh = _painted(arch(True))
    mesh = Mesh(mesh.vertices, mesh.faces[(mesh.colors[mesh.faces] != GREY).any((1, 2))], mesh.colors)  # no gum
    assert paper_scan(mesh, "upper").cull
    assert not paper_scan(Mesh(mesh.vertices, mesh.faces[:, ::-1], mesh.colors), "upper").cull
    mixed = mesh.faces.copy()
    mixed[7] = mixed[7, ::-1]
    assert not paper_scan(Mesh(mesh.vertices, mixed, mesh.colors), "upper").cull


def test_a_scan_without_green_is_refused() -> None:
    with pytest.raises(TrackingError, match="lower teeth scan: no boundary of interest.*--solver contour"):
        paper_scan(arch(False), "lower")


# ---- optimiser


@pytest.mark.parametrize(("place", "expected"), [(0.7, 0.7), (0.05, 0.05), (-1.0, 0.0), (5.0, 2.0)])
def test_golden_section_finds_the_minimum_of_the_interval(place, expected) -> None:
    asked = []

    def line(s):
        asked.extend(s)
        return np.array([(x - place) ** 2 for x in s])

    length, value = golden_section(line, 2.0, 1e-3)
    reference = minimize_scalar(lambda x: (x - place) ** 2, bounds=(0, 2), method="bounded", options={"xatol": 1e-6}).x
    assert length == pytest.approx(expected, abs=1e-3) and length == pytest.approx(reference, abs=2e-3)
    assert value == pytest.approx((length - place) ** 2)
    assert min(asked) > 0 and max(asked) < 2
    # Every evaluation after the first two shortens the interval by the golden ratio.
    assert len(asked) == 2 + int(np.ceil(np.log(1e-3 / 2) / np.log((np.sqrt(5) - 1) / 2)))


START = make_transform(Rotation.from_euler("xyz", [2.9, 0.2, -0.1]).as_matrix(), [3.0, -8, 200])
CENTRE = np.array([1.0, 4.0, -12.0])


def pose_at(parameters: np.ndarray) -> np.ndarray:
    """Return eq. 6's pose by scipy: extrinsic x, y, z angles about the centroid, then t."""
    R = Rotation.from_euler("xyz", parameters[:3]).as_matrix()
    pivot = transform_point(START, CENTRE)
    about = make_transform(R, pivot - R @ pivot + parameters[3:])
    return about @ START


def test_the_optimiser_reaches_the_pose_whose_points_fit() -> None:
    target = pose_at(np.array([0.008, -0.012, 0.006, 0.4, -0.6, 0.3]))
    points = np.random.default_rng(0).normal(size=(200, 3)) * [20, 5, 15] + CENTRE

    def energy(poses):
        moved = np.einsum("nij,pj->npi", poses[:, :3, :3], points) + poses[:, None, :3, 3]
        return np.square(moved - transform_points(target, points)).sum((1, 2))

    found = solve_paper(energy, START, CENTRE, PaperConfig())
    left = np.linalg.norm(transform_points(found.pose, points) - transform_points(target, points), axis=1)
    before = np.linalg.norm(transform_points(START, points) - transform_points(target, points), axis=1)
    assert left.max() < 0.1 < before.min()
    assert found.energy == pytest.approx(float(energy(found.pose[None])[0]))
    assert 1 < found.rounds <= 40


@pytest.mark.parametrize("block", [slice(0, 3), slice(3, 6)])
def test_rotation_and_translation_mean_what_equation_6_says(block) -> None:
    seen = []

    def energy(poses):
        seen.append(poses)
        return np.zeros(len(poses))

    config = PaperConfig()
    found = solve_paper(energy, START, CENTRE, config)
    np.testing.assert_allclose(found.pose, START, atol=1e-12)  # a flat energy moves nothing
    nudged = seen[1 if block.start == 0 else 2]
    step = config.difference_rad if block.start == 0 else config.difference_mm
    for k in range(3):
        for sign, row in ((1, k), (-1, k + 3)):
            parameters = np.zeros(6)
            parameters[block.start + k] = sign * step
            np.testing.assert_allclose(nudged[row], pose_at(parameters), atol=1e-12)
    dense = seen[-1]
    assert len(dense) == 3**6
    corner = np.repeat([config.dense_rad, config.dense_mm], 3)
    np.testing.assert_allclose(dense[0], pose_at(-corner), atol=1e-12)
    np.testing.assert_allclose(dense[-1], pose_at(corner), atol=1e-12)


def test_the_dense_look_leaves_a_minimum_that_descent_cannot() -> None:
    better = np.array([1, -1, 1, 0, 1, -1]) * np.repeat([PaperConfig.dense_rad, PaperConfig.dense_mm], 3)

    def energy(poses):  # flat except for one minimum
        return np.array([0.0 if np.allclose(pose, pose_at(better), atol=1e-9) else 10.0 for pose in poses])

    found = solve_paper(energy, START, CENTRE, PaperConfig())
    np.testing.assert_allclose(found.pose, pose_at(better), atol=1e-12)
    assert found.energy == 0


# ---- a small take


def _painted(mesh: Mesh) -> Mesh:
    """Paint the incisal edge of the four front teeth green."""
    colors = mesh.colors.copy()
    red = colors[:, 0] > 200
    front = red & (np.abs(mesh.vertices[:, 0]) < 11) & (np.abs(mesh.vertices[:, 1]) < 2.5) & (mesh.vertices[:, 2] > -7)
    colors[front] = GREEN
    return Mesh(mesh.vertices, mesh.faces, colors)


FRAMES, FIRST = 3, 5
MESHES = (_painted(arch(True)), _painted(arch(False)))
CAMERAS = make_cameras()
POSES = jaw_poses(3 * FRAMES)[::3]
ROWS = ("upper", "lower")
OFFSETS = {camera.name: 0 for camera in CAMERAS}
# No dense search: these tests are about bookkeeping.
QUICK = PaperConfig(most_rounds=2, dense_samples=1)


@pytest.fixture(scope="module")
def masks_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("take")
    for camera in CAMERAS:
        for row in ROWS:
            (folder / camera.name / row).mkdir(parents=True)
        for k in range(FRAMES):
            masks = render_masks((arch(True), arch(False)), POSES[k], camera, (7.5, -16.0), fine=2)
            for row, mask in zip(ROWS, masks):
                cv2.imwrite(str(folder / camera.name / row / f"{FIRST + k:06d}.png"), mask)
    return folder


def take(folder, **change) -> Capture:
    """A take that starts in its middle frame, with slightly wrong picks."""
    rng = np.random.default_rng(1)
    start = 1
    picks = {row: [] for row in ROWS}
    for r, row in enumerate(ROWS):
        for vertex in rng.choice(len(MESHES[r].vertices), 5, replace=False):
            place = transform_point(POSES[start, r], MESHES[r].vertices[vertex])
            pixels = [(c.name, c.project(place) + rng.normal(size=2) * 1.5) for c in CAMERAS[:2]]
            views = [{"camera": n, "x": float(p[0]), "y": float(p[1])} for n, p in pixels]
            picks[row].append({"vertex": int(vertex), "views": views})
    masks = {c.name: {row: folder / c.name / row / "%06d.png" for row in ROWS} for c in CAMERAS}
    fields = {
        "folder": folder,
        "name": "take",
        "fps": 25.0,
        "frames": (FIRST, FIRST + FRAMES),
        "scans": {"upper_teeth": "u.ply", "lower_teeth": "l.ply"},
        "cameras": [{"name": name, "masks": paths} for name, paths in masks.items()],
        "bootstrap": {"frame": FIRST + start, **picks},
    }
    return Capture(**{**fields, **change})


def track(capture, config=QUICK, **options):
    return track_capture_paper(capture, CAMERAS, OFFSETS, *MESHES, config, **options)


def test_a_take_is_followed_without_claims_of_certainty(masks_folder, tmp_path) -> None:
    told = []
    tracks = track(take(masks_folder), PaperConfig(dense_samples=1), progress=lambda *a: told.append(a))
    assert told == [(1, 3), (2, 3), (3, 3)]
    np.testing.assert_array_equal(tracks.frames, [5, 6, 7])
    assert (tracks.status == TRACKED).all()
    for r, row in enumerate(ROWS):
        found = getattr(tracks, f"T_world_{row}")
        assert max(vertex_error_mm(MESHES[r], found[k], POSES[k, r]) for k in range(FRAMES)) < 0.6
    still = max(vertex_error_mm(MESHES[1], POSES[1, 1], POSES[k, 1]) for k in (0, 2))
    assert still > 0.8  # it moved
    assert (tracks.coverage_error < 0.05).all()
    for name in (
        "covariance_upper",
        "covariance_lower",
        "covariance_relative",
        "sigma_mm",
        "residual_px",
        "matched_px",
    ):
        assert np.isnan(getattr(tracks, name)).all()
    assert tracks.meta["solver"] == "paper" and tracks.meta["tracking"]["boundary_weight"] == LAMBDA
    assert 50 < tracks.meta["evaluations_per_row_and_frame"] < 1000
    save_tracks(tmp_path / "tracks.npz", tracks)
    loaded = load_tracks(tmp_path / "tracks.npz")
    np.testing.assert_array_equal(loaded.T_upper_lower, tracks.T_upper_lower)


def test_threads_change_nothing_and_opengl_next_to_nothing(masks_folder) -> None:
    capture = take(masks_folder, frames=(FIRST, FIRST + 2))
    one = track(capture)
    two = track(capture, threads=2)
    np.testing.assert_array_equal(two.T_upper_lower, one.T_upper_lower)
    try:
        gl = track(capture, backend="gl")
    except MissingDependencyError as error:
        pytest.skip(f"no OpenGL here: {error}")
    for r, row in enumerate(ROWS):
        for a, b in zip(getattr(one, f"T_world_{row}"), getattr(gl, f"T_world_{row}")):
            assert vertex_error_mm(MESHES[r], a, b) < 0.3  # ties at edges may turn the search a little
    assert gl.meta["backend"] == "gl"


def test_missing_masks_are_partial_and_too_few_are_lost(masks_folder, tmp_path) -> None:
    blind = tmp_path / "none"
    sources = take(masks_folder).cameras
    for name, gone in (("cam0", [7]), ("cam1", [7])):
        for row in ROWS:
            target = blind / name / row
            target.mkdir(parents=True)
            for frame in range(FIRST, FIRST + FRAMES):
                if not (frame in gone and (row == "lower" or name == "cam0")):
                    (target / f"{frame:06d}.png").symlink_to(masks_folder / name / row / f"{frame:06d}.png")
    masks = {n: {row: blind / n / row / "%06d.png" for row in ROWS} for n in ("cam0", "cam1")}
    cameras = [s.model_dump() | ({"masks": masks[s.name]} if s.name in masks else {}) for s in sources]
    tracks = track(take(masks_folder, cameras=cameras))
    assert tracks.status.tolist() == [[TRACKED] * 2, [TRACKED] * 2, [PARTIAL, LOST]]
    assert np.isnan(tracks.T_world_lower[2]).all() and np.isnan(tracks.T_upper_lower[2]).all()
    assert np.isfinite(tracks.T_world_upper).all()
    np.testing.assert_array_equal(np.isfinite(tracks.coverage_error[2]), [[False, True, True], [False] * 3])


def test_what_the_method_cannot_start_from_is_refused(masks_folder) -> None:
    with pytest.raises(TrackingError, match=r"no \[bootstrap\] picks"):
        track(take(masks_folder, bootstrap=None))
    with pytest.raises(TrackingError, match="bootstrap.frame is 6; frames run from 7 to 7"):
        track(take(masks_folder, frames=(7, 8)))
