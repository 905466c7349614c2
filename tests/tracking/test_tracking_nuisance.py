"""Delays between cameras, wide masks, and cameras that moved after their calibration."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from bumpy_teeth import jaw_poses
from small_take import CAMERAS, LANDMARKS, MESHES, OFFSETS, errors_mm, make_capture, track, write_masks

from jawusd.formats.mesh import Mesh, crown_face_mask
from jawusd.formats.tracks import LOST, RECOVERED, TRACKED, load_tracks, save_tracks
from jawusd.geometry import Camera, rigidity_defect, se3_exp, se3_inverse, se3_log
from jawusd.tracking import TrackingConfig, track_capture
from jawusd.tracking.contour.annotator import DRAWN
from jawusd.tracking.contour.equations import OutlineSums, Solution
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.sequence.delays import bridge, delay_motions, interpolation_errors
from jawusd.tracking.sequence.extrinsics import Extrinsics, corrected_cameras
from jawusd.tracking.sequence.frame_tracker import FrameTracker
from jawusd.tracking.sequence.nuisance import Nuisances, corrected_pose

FRAMES = 16
WITHOUT = TrackingConfig(refine_rounds=0)


@pytest.fixture(scope="module")
def late_capture(tmp_path_factory):
    """Two cameras that run 0.3 frames late and 0.2 early."""
    folder = write_masks(tmp_path_factory.mktemp("late"), FRAMES, delays=(0.0, 0.3, -0.2))
    return make_capture(folder, FRAMES)


@pytest.fixture(scope="module")
def late(late_capture):
    return track(late_capture), track(late_capture, config=WITHOUT)


@pytest.mark.slow
def test_delays_are_found_to_a_fiftieth_of_a_frame(late):
    tracks, _ = late
    delays = list(tracks.meta["delays_frames"].values())
    assert delays == pytest.approx([0.0, 0.3, -0.2], abs=0.02)
    assert list(tracks.meta["delays_frames"]) == ["cam0", "cam1", "cam2"]
    assert all(0 < s < 0.02 for s in list(tracks.meta["delays_sigma_frames"].values())[1:])


@pytest.mark.slow
def test_correcting_delays_improves_the_poses(late):
    tracks, without = late
    inner = slice(1, -1)  # the velocity is unknown at the ends
    better, worse = errors_mm(tracks, raw=True)[inner], errors_mm(without, raw=True)[inner]
    assert better.mean() < 0.6 * worse.mean()
    assert better.max() < 0.06


@pytest.mark.slow
def test_masks_drawn_too_wide_are_found_and_corrected(tmp_path):
    capture = make_capture(write_masks(tmp_path / "wide", 8, grown_px=1.0), 8)
    tracks, without = track(capture), track(capture, config=WITHOUT)
    assert np.mean(list(tracks.meta["outline_bias_px"].values()), axis=0) == pytest.approx([1.0, 1.0], abs=0.25)
    assert errors_mm(tracks, raw=True).mean() < 0.7 * errors_mm(without, raw=True).mean()


@pytest.mark.slow
def test_a_correct_take_has_no_nuisances(takes):
    tracks, *_ = takes
    assert np.abs(list(tracks.meta["delays_frames"].values())).max() < 0.03
    assert np.abs(list(tracks.meta["outline_bias_px"].values())).max() < 0.1


@pytest.mark.slow
def test_scans_without_gum_have_larger_uncertainties(tmp_path, monkeypatch):
    """The same take and measurements give larger uncertainties of both arches."""
    capture = make_capture(write_masks(tmp_path / "crowns", 6), 6)
    crowns = [Mesh(m.vertices, m.faces[crown_face_mask(m)], m.colors) for m in MESHES]

    def sigma_px():
        found = track_capture(capture, CAMERAS, OFFSETS, *crowns, LANDMARKS)
        return np.array(list(found.meta["outline_bias_sigma_px"].values()))

    unknown = sigma_px()
    monkeypatch.setattr("jawusd.tracking.contour.annotator.DRAWN_BESIDE_CROWNS", DRAWN)
    assert (unknown > 1.05 * sigma_px()).all()


def _nuisances(**values):
    """Return nuisances of two cameras, zero with small sigmas except for those given."""
    none = {"delays": np.zeros(2), "habits": np.zeros((2, 2, 3)), "twists": np.zeros((2, 6))}
    sigmas = {f"sigma_{name}": np.full_like(value, 0.001) for name, value in none.items()}
    others = {"shift_px": np.zeros((2, 2, 2)), "contour_px": 0.0, "covariance": np.zeros((31, 31))}
    return Nuisances(**{**none, **sigmas, **others, **values})


@pytest.mark.parametrize(
    ("delay", "bias", "sigma", "expected"),
    [(0.05, 0.0, 0.001, True), (0.02, 0.0, 0.001, False), (0.05, 0.0, 0.02, False), (0.0, -0.2, 0.001, True)],
)
def test_only_clear_and_large_nuisances_matter(delay, bias, sigma, expected):
    shift = np.zeros((2, 2, 2))
    shift[0, 1, 1] = bias
    n = _nuisances(delays=np.array([0, delay]), sigma_delays=np.full(2, sigma), shift_px=shift)
    assert n.matters(TrackingConfig()) is expected


@pytest.mark.parametrize(("move", "shift", "expected"), [(0.1, 0.5, True), (0.1, 0.05, False), (0.03, 0.5, False)])
def test_only_clear_and_large_camera_motions_matter(move, shift, expected):
    twists = np.zeros((2, 6))
    twists[1, 4] = move
    n = _nuisances(twists=twists, sigma_twists=np.full((2, 6), 0.01), contour_px=shift)
    assert n.matters(TrackingConfig()) is expected and n.cameras_moved(TrackingConfig()) is expected


# What happened to each camera after its calibration, seen from itself [rad, mm].
KNOCKS = np.array([[2, -1, 1, 0.1, -0.2, 0.1], [-1, 2, -2, 0.2, 0.1, -0.2], [1, 1, 2, -0.1, 0.2, 0.1]])
KNOCKS[:, :3] *= 1e-3
KNOCKED = [replace(c, T_cam_world=se3_exp(k) @ c.T_cam_world) for c, k in zip(CAMERAS, KNOCKS)]


def _track_knocked(capture, **options):
    return track_capture(capture, KNOCKED, OFFSETS, *MESHES, LANDMARKS, **options)


def _landmarks_mm(tracks, truth):
    """Return the mean error of the landmarks in the skull frame over tracked frames; motions of the world cancel."""
    away = (tracks.raw_T_upper_lower - truth.raw_T_upper_lower)[(tracks.status != LOST).all(1)]
    assert len(away) > 0.8 * len(truth.frames)
    return np.mean([np.linalg.norm(LANDMARKS @ one[:3, :3].T + one[:3, 3], axis=1) for one in away])


@pytest.fixture(scope="module")
def takes(clean_take):
    """The same masks with true cameras, knocked cameras, and knocked cameras without correction."""
    capture, good = clean_take
    return good, _track_knocked(capture), _track_knocked(capture, config=WITHOUT)


@pytest.mark.slow
def test_knocked_cameras_are_corrected(takes):
    good, corrected, without = takes
    assert corrected.meta["extrinsics"]["corrected"] and not without.meta["extrinsics"]["corrected"]
    assert _landmarks_mm(corrected, good) < 0.3 * _landmarks_mm(without, good)
    assert (corrected.status == 1).all()
    # Camera errors must not be attributed to anything else.
    assert np.abs(list(corrected.meta["delays_frames"].values())).max() < 0.03
    assert np.abs(list(corrected.meta["outline_bias_px"].values())).max() < 0.15


@pytest.mark.slow
def test_corrected_cameras_see_the_teeth_where_the_true_ones_do(takes):
    good, corrected, _ = takes
    then = corrected_cameras(KNOCKED, corrected.meta)
    points = MESHES[0].vertices[::50]

    def misses(cameras):
        T, exact = corrected.raw_T_world_upper[8], good.raw_T_world_upper[8]
        return max(
            np.linalg.norm(
                c.project(points @ T[:3, :3].T + T[:3, 3]) - true.project(points @ exact[:3, :3].T + exact[:3, 3]),
                axis=1,
            ).mean()
            for c, true in zip(cameras, CAMERAS)
        )

    assert misses(then) < 0.25  # px; outlines are accurate to 0.3
    assert misses(KNOCKED) > 4 * misses(then)


@pytest.mark.slow
def test_corrections_fit_their_uncertainty(takes):
    """Compare with the true knocks, up to the best common motion of the world."""
    report = takes[1].meta["extrinsics"]
    pivot = np.eye(4)
    pivot[:3, 3] = report["pivot_mm"]
    found = np.hstack([np.radians(list(report["turns_deg"].values())), list(report["moves_mm"].values())])
    sigma = np.hstack([np.radians(list(report["turns_sigma_deg"].values())), list(report["moves_sigma_mm"].values())])
    undone = [
        se3_log(se3_inverse(pivot) @ se3_inverse(k.T_cam_world) @ c.T_cam_world @ pivot)
        for k, c in zip(KNOCKED, CAMERAS)
    ]
    undone = np.array(undone) - np.mean(undone, axis=0)
    assert (np.abs(found - undone) < 5 * sigma).all()
    assert np.abs(undone / sigma).max() > 10  # the test has something to find


@pytest.mark.slow
def test_corrections_cancel_and_survive_the_file(takes, tmp_path):
    save_tracks(tmp_path / "tracks.npz", takes[1])
    meta = load_tracks(tmp_path / "tracks.npz").meta
    assert np.sum(list(meta["extrinsics"]["moves_mm"].values()), axis=0) == pytest.approx(np.zeros(3), abs=1e-9)
    assert max(rigidity_defect(c.T_cam_world) for c in corrected_cameras(KNOCKED, meta)) < 1e-9


@pytest.mark.slow
def test_true_cameras_are_left_alone(takes):
    report = takes[0].meta["extrinsics"]
    assert not report["corrected"] and not np.any(list(report["moves_mm"].values()))
    assert all(0 < s < 0.2 for row in report["moves_sigma_mm"].values() for s in row)
    for before, after in zip(CAMERAS, corrected_cameras(CAMERAS, takes[0].meta)):
        assert np.abs(before.T_cam_world - after.T_cam_world).max() < 1e-12
    assert corrected_cameras(CAMERAS, {})[1].T_cam_world.tolist() == CAMERAS[1].T_cam_world.tolist()


def test_the_camera_prior_is_transferred_to_the_teeth():
    """Sample knocks of a camera about its centre; their covariance about the teeth must match the precision."""
    pivot = np.array([3.0, -5.0, 2.0])
    extrinsics = Extrinsics.calibrated(CAMERAS, pivot)
    precision = extrinsics.precision(0.002, 0.5)[1]
    rng = np.random.default_rng(0)
    knocks = rng.normal(size=(4000, 6)) * [0.002, 0.002, 0.002, 0.5, 0.5, 0.5]
    T = CAMERAS[1].T_cam_world
    at = np.eye(4)
    at[:3, 3] = pivot
    about = se3_log(se3_inverse(at) @ se3_inverse(T) @ se3_exp(knocks) @ T @ at)
    chi2 = np.einsum("ni,ij,nj->n", about, precision, about)
    assert chi2.mean() == pytest.approx(6, rel=0.05)


def _records(count, lost=()):
    """Return records of a jaw in uniform motion, some of them lost and far away."""
    step = np.array([0.01, 0.02, -0.01, 0.4, -0.6, 0.2])
    start = se3_exp([0.2, -0.1, 0.3, 5.0, -12.0, 3.0])
    records = {}
    for f in range(count):
        poses = np.tile(se3_exp(f * step) @ start, (2, 1, 1))
        status = np.full(2, TRACKED, np.int8)
        if f in lost:
            poses[1], status[1] = se3_exp([0, 0, 0, 30.0, 0, 0]) @ poses[1], LOST
        nothing = (
            OutlineSums.zeros(2),
            np.ones((2, 3)),
            np.zeros((2, 6, 6)),
            np.zeros((2, 6, 6)),
            np.zeros((2, 2)),
        )
        records[f] = FrameRecord(Solution(poses, *nothing), status, np.ones((2, 2), bool), np.zeros((2, 2)))
    return records, step


def test_a_lost_arch_is_interpolated_linearly():
    records, step = _records(12, lost=(4, 5, 6))
    pose, _ = bridge(records, 5, 1)
    assert pose == pytest.approx(records[5].solution.poses[0], abs=1e-6)
    moved = delay_motions(records, 5, np.array([0.0, 0.25]))
    assert moved[0] == pytest.approx(np.tile(np.eye(4), (2, 1, 1)))
    assert moved[1, 1] == pytest.approx(se3_exp(0.25 * step), abs=1e-6)
    assert moved[1, 0] == pytest.approx(moved[1, 1], abs=1e-6)


def test_delays_follow_an_accelerating_jaw_to_the_ends_of_the_take():
    records, _ = _records(6)
    push = np.array([0.004, 0, 0, 0, -0.5, 0.1])
    for k, record in records.items():
        poses = np.stack([se3_exp(0.5 * k**2 * push)] * 2)
        records[k] = replace(record, solution=replace(record.solution, poses=poses, centres=np.zeros((2, 3))))
    for k in records:
        moved = delay_motions(records, k, np.array([0.0, 0.4, -0.3]))
        for c, delay in enumerate((0.0, 0.4, -0.3)):
            assert moved[c, 1] == pytest.approx(se3_exp((k * delay + 0.5 * delay**2) * push), abs=1e-9)


def test_the_error_of_the_parabola_is_known():
    """For a cubic motion, the error of the parabola is known, at the ends and within the take."""
    records, _ = _records(6)
    push = np.array([0.0004, 0, 0, 0, -0.05, 0.01])
    for k, record in records.items():
        poses = np.stack([se3_exp(k**3 * push)] * 2)
        records[k] = replace(record, solution=replace(record.solution, poses=poses, centres=np.zeros((2, 3))))
    delays = np.array([0.0, 0.4, -0.3])
    for k in records:
        errors = interpolation_errors(records, k, 1, delays)
        for c, (delay, moved) in enumerate(zip(delays, delay_motions(records, k, delays)[:, 1], strict=True)):
            assert se3_exp(errors[c]) @ moved == pytest.approx(se3_exp(((k + delay) ** 3 - k**3) * push), abs=1e-9)
    assert not interpolation_errors(_records(3)[0], 1, 0, delays).any()


def test_long_gaps_and_ends_are_not_bridged():
    assert bridge(_records(20, lost=range(4, 18))[0], 10, 1) is None
    assert bridge(_records(6, lost=(0, 1))[0], 0, 1) is None
    assert delay_motions(_records(6, lost=(0, 1))[0], 0, np.array([0.0, 0.3]))[1, 1].tolist() == np.eye(4).tolist()


@pytest.mark.slow
def test_frames_lost_to_a_late_camera_are_recovered_once_the_delay_is_known(late_capture):
    """Mark an arch as lost, as a late camera may cause: it is recovered after the delay is corrected."""
    original = FrameTracker.track

    def distrustful(self, starts, views, pose_history, reach_px=0.0):
        record = original(self, starts, views, pose_history, reach_px)
        shaky = max(np.abs(v.T_delay - np.eye(4)).max() for v in views) == 0 and self.history.usual_score().any()
        seen = abs(record.solution.poses[1, 1, 3] - AT[1, 1, 3]) < 0.3
        return replace(record, status=np.array([record.status[0], LOST], np.int8)) if shaky and seen else record

    AT = jaw_poses(11)[10]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FrameTracker, "track", distrustful)
        tracks = track(late_capture)
    assert tracks.status[10].tolist() == [TRACKED, RECOVERED]
    assert errors_mm(tracks, raw=True)[10].max() < 0.1


@pytest.mark.parametrize("coefficients", [0, 4, 5, 8])
def test_a_corrected_focal_length_keeps_distortion_per_pixel(coefficients):
    """A longer lens shows a point where the calibrated one shows it scaled, according to OpenCV."""
    rng = np.random.default_rng(coefficients)
    lens = rng.normal(size=coefficients) * 0.05
    camera = Camera("a", (640, 480), np.array([[700.0, 0, 330], [0, 690, 250], [0, 0, 1]]), lens, np.eye(4))
    (longer,) = corrected_cameras([camera], {"focal": {"a": [1.08, 0.01]}})
    points = rng.uniform([-40, -30, 180], [40, 30, 260], (50, 3))
    spread = points * [1.08, 1.08, 1.0]
    seen = cv2.projectPoints(spread, np.zeros(3), np.zeros(3), camera.K, lens if coefficients else None)[0]
    np.testing.assert_allclose(longer.project(points), seen.reshape(-1, 2), atol=1e-9)


def test_delays_and_habits_move_a_pose_as_least_squares_over_its_samples_would():
    rng = np.random.default_rng(3)
    J, h, speed = rng.normal(size=(2, 2, 40, 6)), rng.uniform(size=(2, 2, 40, 3)), np.array([0, 0, 0, 0.4, -0.3, 0.2])
    sums = OutlineSums.zeros(2)._replace(
        precision=np.einsum("rcni,rcnj->rcij", J, J), habit_slope=np.einsum("rcnh,rcni->rchi", h, J)
    )
    none = np.zeros((2, 6, 6))
    records = {}
    for frame in (4, 5, 6):
        poses = np.stack([se3_exp((frame - 5) * speed)] * 2)
        solution = Solution(poses, sums, np.zeros((2, 3)), none, none, np.ones((2, 2)))
        records[frame] = FrameRecord(solution, np.full(2, TRACKED), np.ones((2, 2), bool), np.zeros((2, 2)))
    nuisances = _nuisances(delays=np.array([0.0, 0.2]), habits=0.01 * rng.normal(size=(2, 2, 3)))
    for arch in (0, 1):
        moved = J[arch] @ speed * nuisances.delays[:, None] + np.einsum("cnh,ch->cn", h[arch], nuisances.habits[arch])
        twist = np.linalg.lstsq(J[arch].reshape(-1, 6), -moved.ravel(), rcond=None)[0]
        assert corrected_pose(records, 5, arch, nuisances) == pytest.approx(se3_exp(twist), abs=1e-12)
