"""Mistakes that explain a failed start, and mistakes that only seem to."""

import numpy as np
import pytest
from small_take import CAMERAS, OFFSETS

from jawusd.base.errors import TrackingError
from jawusd.formats.capture_parts import CameraSource, Masks
from jawusd.tracking.initialization import start_causes
from jawusd.tracking.initialization.footage import Footage
from jawusd.tracking.initialization.start_causes import raise_for_unmatched_arch
from jawusd.tracking.initialization.start_search import SearchResult

TABLE = {camera.name: camera for camera in CAMERAS}


@pytest.mark.parametrize(
    ("given", "without", "suspected"),
    [((0.3, np.nan), np.nan, False), ((0.3, 0.2), 0.02, True), ((0.3, 0.02), 0.02, False), ((0.3, np.nan), 0.02, True)],
    ids=["no masks after it", "exchanged", "one camera fits as given", "one camera has no masks"],
)
def test_exchanges_are_suspected_only_of_masks_that_do_not_fit(monkeypatch, given, without, suspected):
    """Masks are given for cameras 1 and 2; an exchange of both leaves camera 1 with another uncovered fraction."""
    sources = [
        CameraSource(name=name, masks=Masks(upper=f"{name}/upper/%06d.png", lower=f"{name}/lower/%06d.png"))
        for name in ("cam0", "cam1", "cam2")
    ]

    def shares(footage, solver, poses, frame):
        named = [source.masks.upper.parts[0] for source in footage.sources]
        return np.array([0.01, without, 0.02]) if named == ["cam0", "cam2", "cam1"] else np.array([0.01, *given])

    monkeypatch.setattr(start_causes, "_uncovered_shares", shares)
    footage = Footage(sources, TABLE, OFFSETS, (0, 10))
    found = start_causes.likely_exchange(footage, None, np.stack([np.eye(4)] * 2), 3)
    assert (found is not None) == suspected
    assert not suspected or "cam1 and cam2 are exchanged" in found.message


@pytest.mark.parametrize(
    ("fits", "named"),
    [
        ({3: (0.6, -0.1), 5: (0.1, 0.0), 9: (0.4, 0.02)}, "lower scan does not fit its own masks"),
        ({3: (-0.5, 0.35)}, "upper scan does not fit its own masks"),
        ({3: (0.6, -0.1), 5: (0.5, 0.12)}, None),  # hidden on one frame, shown on another
        ({3: (0.6, -0.1), 5: (-0.2, 0.4)}, None),
        ({3: (0.2, -0.1)}, None),
        ({}, None),
    ],
)
def test_a_scan_that_fits_nowhere_while_the_other_does_is_named(fits, named):
    fits = {frame: np.array(fit) for frame, fit in fits.items()}
    if named is None:
        raise_for_unmatched_arch(fits)
    else:
        with pytest.raises(TrackingError, match=named):
            raise_for_unmatched_arch(fits)


class _Searches:
    """A stub that returns a given fit for each search."""

    def __init__(self, fits=()):
        self.fits, self.count = dict(fits), 0

    def mirrored(self):
        return self

    def scaled(self, factor):
        return self

    def at(self, footage, frame):
        self.count += 1
        if self.count not in self.fits:
            raise TrackingError("nothing found")
        return SearchResult(np.stack([np.eye(4)] * 2), 1000.0, np.full(2, self.fits[self.count]))


def _refused(searches, monkeypatch, fits=None, suspected=(), only_clear=False):
    monkeypatch.setattr(start_causes, "aligned", lambda search, footage, poses, frame: poses)
    sources = [
        CameraSource(name=name, masks=Masks(upper=f"{name}/upper/%06d.png", lower=f"{name}/lower/%06d.png"))
        for name in ("cam0", "cam1", "cam2")
    ]
    footage = Footage(sources, TABLE, OFFSETS, (0, 10))
    return start_causes.raise_cause(searches, footage, [3, 6, 8], fits or {}, set(suspected), only_clear)


def test_the_search_for_a_mistake_is_bounded_and_reports_what_was_tried(monkeypatch):
    searches = _Searches()
    monkeypatch.setattr(start_causes, "MOST_PICTURES", 20)
    words = _refused(searches, monkeypatch)
    assert searches.count == 6  # of three cameras each
    assert (
        "any of 6 possible mistakes" in words
        and "14 more were not tried, since at most 20 images are searched" in words
    )


def test_every_mistake_of_three_cameras_is_tried(monkeypatch):
    searches = _Searches()
    assert _refused(searches, monkeypatch) == (
        "Correcting any of 20 possible mistakes in masks, scans and calibration does not help on frames 3, 6."
    )
    assert searches.count == 40  # of 57 pictures each time


def test_a_mistake_that_one_frame_does_not_show_is_looked_for_on_another(monkeypatch):
    with pytest.raises(TrackingError, match="found only after correcting this") as refused:
        _refused(_Searches({25: 0.2}), monkeypatch)
    assert refused.value.frame == 6


def test_a_scan_that_fits_nowhere_is_named_before_mistakes_are_looked_for_on_other_frames(monkeypatch):
    searches = _Searches({25: 0.2})
    with pytest.raises(TrackingError, match="the lower scan does not fit its own masks"):
        _refused(searches, monkeypatch, {3: np.array([0.5, 0.02])})
    assert searches.count == 20


def test_of_mistakes_that_are_not_all_tried_only_a_clear_fit_counts(monkeypatch):
    monkeypatch.setattr(start_causes, "MOST_PICTURES", 20)
    assert "not tried" in _refused(_Searches({5: 0.2}), monkeypatch)
    with pytest.raises(TrackingError, match="found only after correcting this"):
        _refused(_Searches({5: 0.5}), monkeypatch)


def test_sizes_are_tried_first_for_scans_of_unusual_size(monkeypatch):
    with pytest.raises(TrackingError, match="the scans are about 5% too small"):
        _refused(_Searches({1: 0.2}), monkeypatch, suspected=[start_causes.SIZE_HINT])
    with pytest.raises(TrackingError, match="the scans are mirrored"):
        _refused(_Searches({1: 0.2}), monkeypatch)


def test_only_a_clear_fit_counts_where_one_is_required(monkeypatch):
    assert "does not help" in _refused(_Searches({1: 0.2}), monkeypatch, only_clear=True)
    with pytest.raises(TrackingError, match="the scans are mirrored"):
        _refused(_Searches({1: 0.4}), monkeypatch, only_clear=True)
