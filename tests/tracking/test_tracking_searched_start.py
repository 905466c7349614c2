"""The start frame chosen by the search, and which results are accepted."""

import re

import numpy as np
import pytest
from bumpy_teeth import jaw_poses, vertex_error_mm
from small_take import CAMERAS, FIRST, MESHES, OFFSETS, ROWS, make_capture, write_masks

from jawusd.base.errors import TrackingError
from jawusd.geometry import make_transform, se3_exp, se3_inverse
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import masked_sources
from jawusd.tracking.initialization import start as take_start
from jawusd.tracking.initialization.first_frame import first_record
from jawusd.tracking.initialization.footage import Footage
from jawusd.tracking.initialization.start_causes import possible_exchanges
from jawusd.tracking.initialization.start_search import SearchResult

FRAMES = 5
TABLE = {camera.name: camera for camera in CAMERAS}
SCANS = tuple(prepare_scan(mesh, row) for mesh, row in zip(MESHES, ROWS))


@pytest.fixture(scope="module")
def footage(tmp_path_factory):
    """Render the masks of the take once."""
    capture = make_capture(write_masks(tmp_path_factory.mktemp("take"), FRAMES), FRAMES)
    return Footage(masked_sources(capture.cameras, TABLE, OFFSETS), TABLE, OFFSETS, capture.frames)


def _misplaced(poses, turn_rad=0.5):
    """Return the poses with the upper arch in a wrong minimum, which covers most of its masks from 0.35 rad on."""
    middle = make_transform(np.eye(3), [0, 0, -11])
    out = poses.copy()
    out[0] = poses[0] @ middle @ se3_exp([0, turn_rad, 0, 0, 0, 0]) @ se3_inverse(middle)
    return out


class _FoundBefore:
    """A stub search with given fits and poses."""

    def __init__(self, fits, misplaced=(), mirrored_fit=None):
        self.solver = ContourSolver(SCANS, TrackingConfig())
        self.fits, self.misplaced, self.asked = list(fits), misplaced, []
        self.mirrored_fit = mirrored_fit

    def mirrored(self):
        return self._other([] if self.mirrored_fit is None else [self.mirrored_fit])

    def scaled(self, factor):
        return self._other([])

    def _other(self, fits):
        other = _FoundBefore(fits)
        other.sources = self.sources
        return other

    def at(self, footage, frame):
        if len(self.asked) == len(self.fits):
            raise TrackingError("nothing found")
        if list(footage.sources) != list(self.sources):
            raise TrackingError("nothing found after exchanging masks")
        poses = jaw_poses(FRAMES)[frame - FIRST]
        if len(self.asked) in self.misplaced:
            poses = _misplaced(poses)
        fit = self.fits[len(self.asked)]
        self.asked.append(frame)
        return SearchResult(poses, 1000.0 * fit, np.full(2, fit))


def _searched(footage, search):
    search.sources = footage.sources
    return take_start.search_start(search, footage)


def test_first_frame_with_a_clear_fit_is_used(footage):
    search = _FoundBefore([0.1, 0.5, 0.9])
    assert _searched(footage, search).frame == search.asked[1] and len(search.asked) == 2


def test_without_a_clear_fit_the_best_frame_is_used(footage):
    search = _FoundBefore([0.1, 0.15, 0.25, 0.2, 0.1])
    start = _searched(footage, search)
    assert start.frame == search.asked[2] and len(search.asked) == 5 and start.notes["fit"] == 0.25


@pytest.mark.parametrize(
    ("fit", "mirrored_fit", "refused"), [(0.07, 0.5, True), (0.07, 0.25, False), (0.2, 0.5, False)]
)
def test_a_poor_start_is_an_error_if_undoing_a_mistake_gives_a_clear_one(footage, fit, mirrored_fit, refused):
    search = _FoundBefore([fit] * 5, mirrored_fit=mirrored_fit)
    if refused:
        with pytest.raises(TrackingError, match="mirrored: left and right are exchanged"):
            _searched(footage, search)
    else:
        assert _searched(footage, search).notes["fit"] == fit


def test_wrong_minimum_that_covers_the_masks_is_refused(footage):
    solver, poses = ContourSolver(SCANS, TrackingConfig()), jaw_poses(FRAMES)[0]
    with footage.views(poses[0, :3, 3], 7.2) as masks:
        assert first_record(solver, poses, masks.at(FIRST), FIRST).solution.poses.shape == (2, 4, 4)
        with pytest.raises(TrackingError, match="upper teeth do not fit their masks") as refusal:
            first_record(solver, _misplaced(poses), masks.at(FIRST), FIRST)
    share, fit = re.findall(r"(-?[\d.]+)%? (?:of the visible|\(at least 0.03)", str(refusal.value))
    assert float(share) > 15 and float(fit) < 0  # the first alone is not conclusive


def test_a_wrong_minimum_is_escaped_by_excluding_the_uncovered_mask(footage):
    solver, poses = ContourSolver(SCANS, TrackingConfig()), jaw_poses(FRAMES)[0]
    with footage.views(poses[0, :3, 3], 7.2) as masks:
        record = first_record(solver, _misplaced(poses, 0.35), masks.at(FIRST), FIRST)
    assert record.used.all()
    for r in (0, 1):
        assert vertex_error_mm(MESHES[r], record.solution.poses[r], poses[r]) < 0.05


def test_a_frame_with_wrong_poses_is_skipped(footage):
    search = _FoundBefore([0.2] * 5, misplaced=(0, 1))
    start = _searched(footage, search)
    assert start.frame == search.asked[2]
    assert list(start.notes["failed"]) == [str(f) for f in search.asked[:2]]


def test_poor_poses_are_not_evidence_against_masks(footage, monkeypatch):
    def accuse(footage, solver, poses, frame):
        return possible_exchanges(footage)[0] if frame == search.asked[0] else None

    monkeypatch.setattr(take_start, "likely_exchange", accuse)
    search = _FoundBefore([0.1, 0.5])
    assert _searched(footage, search).frame == search.asked[1]
    search = _FoundBefore([0.5])
    with pytest.raises(TrackingError, match="exchanged in camera cam0"):
        _searched(footage, search)
