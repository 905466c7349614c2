"""The world scale estimated from masks, for camera distances scaled by known factors."""

from dataclasses import replace

import numpy as np
import pytest
from small_take import CAMERAS, MESHES, OFFSETS, make_capture, write_masks

from jawusd.base.errors import TrackingError
from jawusd.tracking.initialization import scale_search
from jawusd.tracking.initialization.scale_search import seen_size
from jawusd.tracking.initialization.start_search import SearchResult, StartSearch

COUNT = 3


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = write_masks(tmp_path_factory.mktemp("size"), COUNT)
    return make_capture(folder, COUNT, bootstrap=None)


def farther_apart(factor):
    """Return the cameras as calibrated with a wrong square size."""
    cameras = []
    for camera in CAMERAS:
        T = camera.T_cam_world.copy()
        T[:3, 3] *= factor
        cameras.append(replace(camera, T_cam_world=T))
    return cameras


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.0, 0.9, 1.2])
def test_the_size_is_that_of_the_world(capture, factor):
    assert seen_size(capture, farther_apart(factor), OFFSETS, MESHES) == pytest.approx(factor, rel=0.01)


@pytest.mark.slow
def test_masks_of_something_else_give_no_size(capture, monkeypatch):
    monkeypatch.setattr("jawusd.tracking.initialization.scale_search._STARTS", (1.0,))
    turned = [replace(m, vertices=m.vertices * [0.6, 1.0, 1.3]) for m in MESHES]
    with pytest.raises(TrackingError, match=r"do not fit the masks of frames \d+, \d+ at any size from 0\.5 to 2"):
        seen_size(capture, CAMERAS, OFFSETS, turned)
    with pytest.raises(TrackingError, match="has masks of both arches"):
        seen_size(make_capture(capture.folder, COUNT, frames=(400, 402)), CAMERAS, OFFSETS, MESHES)


def test_a_climb_without_an_end_counts_as_no_fit(capture, monkeypatch):
    """If every size fits better than the one before, the climb stops at its limit and is rejected."""
    sizes = []

    def better(self, frame, size, poses, size_of_poses):
        sizes.append(size)
        return float(len(sizes)), 0.9, poses

    monkeypatch.setattr(scale_search._Sizes, "_fitted", better)
    monkeypatch.setattr(scale_search, "_MOST_SIZES", 20)
    monkeypatch.setattr(StartSearch, "at", lambda *_: SearchResult(np.stack([np.eye(4)] * 2), 1.0, np.ones(2)))
    with pytest.raises(TrackingError, match=r"at any size from 0\.5 to 2"):
        seen_size(capture, CAMERAS, OFFSETS, MESHES)
    assert 2 * 5 * 20 < len(sizes) <= 2 * 5 * 21  # frames, starts, and the first size of each climb
