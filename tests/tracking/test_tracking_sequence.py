"""A small take, from PNG masks and picks to tracks, and its possible errors."""

import re
import shutil

import cv2
import numpy as np
import pytest
from small_take import (
    CAMERAS,
    FIRST,
    LANDMARKS,
    MESHES,
    ROWS,
    START,
    errors_mm,
    make_capture,
    png,
    source,
    track,
    write_masks,
)

from jawusd.base.errors import TrackingError
from jawusd.cli.text_build import track_lines
from jawusd.formats.tracks import LOST, load_tracks, save_tracks
from jawusd.pipeline.track import track_summary
from jawusd.tracking import track_capture
from jawusd.tracking.sequence import history
from jawusd.tracking.sequence.frame_tracker import FrameTracker

FRAMES = 10


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Render the masks of the take once."""
    return write_masks(tmp_path_factory.mktemp("take"), FRAMES)


@pytest.fixture
def take(pictures, tmp_path):
    """Copy the masks, for tests that modify them."""
    return shutil.copytree(pictures, tmp_path / "take")


def _capture(folder, **change):
    return make_capture(folder, FRAMES, **change)


@pytest.fixture(scope="module")
def tracks(pictures):
    seen = []
    out = track(_capture(pictures), progress=lambda done, total: seen.append((done, total)))
    assert seen == [(k + 1, FRAMES) for k in range(FRAMES)]
    return out


def test_take_is_tracked_both_ways_from_the_bootstrap_frame(tracks):
    assert tracks.frames.tolist() == list(range(5, 5 + FRAMES))
    assert (tracks.status == 1).all() and not tracks.prior_aided.any()
    assert errors_mm(tracks).max() < 0.08
    relative = np.linalg.inv(tracks.T_world_upper) @ tracks.T_world_lower
    assert np.abs(relative - tracks.T_upper_lower).max() < 1e-9


def test_quality_arrays_are_filled(tracks, tmp_path):
    assert (tracks.coverage_error >= 0).all() and tracks.coverage_error.max() < 0.05
    assert (tracks.residual_px > 0.05).all() and tracks.residual_px.max() < 0.8
    assert (tracks.matched_px > 300).all()
    # Uncertainty grows with the distance from the teeth.
    assert (tracks.sigma_mm[:, 3:].min(1) > tracks.sigma_mm[:, 0]).all()
    assert tracks.sigma_mm[:, 0].min() > 0.005 and tracks.sigma_mm.max() < 0.6
    save_tracks(tmp_path / "tracks.npz", tracks)
    again = load_tracks(tmp_path / "tracks.npz")
    assert (again.covariance_relative == tracks.covariance_relative).all()
    assert again.meta["tracking"]["sample_step_px"] == 3.0


def test_threads_do_not_change_the_tracks(pictures, tracks):
    alone = track(_capture(pictures), threads=1)
    for name in ("T_world_upper", "T_world_lower", "covariance_relative", "coverage_error", "status"):
        assert (getattr(alone, name) == getattr(tracks, name)).all()


def test_frame_range_may_be_left_to_the_masks(pictures):
    tracks = track(_capture(pictures, frames=None))
    assert tracks.frames.tolist() == list(range(5, 5 + FRAMES)) and (tracks.status == 1).all()


def test_a_missing_mask_is_compensated_by_the_other_cameras(take):
    png(take, "cam1", "lower", 6).unlink()
    tracks = track(_capture(take))
    assert tracks.status[6].tolist() == [1, 3]
    assert np.isnan(tracks.coverage_error[6, 1, 1]) and np.isfinite(tracks.coverage_error[6, 0]).all()
    assert errors_mm(tracks).max() < 0.1


@pytest.mark.parametrize("kind", ["blob", "other row", "shifted"])
def test_a_wrong_mask_is_excluded(take, kind):
    path = png(take, "cam2", "upper", 7)
    mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if kind == "blob":
        cv2.circle(mask, (330, 240), 45, 255, -1)
    elif kind == "other row":
        mask = cv2.imread(str(png(take, "cam2", "lower", 7)), cv2.IMREAD_UNCHANGED)
    else:
        mask = np.roll(mask, (-6, 7), axis=(0, 1))
    cv2.imwrite(str(path), mask)
    tracks = track(_capture(take))
    assert tracks.status[7, 0] == 3
    assert errors_mm(tracks).max() < 0.1


def test_hidden_teeth_are_lost_and_found_again(take):
    for k in (5, 6):
        for camera in CAMERAS:
            path = png(take, camera.name, "lower", k)
            cv2.imwrite(str(path), np.zeros_like(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))
    tracks = track(_capture(take))
    assert tracks.status[5:7].tolist() == [[1, 0], [1, 0]]
    for name in ("T_world_lower", "T_upper_lower", "raw_T_upper_lower", "covariance_lower", "covariance_relative"):
        assert np.isnan(getattr(tracks, name)[5:7]).all()
    assert np.isfinite(tracks.T_world_upper).all() and np.isnan(tracks.sigma_mm[5:7]).all()
    assert (tracks.status[7:] != 0).all()
    assert np.nanmax(errors_mm(tracks)) < 0.1


@pytest.mark.slow
def test_masks_exchanged_now_and_then_exhaust_the_search_budget(take, monkeypatch):
    """Exchange the arches' masks on three separate frames, each of which would be searched in both directions."""
    for k in (5, 7, 9):
        for camera in CAMERAS:
            upper, lower = (png(take, camera.name, row, k) for row in ROWS)
            upper.rename(take / "other.png")
            lower.rename(upper)
            (take / "other.png").rename(lower)
    calls = []
    search = FrameTracker._search_many_starts
    monkeypatch.setattr(FrameTracker, "_search_many_starts", lambda *given: calls.append(1) or search(*given))
    monkeypatch.setattr(history, "_FRUITLESS", 1)
    tracks = track(_capture(take))
    (finding,) = [found for found in tracks.meta["findings"] if found["kind"] == "searches_left_out"]
    assert len(calls) == 1 and "1 searches for lost teeth failed" in finding["message"]
    assert finding["frame"] in FIRST + np.array([7, 9])
    lost = (tracks.status == LOST).any(1)
    assert lost[[5, 7, 9]].all() and not lost[[0, 1, 2, 3, 4, 6, 8]].any()
    assert np.nanmax(errors_mm(tracks)[~lost]) < 0.1


@pytest.mark.slow
def test_every_lost_frame_of_a_spoiled_stretch_names_its_reason(take, tmp_path):
    for camera in CAMERAS:
        path = png(take, camera.name, "lower", 5)
        cv2.imwrite(str(path), cv2.dilate(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), np.ones((31, 31), np.uint8)))
    for camera in CAMERAS[1:]:
        png(take, camera.name, "lower", 6).unlink()
    save_tracks(tmp_path / "tracks.npz", track(_capture(take)))
    tracks = load_tracks(tmp_path / "tracks.npz")
    assert ((tracks.status == LOST) == (tracks.lost_reason > 0)).all()
    assert np.isfinite(tracks.lost_value).sum() == np.isfinite(tracks.lost_limit).sum() == 2
    assert re.fullmatch(r"residual 1\.\d\d px; less than 0\.\d\d px is needed", tracks.explain_loss(5, 1))
    assert tracks.explain_loss(6, 1) == "1 masks used; at least 2 are needed"
    assert track_summary(tracks)["lost_reasons"] == {"lower": {"few masks": 1, "rough fit": 1}}
    assert "  lower arch lost by: few masks 1, rough fit 1" in track_lines(track_summary(tracks))


def test_one_camera_is_refused_because_of_its_depth(pictures):
    unmasked = [{"name": c.name, "video": pictures / "video.mp4"} for c in CAMERAS[1:]]
    capture = _capture(pictures, cameras=[source(pictures, "cam0"), *unmasked])
    with pytest.raises(TrackingError, match="1 of 3 cameras have masks; with one view, the depth"):
        track(capture)


def test_exchanged_masks_are_named(pictures):
    def masks(name):
        order = ROWS[::-1] if name == "cam1" else ROWS
        return {row: pictures / name / other / "%06d.png" for row, other in zip(ROWS, order)}

    capture = _capture(pictures, cameras=[{"name": c.name, "masks": masks(c.name)} for c in CAMERAS])
    with pytest.raises(
        TrackingError, match="frame 8: the masks of the upper and lower teeth are exchanged in camera cam1"
    ):
        track(capture)


@pytest.mark.slow
def test_picks_far_from_the_masks_are_reported_and_corrected(pictures):
    tracks = track(_capture(pictures, away_mm=12.0))
    assert "picks_off" in {found["kind"] for found in tracks.meta["findings"]}
    assert errors_mm(tracks).max() < 0.1


def test_bootstrap_frame_must_lie_in_the_range(pictures):
    with pytest.raises(TrackingError, match="bootstrap.frame is 8; frames run from 10 to 14"):
        track(_capture(pictures, frames=(10, 15)))


@pytest.mark.slow
def test_a_picked_frame_without_two_masks_of_each_row_is_replaced_by_another(take):
    for camera in CAMERAS[1:]:
        png(take, camera.name, "upper", START).unlink()
    tracks = track(_capture(take))
    found = {found["kind"]: found for found in tracks.meta["findings"]}
    assert "lacks masks of both arches" in found["picks_unused"]["message"]
    assert tracks.meta["start"]["frame"] != 8
    assert tracks.meta["start"]["by"] == "picks, then search on another frame"
    assert np.nanmax(errors_mm(tracks)) < 0.1


def test_first_frame_needs_two_masks_of_each_row(take):
    for camera in CAMERAS[1:]:
        png(take, camera.name, "upper", START).unlink()
    problem = "frame 8: the first frame has 1 masks of the upper teeth; at least two are needed"
    with pytest.raises(TrackingError, match=problem):
        track(_capture(take, frames=(8, 9)))


def test_camera_without_offset_is_named(pictures):
    with pytest.raises(TrackingError, match="camera cam1 has no time offset"):
        track_capture(_capture(pictures), CAMERAS, {"cam0": 0}, *MESHES, LANDMARKS)
