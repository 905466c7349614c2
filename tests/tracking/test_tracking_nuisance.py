"""Delays between cameras and masks drawn too wide."""

import numpy as np
import pytest
from small_take import errors_mm, make_capture, track, write_masks

from jawusd.tracking import TrackingConfig
from jawusd.tracking.nuisance import Nuisances

FRAMES = 16
WITHOUT = TrackingConfig(refine_rounds=0)


@pytest.fixture(scope="module")
def late(tmp_path_factory):
    """Two cameras that run 0.3 frames late and 0.2 early."""
    folder = write_masks(tmp_path_factory.mktemp("late"), FRAMES, delays=(0.0, 0.3, -0.2))
    capture = make_capture(folder, FRAMES)
    return track(capture), track(capture, config=WITHOUT)


def test_delays_are_found_to_a_fiftieth_of_a_frame(late):
    tracks, _ = late
    delays = list(tracks.meta["delays_frames"].values())
    assert delays == pytest.approx([0.0, 0.3, -0.2], abs=0.02)
    assert list(tracks.meta["delays_frames"]) == ["cam0", "cam1", "cam2"]
    assert all(0 < s < 0.02 for s in list(tracks.meta["delays_sigma_frames"].values())[1:])


def test_taking_delays_out_improves_the_poses(late):
    tracks, without = late
    inner = slice(1, -1)  # at the ends nothing tells the velocity
    better, worse = errors_mm(tracks, raw=True)[inner], errors_mm(without, raw=True)[inner]
    assert better.mean() < 0.6 * worse.mean()
    assert better.max() < 0.06


def test_masks_drawn_too_wide_are_noticed_and_made_up_for(tmp_path):
    capture = make_capture(write_masks(tmp_path / "wide", 8, grown_px=1.0), 8)
    tracks, without = track(capture), track(capture, config=WITHOUT)
    assert tracks.meta["mask_bias_px"] == pytest.approx([1.0, 1.0], abs=0.2)
    assert errors_mm(tracks, raw=True).mean() < 0.7 * errors_mm(without, raw=True).mean()


def test_nothing_is_found_where_nothing_is(tmp_path):
    tracks = track(make_capture(write_masks(tmp_path / "clean", FRAMES), FRAMES))
    assert np.abs(list(tracks.meta["delays_frames"].values())).max() < 0.03
    assert np.abs(tracks.meta["mask_bias_px"]).max() < 0.1


@pytest.mark.parametrize(
    ("delay", "bias", "sigma", "expected"),
    [(0.05, 0.0, 0.001, True), (0.02, 0.0, 0.001, False), (0.05, 0.0, 0.02, False), (0.0, -0.2, 0.001, True)],
)
def test_only_clear_and_large_nuisances_matter(delay, bias, sigma, expected):
    n = Nuisances(np.array([0, delay]), np.array([bias, 0.0]), np.full(2, sigma), np.full(2, sigma))
    assert n.matters(0.03, 0.1) is expected
