"""The search for teeth in footage ends, and reports the frames tried."""

import numpy as np
import pytest

from jawusd.base.errors import TrackingError
from jawusd.pipeline import picture_search
from jawusd.pipeline.picture_search import LEAST_FIT, PictureSearch
from jawusd.pipeline.state import no_progress
from jawusd.segmentation.rows import Rows

TAKE = range(10, 2410)  # ten parts
APART = Rows(np.zeros((2, 4, 4), np.uint8), 0.05)


class _Footage:
    """Detect arches on every frame."""

    def __init__(self):
        self.looked_at = []

    def walk(self, frames):
        for frame in frames:
            self.looked_at.append(frame)
            yield frame, {"cam0": frame, "cam1": frame}

    def number(self, name, frame):
        return frame


@pytest.fixture
def searched(monkeypatch):
    """Search with a given fit per frame; return the outcome and the frames tried."""
    monkeypatch.setattr("jawusd.segmentation.rows.tooth_rows", lambda picture: APART)
    monkeypatch.setattr(picture_search, "masked_cameras", lambda *given: [])

    def run(fit_of):
        footage, tried = _Footage(), []

        def near(sources, frame):
            tried.append(frame)
            return None if fit_of(frame) is None else "pose"

        search = PictureSearch(None, footage, 2, near, lambda frame, pose: (pose, fit_of(frame)))
        try:
            return search.run(TAKE, no_progress), tried, footage
        except TrackingError as error:
            return error.message, tried, footage

    return run


def test_a_long_take_without_teeth_ends_and_says_what_was_tried(searched):
    words, tried, footage = searched(lambda frame: None)
    assert len(tried) == 24 and max(footage.looked_at) < 10 + 6 * 240
    assert "not found on 24 frames that show both arches apart (10, 18," in words
    assert words.endswith("frames 1450 to 2409 were not searched, because at most 24 starts are tried")


def test_the_best_poor_fit_is_told(searched):
    words, _, _ = searched(lambda frame: 0.5 * LEAST_FIT if frame == 18 else 0.01)
    assert f"at best {0.5 * LEAST_FIT:.0%} of the visible contour fits" in words


def test_teeth_in_a_later_part_are_found(searched):
    begin, tried, _ = searched(lambda frame: 0.9 if frame > 900 else None)
    assert begin.frame > 900 and begin.pose == "pose" and len(tried) < 24
