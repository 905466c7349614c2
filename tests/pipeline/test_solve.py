"""The first frames of the example capture as a shot, solved with the rig built from the whole capture."""

import json
from dataclasses import replace

import numpy as np
import pytest
from package_copy import ROOT
from pxr import Sdf
from run_jawusd import run
from short_example import write_short

import jawusd
from jawusd.base.errors import CaptureError, OutputError, RigError, TrackingError
from jawusd.formats.performance import SolveState
from jawusd.formats.poses import read_parameters
from jawusd.formats.tracks import load_tracks
from jawusd.geometry import transform_point, transform_points
from jawusd.media.video import Video
from jawusd.pipeline.calibrate import sync_cameras
from jawusd.pipeline.cameras import load_cameras
from jawusd.pipeline.solve import check_output, solve, solve_summary, write_solved
from jawusd.pipeline.state import no_progress
from jawusd.pipeline.subject import load_meshes, registered_meshes
from jawusd.pipeline.videos import PreparedTeeth, VideoOptions, VideoShot
from jawusd.pipeline.workspace import open_capture
from jawusd.rig.motion_read import read_poses_of_stage
from jawusd.tracking.performance.coordinates import Pose
from jawusd.tracking.region.appearance import LearnedColours
from jawusd.tracking.region.rig_tracker import RigTracker

EXAMPLE = ROOT / "examples" / "capture"
COUNT = 12


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    return write_short(tmp_path_factory.mktemp("shot"), COUNT)


@pytest.fixture(scope="module")
def rig(example_build):
    return example_build[0] / "actor.usda"


@pytest.fixture(scope="module")
def solved(rig, shot, tmp_path_factory):
    """The performance of the shot, not to be modified, and the tracks written with it."""
    path = tmp_path_factory.mktemp("solved") / "take.npz"
    return solve(rig, shot, path), path


def tip_errors_mm(rig, frames, d):
    with np.load(EXAMPLE / "truth" / "truth.npz") as truth:
        relative = truth["T_upper_lower"][np.searchsorted(truth["frames"], frames)]
    tip = rig.landmarks[0]
    return np.linalg.norm(transform_point(rig.pose(d), tip) - transform_point(relative, tip), axis=-1)


@pytest.mark.slow
def test_the_command_writes_a_table_and_a_summary(rig, shot, tmp_path):
    summary = json.loads(run("solve", rig, shot, "-o", tmp_path / "take.csv", "--json"))
    assert summary["frames"] == summary["solved"] == COUNT and not summary["carried"] and not summary["lost"]
    frames, d = read_parameters(tmp_path / "take.csv")
    assert len(frames) == COUNT and tip_errors_mm(jawusd.load(rig), frames, d).max() < 0.3
    assert "--force" in run("solve", rig, shot, "-o", tmp_path / "take.csv", code=10)


@pytest.mark.slow
def test_tracks_and_animation_hold_the_same_jaw(rig, shot, solved, tmp_path):
    jaw, (found, path) = jawusd.load(rig), solved
    tracks = load_tracks(path)
    np.testing.assert_allclose(tracks.T_upper_lower, jaw.pose(found.d), atol=1e-9)
    assert solve_summary(found)["sigma_mm"]["d1"] < 0.1
    write_solved(tmp_path / "take.usdc", found, jaw, rig, open_capture(shot).fps)
    frames, poses = read_poses_of_stage(tmp_path / "take.usdc")
    shown = poses[np.isin(frames, found.frames)]
    np.testing.assert_allclose(shown, jaw.pose(found.d), atol=1e-3)


def bare(first, last, cameras=None, picks=True):
    """Return frames around the picked one of the example, without masks, in all cameras or some."""
    capture = open_capture(EXAMPLE)
    kept = tuple(c.model_copy(update={"masks": None}) for c in capture.cameras if cameras is None or c.name in cameras)
    frames = (capture.bootstrap.frame + first, capture.bootstrap.frame + last)
    update = {"cameras": kept, "frames": frames, "bootstrap": capture.bootstrap if picks else None}
    return capture.model_copy(update=update)


@pytest.mark.slow
def test_shots_without_masks_are_solved_from_their_videos(rig, tmp_path):
    found = solve(rig, bare(-2, 4), tmp_path / "take.csv")
    assert (found.state == SolveState.SOLVED).all() and found.notes["start"]["by"] == "picks"
    assert tip_errors_mm(jawusd.load(rig), found.frames, found.d).max() < 0.4
    assert [path.name for path in tmp_path.iterdir()] == ["take.csv"]


@pytest.mark.slow
def test_teeth_are_found_in_the_pictures_of_one_camera_without_picks(rig):
    """Depth is least accurate with one camera, and must have the largest standard deviation."""
    found = solve(rig, bare(0, 24, ["cam0"], picks=False))
    errors = tip_errors_mm(jawusd.load(rig), found.frames, found.d)
    assert found.camera_names == ("cam0",) and found.notes["start"]["by"] == "search"
    # The directions in which the take is followed may disagree on a frame in which the teeth close.
    solved = found.state == SolveState.SOLVED
    assert solved[:10].all() and solved.sum() >= 23  # the teeth close from then on
    assert errors.mean() < 1.0 and errors.max() < 4 * found.sigma_d.max()


@pytest.mark.slow
@pytest.mark.parametrize("corrected", [True, False])
def test_one_camera_finds_the_jaw_again_if_it_was_predicted_too_far_in_front(rig, monkeypatch, corrected):
    """The prediction is 9 mm too far in front; without starts nearer to the habitual path, 5 mm would remain."""
    if not corrected:
        monkeypatch.setattr(RigTracker, "_with_habitual_starts", lambda tracker, expected, look, *found: found)
    tracker, (first, second), (near, wanted) = tracker_of_one_camera(rig, 60)
    found = tracker.begin(first, near).pose.d
    tracker.carry(found + [-3.0, 0.0, 9.0], np.full(3, 0.01))
    error_mm = np.abs(tracker.step(second).pose.d - wanted.d).max()
    assert error_mm < 1.0 if corrected else error_mm > 2.0


@pytest.mark.slow
@pytest.mark.parametrize("corrected", [True, False])
def test_one_camera_starts_right_from_a_jaw_too_far_in_front(rig, monkeypatch, corrected):
    if not corrected:
        monkeypatch.setattr("jawusd.tracking.region.rig_tracker._CLEARER", -1.0)
    tracker, (first, _), (near, _) = tracker_of_one_camera(rig, 147)
    found = tracker.begin(first, replace(near, d=near.d + [0.0, 0.0, 12.0]))
    error_mm = np.abs(found.pose.d - near.d).max()
    assert error_mm < 1.0 if corrected else error_mm > 2.0


@pytest.mark.slow
def test_frames_are_aligned_again_from_smoothed_poses_whatever_was_predicted(rig):
    tracker, (first, second), (near, wanted) = tracker_of_one_camera(rig, 60)
    fit = tracker.begin(first, near)
    tracker.carry(fit.pose.d + [-3.0, 0.0, 9.0], np.full(3, 0.01))
    again = tracker.again(second, replace(fit, pose=replace(wanted, d=wanted.d + [0.0, 0.0, 1.0])))
    assert again.found.all() and np.abs(again.pose.d - wanted.d).max() < 0.7
    lost = replace(fit, pose=replace(wanted, d=wanted.d + [-15.0, 0.0, 0.0]), use=np.zeros_like(fit.use))
    assert not tracker.again(second, lost).found.all()


def tracker_of_one_camera(rig, frame):
    """Return a tracker of the example's first camera, and images and true poses of a frame and the next one."""
    jaw, shot = jawusd.load(rig), bare(0, 1, ["cam0"], picks=False)
    meshes, offsets = registered_meshes(load_meshes(shot), jaw.meta), sync_cameras(open_capture(EXAMPLE), no_progress)
    cameras = {camera.name: camera for camera in load_cameras(shot)}
    teeth = PreparedTeeth(shot, meshes, jaw, map)
    video = VideoShot(shot, cameras, offsets["offsets"], teeth, jaw, VideoOptions(), no_progress)
    with np.load(EXAMPLE / "truth" / "truth.npz") as truth:
        row = truth["frames"].tolist().index(frame)
        exact = zip(truth["T_world_upper"][row : row + 2], truth["T_upper_lower"][row : row + 2], strict=True)
        poses = [Pose(head, jaw.encode(relative).d) for head, relative in exact]
    take = video.take
    colours = LearnedColours(take._scans, take._shot.cameras, take._axes)
    images = list(video._cuts(take._shot.cameras, take._centre(poses[0]), range(frame, frame + 2)))
    return RigTracker(take._rough, colours, whole=take._instants), images, poses


@pytest.mark.slow
def test_unknown_focal_lengths_are_found_in_pictures(rig, monkeypatch):
    """The calibrated focal length is 6 % too large."""
    shot = bare(-2, 10)
    right = load_cameras(shot)
    zoomed = [replace(camera, K=camera.K * np.array([[1.06, 1.06, 1.0]]).T) for camera in right]
    for camera, known in zip(zoomed, right, strict=True):
        camera.K[:2, 2] = known.K[:2, 2]
    monkeypatch.setattr("jawusd.pipeline.solve.load_cameras", lambda capture: zoomed)
    found = solve(rig, shot, free_focal=True)
    factors = np.array([factor for factor, _ in found.notes["focal"].values()])
    assert np.abs(factors * 1.06 - 1).max() < 0.03
    assert tip_errors_mm(jawusd.load(rig), found.frames, found.d).mean() < 0.6


@pytest.mark.slow
def test_a_worn_camera_has_one_head(rig):
    """The example's head hardly moves in half a second, as with a head-mounted camera."""
    found = solve(rig, bare(0, 12), fixed_head=True)
    np.testing.assert_allclose(found.T_world_upper, np.broadcast_to(found.T_world_upper[0], (12, 4, 4)), atol=1e-4)


@pytest.mark.slow
def test_pictures_that_do_not_show_this_person_are_refused(rig):
    """The picked pixels of both arches are swapped, so no contour fits."""
    shot = bare(-1, 2)
    picks = shot.bootstrap
    moved = picks.model_copy(update={"frame": picks.frame + 40})
    far = shot.model_copy(update={"bootstrap": moved, "frames": (moved.frame, moved.frame + 2)})
    with pytest.raises(TrackingError, match="picks do not match the images"):
        solve(rig, far)
    with pytest.raises(TrackingError, match="frames run from"):
        solve(rig, shot.model_copy(update={"bootstrap": moved}))


@pytest.mark.slow
def test_frames_that_were_not_seen_are_named(rig, shot, solved, tmp_path):
    found = replace(solved[0], state=solved[0].state.copy())
    found.state[3], found.state[5] = SolveState.CARRIED, SolveState.SKIN
    write_solved(tmp_path / "take.usda", found, jawusd.load(rig), rig, open_capture(shot).fps)
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "take.usda"))
    frame = int(found.frames[3])
    assert list(layer.customLayerData["carriedFrames"]) == [frame]
    assert list(layer.customLayerData["skinFrames"]) == [frame + 2]
    summary = solve_summary(found)
    assert summary["carried"] == [(frame, frame)] and summary["skin"] == [(frame + 2, frame + 2)]


@pytest.mark.slow
def test_one_of_several_rigs_is_solved(rig, shot, solved, tmp_path):
    stage = tmp_path / "two.usda"
    references = "".join(f'    def "{name}" (references = @{rig}@) {{}}\n' for name in "ab")
    header = "defaultPrim = 'Shot'; metersPerUnit = 0.001; upAxis = 'Y'; timeCodesPerSecond = 12; startTimeCode = 0"
    text = f'#usda 1.0\n({header}; endTimeCode = 400)\ndef Xform "Shot"\n{{\n{references}}}\n'
    stage.write_text(text)
    assert "--prim" in run("solve", stage, shot, "-o", tmp_path / "take.usda", code=3)
    run("solve", stage, shot, "--prim", "/Shot/b", "-o", tmp_path / "take.usda")
    found, _ = solved
    at = found.frames * 12 / open_capture(shot).fps  # the stage has 12 time codes per second
    times, T = read_poses_of_stage(tmp_path / "take.usda", "/Shot/b")
    shown = (times >= at[0]) & (times <= at[-1])
    d = np.stack([np.interp(times[shown], at, column) for column in found.d.T], axis=1)
    np.testing.assert_allclose(T[shown], jawusd.load(rig).pose(d), atol=1e-6)
    assert (np.ptp(read_poses_of_stage(tmp_path / "take.usda", "/Shot/a")[1], axis=0) == 0).all()


@pytest.mark.slow
def test_one_camera_will_do(rig, shot):
    capture = open_capture(shot)
    alone = capture.model_copy(update={"cameras": capture.cameras[:1], "bootstrap": None})
    found = solve(rig, alone, None)
    assert found.camera_names == (capture.cameras[0].name,) and (found.state == SolveState.SOLVED).all()
    assert tip_errors_mm(jawusd.load(rig), found.frames, found.d).mean() < 0.8


def test_what_cannot_be_written_is_refused_before_any_work(rig, tmp_path):
    with pytest.raises(OutputError, match="suffix"):
        check_output(rig, tmp_path / "take.txt")
    with pytest.raises(RigError, match="USD rig"):
        check_output(rig.parent / "model.npz", tmp_path / "take.usdc")


def test_a_shot_without_masks_and_videos_is_refused(rig, shot, tmp_path):
    capture = open_capture(shot)
    none = tuple(camera.model_copy(update={"masks": None}) for camera in capture.cameras)
    with pytest.raises(CaptureError, match="no camera has a video"):
        solve(rig, capture.model_copy(update={"cameras": none}), tmp_path / "take.csv")


@pytest.mark.slow
def test_a_performance_is_drawn_and_reported(rig, shot, tmp_path):
    """Cameras of the shot have only masks, which are the backdrop."""
    summary = json.loads(
        run(
            "solve", rig, shot, "-o", tmp_path / "take.npz", "--overlay", tmp_path / "take.mp4",
            "--report", tmp_path / "take.html", "--json",
        )
    )  # fmt: skip
    files = [tmp_path / f"take.{suffix}" for suffix in ("npz", "mp4", "html")]
    assert summary["files"] == [str(path) for path in files]
    assert Video(files[1]).count == COUNT
    page = files[2].read_text()
    assert f"{COUNT} frames (100.0 %)" in page and page.count("data:image/jpeg") >= 2
    tracks = load_tracks(files[0])
    assert tracks.solved is not None and tracks.meta["fps"] == open_capture(shot).fps
    np.testing.assert_allclose(jawusd.load(rig).pose(tracks.solved.d), tracks.T_upper_lower, atol=1e-9)
    again = tmp_path / "again.html"
    run("report", files[0], "-o", again)
    assert "no shot was given" in again.read_text()
    run("report", files[0], "--capture", shot, "-o", again, "--force")
    assert again.read_text() == page


@pytest.mark.slow
def test_a_shot_is_solved_from_skin_alone(rig, shot, tmp_path):
    """Points follow three quarters of the bone's motion."""
    jaw, rng = jawusd.load(rig), np.random.default_rng(0)
    points = jaw.landmarks[0] + np.array([[0, -30, 5], [12, -28, 0], [-12, -28, 0], [0, -5, 8]])

    def skin_at(T):
        rest, moved = (transform_points(pose, points) for pose in (jaw.T_rest, T))
        return rest + 0.75 * (moved - rest) + rng.normal(0, 0.1, (len(T), 4, 3))

    d = jaw.project(rng.uniform(*jaw.d_range.T, size=(300, 3)))
    names = [f"p{i}" for i in range(4)]
    jawusd.save_skin(tmp_path / "skin.npz", jawusd.fit_skin(jaw, skin_at(jaw.pose(d)), d, d[:, 0] > 2, names=names))
    with np.load(EXAMPLE / "truth" / "truth.npz") as truth:
        frames, T = truth["frames"], truth["T_upper_lower"]
    table = np.column_stack([frames, skin_at(T).reshape(len(T), -1)])
    header = ",".join(["frame", *(f"{name}_{axis}" for name in names for axis in "xyz")])
    np.savetxt(tmp_path / "face.csv", table, "%.6g", ",", header=header, comments="")
    words = ["solve", rig, shot, "-o", tmp_path / "take.npz", "--skin", tmp_path / "skin.npz", "--face"]
    words += [tmp_path / "face.csv", "--face-fps", open_capture(shot).fps, "--skin-only"]
    assert "with --offset" in run(*words, code=7)
    words += ["--offset", 0]
    assert "head pose" in run(*words, "--overlay", tmp_path / "take.mp4", code=10)
    said = run(*words, "--report", tmp_path / "take.html")
    assert "estimated from facial skin: " in said and "with no camera" in said
    tracks = load_tracks(tmp_path / "take.npz")
    assert (tracks.solved.state == SolveState.SKIN).sum() >= COUNT - 2 and len(tracks.frames) == COUNT
    errors = tip_errors_mm(jaw, tracks.frames, tracks.solved.d)
    assert errors.mean() < 0.6 and errors.max() < 4 * tracks.sigma_mm[:, 0].max()
    page = (tmp_path / "take.html").read_text()
    assert "d is estimated from facial skin" in page and "d is from skin alone" in page
    run("report", tmp_path / "take.npz", "--capture", shot, "-o", tmp_path / "again.html")
    missing = run("solve", rig, shot, "-o", tmp_path / "x.csv", "--skin", tmp_path / "skin.npz", code=2)
    assert "--face" in missing and not (tmp_path / "x.csv").exists()


def test_files_with_other_names_are_refused_before_any_work(rig, shot, tmp_path):
    for option, name in (("--overlay", "take.avi"), ("--report", "take.pdf")):
        said = run("solve", rig, shot, "-o", tmp_path / "take.csv", option, tmp_path / name, code=10)
        assert "Give a file name ending in" in said
    (tmp_path / "take.mp4").write_text("precious")
    assert "--force" in run("solve", rig, shot, "-o", tmp_path / "t.csv", "--overlay", tmp_path / "take.mp4", code=10)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["take.mp4"]
