"""Starts without picks, from poor picks, and from exchanged masks or scans."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest
from bumpy_teeth import jaw_poses, vertex_error_mm
from small_take import (
    CAMERAS,
    FIRST,
    LANDMARKS,
    MESHES,
    OFFSETS,
    ROWS,
    START,
    errors_mm,
    make_capture,
    source,
    track,
    write_masks,
)

from jawusd.base.errors import TrackingError
from jawusd.formats.mesh import Mesh
from jawusd.geometry import make_transform, random_rotation, se3_exp, se3_inverse, transform_point, transform_points
from jawusd.meshes.raster import draw_silhouette, project, unpack_bits, words_for
from jawusd.tracking import track_capture
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import masked_sources
from jawusd.tracking.initialization import start as take_start
from jawusd.tracking.initialization import start_search
from jawusd.tracking.initialization.footage import Footage, MaskSurvey
from jawusd.tracking.initialization.pose_search import (
    Candidate,
    Grid,
    ShiftCorrelation,
    _template,
    coarse_scan,
    hinge_at_front,
    search_arch,
)
from jawusd.tracking.initialization.scan_checks import check_occlusion
from jawusd.tracking.initialization.start import find_start
from jawusd.tracking.initialization.start_search import SearchResult, StartSearch
from jawusd.tracking.sequence.passes import Passes

FRAMES = 5
TABLE = {camera.name: camera for camera in CAMERAS}
SCANS = tuple(prepare_scan(mesh, row) for mesh, row in zip(MESHES, ROWS))


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Render the masks of the take once."""
    return write_masks(tmp_path_factory.mktemp("take"), FRAMES)


@pytest.fixture
def short_search(monkeypatch):
    """A search over few orientations, on one frame."""
    turns = np.radians([-18.0, 0.0, 18.0])
    monkeypatch.setattr(start_search, "_GRID", Grid(turns, turns, turns, (10.0, 8.0, 12.0)))
    monkeypatch.setattr(take_start, "FRAMES_TRIED", 1)
    monkeypatch.setattr(start_search, "_FINALISTS", 2)


def _capture(folder, **change):
    return make_capture(folder, FRAMES, **change)


def _start(capture, meshes=MESHES, cameras=TABLE):
    solver = ContourSolver([prepare_scan(mesh, row) for mesh, row in zip(meshes, ROWS)], TrackingConfig())
    return find_start(capture, cameras, OFFSETS, meshes, solver)


def _error_mm(start, r):
    return vertex_error_mm(MESHES[r], start.poses[r], jaw_poses(FRAMES)[start.frame - FIRST, r])


def _exchanged(folder, first, second):
    """Return the cameras with the masks of two of them exchanged."""
    order = {first: second, second: first}
    sources = [source(folder, order.get(c.name, c.name)) for c in CAMERAS]
    return [{**s, "name": c.name} for s, c in zip(sources, CAMERAS)]


def _rows_exchanged(folder, names):
    def masks(name):
        order = ROWS[::-1] if name in names else ROWS
        return {row: folder / name / other / "%06d.png" for row, other in zip(ROWS, order)}

    return [{"name": c.name, "masks": masks(c.name)} for c in CAMERAS]


@pytest.mark.slow
def test_take_without_picks_is_tracked(pictures):
    tracks = track(_capture(pictures, bootstrap=None))
    assert (tracks.status == 1).all() and errors_mm(tracks).max() < 0.1
    start = tracks.meta["start"]
    assert start["by"] == "search" and FIRST <= start["frame"] < FIRST + FRAMES and start["worth_px"] > 500


@pytest.mark.parametrize("seed", [1, 2])
def test_neither_world_nor_scan_axes_matter(pictures, short_search, seed):
    rng = np.random.default_rng(seed)
    T_new_world = make_transform(random_rotation(rng), rng.normal(size=3) * 500)
    T_new_scan = make_transform(random_rotation(rng), rng.normal(size=3) * 40)
    cameras = {n: replace(c, T_cam_world=c.T_cam_world @ se3_inverse(T_new_world)) for n, c in TABLE.items()}
    meshes = [Mesh(transform_points(T_new_scan, m.vertices), m.faces, m.colors) for m in MESHES]
    start = _start(_capture(pictures, bootstrap=None), meshes, cameras)
    truth = T_new_world @ jaw_poses(FRAMES)[start.frame - FIRST] @ se3_inverse(T_new_scan)
    assert max(vertex_error_mm(meshes[r], start.poses[r], truth[r]) for r in (0, 1)) < 0.1


def test_two_cameras_are_enough(pictures, short_search):
    capture = _capture(pictures, bootstrap=None, cameras=[source(pictures, c.name) for c in CAMERAS[:2]])
    start = _start(capture)
    assert max(_error_mm(start, r) for r in (0, 1)) < 0.2


def test_masks_of_something_else_are_an_error_that_lists_what_was_tried(tmp_path, short_search, monkeypatch):
    monkeypatch.setattr(take_start, "raise_cause", lambda *arguments: "No mistake explains it.")
    folder = write_masks(tmp_path / "take", FRAMES)
    for k, path in enumerate(sorted(folder.rglob("*.png"))):
        picture = np.zeros_like(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        place = (260 + 29 * (k % 5), 150 + 31 * (k % 4) + 60 * ("lower" in str(path)))
        cv2.imwrite(str(path), cv2.circle(picture, place, 45, 255, -1))
    words = r"failed on all 1 frames tried. Frame \d+: .* No mistake explains it. Add \[bootstrap\] picks"
    with pytest.raises(TrackingError, match=words):
        _start(_capture(folder, bootstrap=None))


def test_if_teeth_are_not_found_warnings_about_the_scans_are_quoted(pictures, monkeypatch):
    def fail(*arguments):
        raise TrackingError("the teeth are not found", frame=7, hint="Give picks.")

    monkeypatch.setattr(take_start, "search_start", fail)
    with pytest.raises(TrackingError, match=r"Give picks\. warning: the crowns of the scans overlap by 1\.\d mm"):
        _start(_capture(pictures, bootstrap=None))
    lower = Mesh(MESHES[1].vertices - [0.0, 2.5, 0.0], MESHES[1].faces, MESHES[1].colors)
    with pytest.raises(TrackingError, match=r"Give picks\.$"):
        _start(_capture(pictures, bootstrap=None), (MESHES[0], lower))


def test_if_picked_teeth_do_not_fit_warnings_about_the_scans_are_quoted(pictures, monkeypatch):
    def fail(*arguments):
        raise TrackingError("the teeth do not fit", frame=7, hint="Check the picks.")

    monkeypatch.setattr(Passes, "begin", fail)
    with pytest.raises(TrackingError, match=r"Check the picks\. warning: the crowns of the scans overlap by 1\.\d mm"):
        track_capture(_capture(pictures), CAMERAS, OFFSETS, *MESHES, LANDMARKS)


def test_no_frame_with_masks_of_both_rows_is_refused(tmp_path):
    folder = write_masks(tmp_path / "take", FRAMES)
    for path in folder.glob("cam[12]/lower/*.png"):
        path.unlink()
    capture = _capture(folder, bootstrap=None, cameras=[source(folder, "cam0"), source(folder, "cam1")])
    blank = np.zeros((400, 640), np.uint8)
    cv2.imwrite(str(folder / "cam1" / "lower" / "000003.png"), blank)
    with pytest.raises(TrackingError, match="none of 5 frames sampled from 5 to 9 has masks of both arches"):
        _start(capture)


@pytest.mark.slow
@pytest.mark.parametrize("picked", [True, False])
def test_exchanged_cameras_are_named(pictures, short_search, picked):
    change = {} if picked else {"bootstrap": None}
    with pytest.raises(TrackingError, match=r"frame \d+: the masks of cameras cam1 and cam2 are exchanged"):
        _start(_capture(pictures, cameras=_exchanged(pictures, "cam1", "cam2"), **change))


@pytest.mark.parametrize("picked", [True, False])
def test_exchanged_rows_of_one_camera_are_named(pictures, short_search, picked):
    change = {} if picked else {"bootstrap": None}
    with pytest.raises(TrackingError, match="the masks of the upper and lower teeth are exchanged in camera cam2"):
        _start(_capture(pictures, cameras=_rows_exchanged(pictures, ["cam2"]), **change))


@pytest.mark.slow
@pytest.mark.parametrize("picked", [True, False])
def test_exchanged_rows_of_all_cameras_are_named(pictures, short_search, picked):
    change = {} if picked else {"bootstrap": None}
    with pytest.raises(TrackingError, match="the masks of the upper and lower teeth are exchanged in every camera"):
        _start(_capture(pictures, cameras=_rows_exchanged(pictures, list(TABLE)), **change))


def test_a_wrong_pick_is_rejected_and_noted(pictures):
    capture = _capture(pictures)
    picks = list(capture.bootstrap.upper)
    picks[1] = picks[1].model_copy(update={"vertex": (picks[1].vertex + 700) % len(MESHES[0].vertices)})
    bootstrap = capture.bootstrap.model_copy(update={"upper": tuple(picks)})
    start = _start(capture.model_copy(update={"bootstrap": bootstrap}))
    assert start.notes["picks_left_out"] == {"upper": [2], "lower": []}
    assert _error_mm(start, 0) < 1.0


def test_picks_close_together_are_refined_by_the_masks(pictures):
    capture = _capture(pictures)
    rng = np.random.default_rng(0)
    poses = jaw_poses(START + 1)[START]
    picks = {}
    for r, row in enumerate(ROWS):
        middle = MESHES[r].vertices[:200].mean(0)  # of the first tooth
        near = np.argsort(np.linalg.norm(MESHES[r].vertices - middle, axis=1))[[0, 60, 120, 180]]
        picks[row] = []
        for vertex in near:
            place = transform_point(poses[r], MESHES[r].vertices[vertex])
            views = [(c.name, c.project(place) + rng.normal(size=2)) for c in CAMERAS[:2]]
            views = [{"camera": n, "x": float(p[0]), "y": float(p[1])} for n, p in views]
            picks[row].append({"vertex": int(vertex), "views": views})
    start = _start(_capture(pictures, bootstrap={"frame": capture.bootstrap.frame, **picks}))
    assert start.notes["by"] == "picks, then search"
    assert max(start.notes["picks_sigma_mm"].values()) > 1.0
    assert max(_error_mm(start, r) for r in (0, 1)) < 0.1


@pytest.mark.parametrize("fails", [False, True])
def test_picks_that_fit_are_kept_if_the_search_fails(pictures, monkeypatch, fails):
    misplaced = jaw_poses(START + 1)[START].copy()
    misplaced[1, :3, 3] += [0.0, 0.0, -40.0]

    def search(*_):
        if fails:
            raise TrackingError("no pair of poses")
        return SearchResult(misplaced, -300.0, np.full(2, -0.2))

    monkeypatch.setattr(take_start, "_SURE_MM", 0.0)
    monkeypatch.setattr(take_start, "search_near", search)
    monkeypatch.setattr(take_start, "fit_without_a_camera", lambda *_: None)
    start = _start(_capture(pictures))
    assert start.notes["by"] == "picks" and not [f for f in start.findings if f.kind == "picks_off"]
    assert max(_error_mm(start, r) for r in (0, 1)) < 1.0


@pytest.mark.slow
def test_reversed_faces_do_not_matter(pictures):
    turned = [Mesh(m.vertices, m.faces[:, ::-1], m.colors) for m in MESHES]
    capture = _capture(pictures)
    as_is, other = track(capture), track_capture(capture, CAMERAS, OFFSETS, *turned, LANDMARKS)
    assert np.abs(as_is.T_world_upper - other.T_world_upper).max() < 1e-3
    assert np.abs(as_is.T_world_lower - other.T_world_lower).max() < 1e-3


def test_survey_finds_the_rows(pictures):
    sources = masked_sources(_capture(pictures).cameras, TABLE, OFFSETS)
    survey = Footage(sources, TABLE, OFFSETS, (FIRST, FIRST + FRAMES)).survey(None, 3)
    assert survey.frames.tolist() == [5, 7, 9]
    for k, frame in enumerate(survey.frames):
        for r in (0, 1):
            pose = jaw_poses(FRAMES)[frame - FIRST, r]
            # Lips and gum hide parts, and every camera sees another side of the arch.
            assert np.linalg.norm(survey.places()[k, r] - transform_point(pose, SCANS[r].centre)) < 12.0


def test_all_shifts_at_once_agree_with_drawing_each(pictures):
    capture = _capture(pictures)
    footage = Footage(masked_sources(capture.cameras, TABLE, OFFSETS), TABLE, OFFSETS, capture.frames)
    pose = jaw_poses(3)[2, 1]
    centre = transform_point(pose, SCANS[1].centre)
    with footage.views(centre, 2.0) as masks:
        view = masks.at(FIRST + 2)[1]
    scan = coarse_scan(Mesh(MESHES[1].vertices, MESHES[1].faces), "lower")  # without gum, silhouettes are complete
    shifts = np.random.default_rng(0).uniform(-8, 8, (12, 3))
    found = ShiftCorrelation(view, 1, 2.0, shifts, centre).objectives(scan, pose[None])[0]
    template = np.pad(_template(view.masks[1], view.masks[0], 2.0), 60)
    h = view.matrix @ np.append(centre, 1)
    slope = (view.matrix[:2, :3] - (h[:2] / h[2])[:, None] * view.matrix[2, :3]) / h[2]
    for shift, worth in zip(shifts, found):
        dx, dy = np.rint(slope @ shift) + 60
        moved = np.array([[1, 0, dx], [0, 1, dy], [0, 0, 1]]) @ view.matrix @ pose
        points = np.empty((len(scan.vertices), 3), np.float32)
        project(scan.vertices_single, moved.astype(np.float32), points)
        bits = np.zeros((template.shape[0], words_for(template.shape[1])), np.uint64)
        draw_silhouette(points, scan.crown_faces, 0, 0, template.shape[1], False, bits)
        assert worth == pytest.approx(template[unpack_bits(bits, template.shape[1])].sum(), rel=0.02, abs=3.0)


def test_the_best_rotation_and_shift_correct_the_guess(pictures):
    capture = _capture(pictures)
    footage = Footage(masked_sources(capture.cameras, TABLE, OFFSETS), TABLE, OFFSETS, capture.frames)
    pose, scan = jaw_poses(3)[2, 1], coarse_scan(MESHES[1], "lower")
    with footage.views(transform_point(pose, scan.centre), 2.0) as masks:
        views = masks.at(FIRST + 2)
    hinge = hinge_at_front(scan.crown_vertices(), np.eye(4))
    turned = pose @ np.linalg.inv(hinge) @ se3_exp([0, 0, 0.3, 0, 0, 0])
    guess = make_transform(turned[:3, :3], turned[:3, 3] - turned[:3, :3] @ [4.5, -3.0, 6.0])
    none = np.zeros(1)
    found = search_arch(scan, 1, views, 2.0, guess, hinge, Grid(none, none, np.array([0.3, 0, -0.3]), (6.0, 6.0, 9.0)))
    assert [len(found), found[0].objective] == [3, max(one.objective for one in found)]
    off = transform_points(found[0].pose, scan.probes) - transform_points(pose, scan.probes)
    assert np.linalg.norm(off, axis=1).max() < 1.5  # mm, the step


def _footage(folder):
    capture = _capture(folder)
    return Footage(masked_sources(capture.cameras, TABLE, OFFSETS), TABLE, OFFSETS, capture.frames)


def test_picks_far_off_are_replaced_by_a_global_search(pictures, short_search):
    footage, truth = _footage(pictures), jaw_poses(FRAMES)[START]
    search = StartSearch(MESHES, ContourSolver(SCANS, TrackingConfig()), np.eye(4))
    off = make_transform(np.eye(3), [14.0, 0, -14.0]) @ truth
    assert search.near(footage, FIRST + START, off).fit < 0.1
    found = take_start.search_near(search, footage, FIRST + START, off)
    assert max(vertex_error_mm(MESHES[r], found.poses[r], truth[r]) for r in (0, 1)) < 0.1 and found.fit > 0.3


def test_frames_tried_are_spread_out():
    areas = np.full((9, 2, 3), 100.0)
    areas[3:6] += 50.0  # the best ones are neighbours
    areas[4, :, 1:] += 50.0
    areas[8, 0] = [100.0, 0.0, 0.0]
    survey = MaskSurvey(np.arange(9) * 10, np.zeros((9, 2, 3, 2)), areas, np.zeros((3, 3, 4)), np.zeros((3, 3)))
    assert survey.promising(3).tolist() == [40, 0, 70]
    assert sorted(survey.promising(99)) == [0, 10, 20, 30, 40, 50, 60, 70]


def test_search_is_the_same_in_threads(pictures, short_search):
    capture = _capture(pictures)
    footage = Footage(masked_sources(capture.cameras, TABLE, OFFSETS), TABLE, OFFSETS, capture.frames)
    solver = ContourSolver(SCANS, TrackingConfig())
    T = check_occlusion(SCANS, None)[0]
    with ThreadPoolExecutor(2) as pool:
        both = [StartSearch(MESHES, solver, T, m).at(footage, FIRST + 1) for m in (map, pool.map)]
    assert (both[0].poses == both[1].poses).all() and both[0].objective_px == both[1].objective_px


def _found(monkeypatch, search, *placed):
    """Let a search find an upper and a lower arch that are moved aside by `placed` [mm], the best ones first."""

    def searched(r, views, base, grid, most):
        moves = [make_transform(np.eye(3), [mm[r], 0.0, 0.0]) for mm in placed[:most]]
        return [Candidate(-k, jaw_poses(FRAMES)[0, r] @ move) for k, move in enumerate(moves)]

    monkeypatch.setattr(search, "_searched", searched)
    return search


@pytest.mark.parametrize(
    ("option", "off", "placed"),
    [
        ("_OPENINGS_MM", (), [(0.0, 7.5)]),  # a tooth
        # the correct arches are found last
        ("_PAIRS", 0, [(mm, -mm) for mm in (7.5, -7.5, 10.0, -10.0, 12.0, -12.0)] + [(0.0, 0.0)]),
    ],
)
def test_arches_shifted_by_a_tooth_are_corrected_by_one_another(pictures, monkeypatch, option, off, placed):
    capture = _capture(pictures)
    solver = ContourSolver(SCANS, TrackingConfig())
    axes, _ = check_occlusion(SCANS, capture.anatomy.T_anatomical_skull)
    true = jaw_poses(FRAMES)[0]
    footage = Footage(masked_sources(capture.cameras, TABLE, OFFSETS), TABLE, OFFSETS, capture.frames)
    found = _found(monkeypatch, StartSearch(MESHES, solver, axes), *placed).at(footage, FIRST)
    assert [vertex_error_mm(MESHES[r], found.poses[r], true[r]) < 0.3 for r in (0, 1)] == [True, True]
    monkeypatch.setattr(start_search, option, off)
    alone = _found(monkeypatch, StartSearch(MESHES, solver, axes), *placed).at(footage, FIRST)
    assert vertex_error_mm(MESHES[1], alone.poses[1], true[1]) > 1.0
