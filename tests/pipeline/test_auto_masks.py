"""Automatic masks are recognised, and the tracker allows them larger errors than drawn ones."""

import numpy as np
import pytest
from package_copy import ROOT

from jawusd.base.errors import FormatError
from jawusd.formats.capture import load_capture
from jawusd.formats.tracks import LOST, RECOVERED, TRACKED, Tracks
from jawusd.geometry import make_transform
from jawusd.pipeline.segment_guide import GUIDE, combine_guide, save_guide
from jawusd.pipeline.segment_record import SUMMARY, auto_masks_folder, with_masks
from jawusd.pipeline.track import tracking_config
from jawusd.tracking.config import FOR_TAKES
from jawusd.tracking.region.tracker import RegionPose

LANDMARKS = np.array([[0, 0, 0], [20, 0, -25], [-20, 0, -25], [50, 40, -80], [-50, 40, -80]], float)


def test_only_masks_beside_a_summary_of_segmentation_are_made(tmp_path):
    given = load_capture(ROOT / "examples" / "capture" / "capture.toml")
    capture = with_masks(given, tmp_path)
    assert auto_masks_folder(given) is None and auto_masks_folder(capture) is None
    (tmp_path / SUMMARY).write_text("{}")
    assert auto_masks_folder(capture) == tmp_path
    mixed = capture.model_copy(update={"cameras": (capture.cameras[0], *given.cameras[1:])})
    assert auto_masks_folder(mixed) is None
    none = tuple(camera.model_copy(update={"masks": None}) for camera in capture.cameras)
    assert auto_masks_folder(capture.model_copy(update={"cameras": none})) is None


def test_drawn_masks_are_judged_by_the_usual_numbers(tmp_path):
    given = load_capture(ROOT / "examples" / "capture" / "capture.toml")
    (tmp_path / SUMMARY).write_text("{}")
    assert tracking_config(given) == FOR_TAKES
    made = tracking_config(with_masks(given, tmp_path))
    assert made.suspect_residual > FOR_TAKES.suspect_residual


def _take(frames, relative):
    """Return tracks with a still upper arch, and the capture's guide with a still jaw."""
    count, still = len(frames), np.tile(np.eye(4), (len(frames), 1, 1))
    small = np.tile(np.diag([1e-6] * 3 + [1e-2] * 3), (count, 1, 1))
    found = np.isfinite(relative).all((1, 2))
    return Tracks(
        frames=frames,
        **{name: still for name in ("T_world_upper", "raw_T_world_upper")},
        **{name: relative for name in ("T_world_lower", "raw_T_world_lower", "T_upper_lower", "raw_T_upper_lower")},
        status=np.column_stack([np.full(count, TRACKED), np.where(found, TRACKED, LOST)]).astype(np.int8),
        prior_aided=np.zeros(count, bool),
        coverage_error=np.zeros((count, 2, 3)),
        masks_used=np.ones((count, 2, 3), bool),
        **{name: small for name in ("covariance_upper", "covariance_lower", "covariance_relative")},
        sigma_mm=np.full((count, 5), 0.1),
        residual_px=np.full((count, 2), 0.5),
        matched_px=np.full((count, 2), 900.0),
        camera_names=("cam0", "cam1", "cam2"),
    )


def _guided(folder, frames):
    """Return the example with masks in a folder whose guide has still jaws, four times as uncertain."""
    covariance = np.tile(np.diag([4e-6] * 3 + [4e-2] * 3), (2, 1, 1))
    resting = RegionPose(np.tile(np.eye(4), (2, 1, 1)), np.ones(2, bool), covariance)
    save_guide(folder, "inputs", {int(f): resting for f in frames})
    (folder / SUMMARY).write_text("{}")
    return with_masks(load_capture(ROOT / "examples" / "capture" / "capture.toml"), folder)


def _shifted(count, mm):
    return np.tile(make_transform(np.eye(3), [mm, 0.0, 0.0]), (count, 1, 1))


@pytest.mark.parametrize(
    ("wrong", "lost", "words"), [(0, 0, None), (1, 0, None), (2, 3, "partly unreliable"), (9, 2, "unusable")]
)
def test_masks_and_colours_that_disagree_make_footage_doubtful(tmp_path, wrong, lost, words):
    frames = np.arange(10, 50)
    poses = _shifted(len(frames), 0.3)
    poses[:wrong, 0, 3] = 1.5  # mm
    poses[wrong : wrong + lost] = np.nan
    tracks = _take(frames, poses)
    _, found = combine_guide(_guided(tmp_path, frames), tracks, LANDMARKS)
    if words is None:
        assert found == []
    else:
        assert words in found[0].message and f"{wrong + lost} of 40" in found[0].message and found[0].frame == 10


def test_drawn_masks_have_no_guide():
    given = load_capture(ROOT / "examples" / "capture" / "capture.toml")
    tracks = _take(np.arange(5), _shifted(5, 0.3))
    assert combine_guide(given, tracks, LANDMARKS) == (tracks, [])


def test_masks_and_colours_are_weighted_by_their_covariance(tmp_path):
    frames = np.arange(10, 50)
    poses = _shifted(len(frames), 0.3)
    poses[7] = np.nan
    tracks, _ = combine_guide(_guided(tmp_path, frames), _take(frames, poses), LANDMARKS)
    moved = tracks.raw_T_upper_lower[:, 0, 3]
    assert moved[[0, 7]] == pytest.approx([0.3 * 0.8, 0.0], abs=1e-9)
    assert tracks.status[7].tolist() == [TRACKED, RECOVERED] and np.isfinite(tracks.T_upper_lower).all()
    # A second measurement of the lower arch leaves 1 / (1 / 1 + 1 / 4) of the variance along x.
    assert tracks.covariance_lower[[0, 7], 3, 3] == pytest.approx([0.8e-2, 4e-2])


def test_masks_and_colours_that_contradict_each_other_widen_sigma(tmp_path):
    frames = np.arange(10, 50)
    poses = _shifted(len(frames), 0.0)
    poses[20, 0, 3] = 2.0  # mm: 8.9 standard deviations of the difference, square 80 over 6 degrees of freedom
    tracks, _ = combine_guide(_guided(tmp_path, frames), _take(frames, poses), LANDMARKS)
    assert tracks.covariance_lower[20, 3, 3] / tracks.covariance_lower[0, 3, 3] == pytest.approx(80 / 6)


def test_masks_without_their_guide_are_told(tmp_path):
    tracks = _take(np.arange(5), _shifted(5, 0.3))
    capture = _guided(tmp_path, np.arange(5))
    (tmp_path / GUIDE).unlink()
    kept, found = combine_guide(capture, tracks, LANDMARKS)
    assert kept is tracks and found[0].kind == "footage_unchecked"
    (tmp_path / GUIDE).write_bytes(b"damaged")
    with pytest.raises(FormatError, match=GUIDE):
        combine_guide(capture, tracks, LANDMARKS)
