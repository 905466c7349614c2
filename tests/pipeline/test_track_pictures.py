"""Captures without masks are tracked by colours, starting from picks or a search for the teeth."""

from dataclasses import replace

import numpy as np
import pytest
from package_copy import ROOT

from jawusd.base.errors import CaptureError, TrackingError
from jawusd.cli.text_build import track_lines
from jawusd.formats.capture import load_capture
from jawusd.formats.tracks import LOST
from jawusd.geometry import se3_exp, transform_points
from jawusd.pipeline import cameras as opening
from jawusd.pipeline.cameras import open_footage
from jawusd.pipeline.picture_search import _Candidate
from jawusd.pipeline.state import no_progress
from jawusd.pipeline.subject import load_meshes
from jawusd.pipeline.track import first_pass, track_summary
from jawusd.pipeline.videos import track_videos
from jawusd.tracking.region.take import footage_findings
from jawusd.tracking.region.tracker import RegionTracker

EXAMPLE = ROOT / "examples" / "capture"


@pytest.fixture(scope="module")
def truth():
    with np.load(EXAMPLE / "truth" / "truth.npz", allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


@pytest.fixture(scope="module")
def offsets(truth):
    return dict(zip(truth["camera_names"].tolist(), truth["offsets"].tolist(), strict=True))


def unmasked(frames, **changes):
    """Return the example without masks."""
    capture = load_capture(EXAMPLE)
    cameras = tuple(camera.model_copy(update={"masks": None}) for camera in capture.cameras)
    return capture.model_copy(update={"cameras": cameras, "frames": frames, **changes})


def off_mm(tracks, truth):
    rows = np.searchsorted(truth["frames"], tracks.frames)
    points = truth["landmarks"][:1]
    away = transform_points(tracks.T_upper_lower, points) - transform_points(truth["T_upper_lower"][rows], points)
    return np.linalg.norm(away, axis=-1)[:, 0]


@pytest.fixture(scope="module")
def tracked(offsets):
    start = load_capture(EXAMPLE).bootstrap.frame
    steps = []
    capture = unmasked((start - 3, start + 9))
    return capture, first_pass(capture, offsets, 1, lambda *step: steps.append(step)), steps


def test_the_jaw_is_followed_from_picks(tracked, truth):
    capture, tracks, steps = tracked
    assert tracks.frames.tolist() == list(range(*capture.frames)) and not (tracks.status == LOST).any()
    assert off_mm(tracks, truth).mean() < 0.2
    assert steps[-1] == ("follow", 12, 12) and tracks.meta["start"]["by"] == "picks"
    assert {found["kind"] for found in tracks.meta["findings"]} == {"registration_unknown"}
    assert np.isfinite(tracks.sigma_mm).all() and np.isnan(tracks.coverage_error).all()
    lines = "\n".join(track_lines(track_summary(tracks)))
    assert "12 of 12" in lines and "mask" not in lines


def with_longer_lens(camera):
    return replace(camera, K=camera.K * np.array([[1.06, 1, 1], [1, 1.06, 1], [1, 1, 1]]))


def turned(camera):
    return replace(camera, T_cam_world=se3_exp(np.deg2rad([0.6, 0.4, 0, 0, 0, 0])) @ camera.T_cam_world)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "size", "kind", "camera"),
    [
        (with_longer_lens, 1.0, "focal_length", "cam1"),
        (turned, 1.0, "camera_rarely_used", "cam1"),
        (None, 1.03, "scan_size", None),
    ],
)
def test_wrong_cameras_and_scans_are_named(offsets, monkeypatch, spoil, size, kind, camera):
    def opened(capture):
        cameras, videos = open_footage(capture)
        return {name: spoil(one) if spoil and name == camera else one for name, one in cameras.items()}, videos

    monkeypatch.setattr(opening, "open_footage", opened)
    start = load_capture(EXAMPLE).bootstrap.frame
    capture = unmasked((start - 3, start + 9))
    meshes = {
        name: replace(mesh, vertices=size * mesh.vertices) if name in ("upper_teeth", "lower_teeth") else mesh
        for name, mesh in load_meshes(capture).items()
    }
    found = track_videos(capture, offsets, meshes, 1, no_progress).meta["findings"]
    assert (kind, camera) in {(one["kind"], one.get("camera")) for one in found}


@pytest.mark.slow
def test_without_picks_the_teeth_are_searched(offsets, truth):
    capture = unmasked((48, 52), bootstrap=None)
    tracks = first_pass(capture, offsets, 1, no_progress)
    assert tracks.meta["start"]["by"] == "search" and off_mm(tracks, truth).mean() < 0.3


@pytest.mark.slow
def test_mirrored_scans_are_named(offsets):
    hand = np.array([-1.0, 1.0, 1.0])
    meshes = {
        name: replace(mesh, vertices=hand * mesh.vertices, faces=mesh.faces[:, ::-1])
        for name, mesh in load_meshes(load_capture(EXAMPLE)).items()
    }
    found = track_videos(unmasked((48, 52), bootstrap=None), offsets, meshes, 1, no_progress).meta["findings"]
    assert "scans_mirrored" in {one["kind"] for one in found}


def test_picks_beside_the_teeth_are_refused(offsets):
    capture = load_capture(EXAMPLE)
    picks = capture.bootstrap

    def shifted(picked):
        moved = [tuple(view.model_copy(update={"x": view.x + 90.0}) for view in pick.views) for pick in picked]
        return tuple(pick.model_copy(update={"views": views}) for pick, views in zip(picked, moved, strict=True))

    wrong = picks.model_copy(update={"upper": shifted(picks.upper), "lower": shifted(picks.lower)})
    with pytest.raises(TrackingError, match="picks do not match the images"):
        first_pass(unmasked((picks.frame, picks.frame + 2), bootstrap=wrong), offsets, 1, no_progress)
    away = unmasked((picks.frame + 5, picks.frame + 9))
    with pytest.raises(TrackingError, match="frames run from"):
        first_pass(away, offsets, 1, no_progress)


def test_one_video_is_not_enough(offsets):
    capture = unmasked((30, 34))
    blind = tuple(camera.model_copy(update={"video": None}) for camera in capture.cameras[1:])
    capture = capture.model_copy(update={"cameras": (capture.cameras[0], *blind)})
    with pytest.raises(CaptureError, match="1 of 3 cameras"):
        track_videos(capture, offsets, load_meshes(capture), 1, no_progress)


@pytest.mark.parametrize(
    ("lost", "unsure", "words"),
    [(0, 0, None), (0, 1, "partly unreliable"), (2, 0, "partly unreliable"), (1, 2, "not usable")],
)
def test_frames_that_tell_little_make_footage_doubtful(tracked, lost, unsure, words):
    sigma = np.full((12, 5), 0.3)
    sigma[:unsure] = 1.2
    sigma[11 : 11 - lost : -1] = np.nan
    found = footage_findings(replace(tracked[1], sigma_mm=sigma))
    if words is None:
        assert found == []
        return
    frames = tracked[1].frames
    assert words in found[0].message and f"{lost + unsure} of 12" in found[0].message
    assert f"set frames = [{frames[unsure]}, {frames[11 - lost] + 1}]" in found[0].hint


def test_footage_doubtful_all_over_has_no_part_to_keep(tracked):
    sigma = np.full((12, 5), 0.3)
    sigma[6] = np.nan
    assert "frames =" not in footage_findings(replace(tracked[1], sigma_mm=sigma))[0].hint


@pytest.mark.slow
def test_teeth_that_stay_lost_are_searched_and_followed_both_ways(offsets, truth, monkeypatch):
    """The tracker loses the teeth on the second frame, and does not find them again by itself."""
    original, calls = RegionTracker.follow, []

    def lost(tracker, cuts, poses):
        calls.append(poses)
        for found in original(tracker, cuts, poses):
            yield found if len(calls) > 2 else replace(found, found=np.zeros(2, bool))

    monkeypatch.setattr(RegionTracker, "follow", lost)
    first = load_capture(EXAMPLE).bootstrap.frame
    # The search begins in the middle, so that there are frames on both sides.
    monkeypatch.setattr(_Candidate, "rank", property(lambda candidate: abs(candidate.frame - first - 4)))
    tracks = first_pass(unmasked((first, first + 9)), offsets, 2, no_progress)
    # Both ways from the start and from what the search found, and from there again with the colours of the start.
    assert len(calls) == 6 and not (tracks.status == LOST).any()
    assert off_mm(tracks, truth).max() < 0.3
