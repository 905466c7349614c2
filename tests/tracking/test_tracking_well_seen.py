"""Wrong first frames are corrected by tracking back from well-seen frames."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from small_take import FIRST, START, errors_mm, make_capture, track, write_masks

from jawusd.formats.tracks import LOST, RECOVERED, TRACKED, LostReason
from jawusd.tracking.contour.equations import OutlineSums
from jawusd.tracking.contour.frame_record import FrameRecord
from jawusd.tracking.sequence import passes
from jawusd.tracking.sequence.passes import Passes, mark_poorly_seen_lost, nearest_well_seen

FRAMES = 10
OFF_MM = 2.5  # beyond the gates, so that a nearby contour is matched instead
WRONG = range(FIRST + START - 1, FIRST + START + 2)


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """Return the records of a correct take, and its capture."""
    capture = make_capture(write_masks(tmp_path_factory.mktemp("take"), FRAMES), FRAMES)
    kept = {}

    def keep(self, take, first):
        kept.update(self.records)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Passes, "judge_first", keep)
        track(capture)
    return kept, capture


def lost(record: FrameRecord) -> FrameRecord:
    """Return the record of a frame whose lower teeth are lost."""
    return replace(record, status=np.array([record.status[0], LOST], np.int8))


def test_the_nearest_frame_that_is_tracked_is_well_seen(records):
    known, _ = records
    start = FIRST + START
    assert nearest_well_seen(known, start) == start
    hidden = {frame: lost(record) if frame in WRONG else record for frame, record in known.items()}
    assert nearest_well_seen(hidden, start) in (WRONG.start - 1, WRONG.stop)
    assert nearest_well_seen({frame: lost(record) for frame, record in known.items()}, start) is None


def test_wrong_first_frames_are_tracked_again_from_the_others(records, monkeypatch):
    known, capture = records
    judge_first = Passes.judge_first
    seen = {}

    def plant(self, take, first):
        down = np.eye(4)
        down[1, 3] = -OFF_MM
        for frame in WRONG:
            record, views = self.records[frame], self._masks.at(frame)
            poses = record.solution.poses.copy()
            poses[1] = down @ poses[1]
            solution = self._solver.solve(poses, views, (0.1,), record.used)
            self.records[frame] = replace(record, solution=solution)
        seen["before"] = centres(self.records)
        judge_first(self, take, first)
        seen["after"] = centres(self.records)

    monkeypatch.setattr(Passes, "judge_first", plant)
    tracks = track(capture)
    right = centres(known)
    off_mm = {when: np.linalg.norm(found - right, axis=2).max() for when, found in seen.items()}
    assert off_mm["before"] > 2.0, "the planted frames are wrong"
    assert off_mm["after"] < 0.1
    assert (tracks.status != LOST).all()
    assert errors_mm(tracks).max() < 0.2


def test_lost_frames_are_followed_again_from_the_next_one(records, monkeypatch):
    _, capture = records
    missing, follow = {FIRST + START + 3, FIRST + START + 4}, Passes._one

    def lose(self, tracker, motion, frame, views):
        record = follow(self, tracker, motion, frame, views)
        if frame not in missing:
            return record
        missing.remove(frame)
        return lost(record)

    monkeypatch.setattr(Passes, "_one", lose)
    tracks = track(capture)
    assert not missing
    again = np.isin(tracks.frames - FIRST - START, (3, 4))
    assert (tracks.status[again] == [TRACKED, RECOVERED]).all() and (tracks.status[~again] == TRACKED).all()
    assert errors_mm(tracks).max() < 0.2


def centres(records):
    """Return the centres of both arches in all frames [mm], shape (n, 2, 3)."""
    return np.array([records[frame].solution.centres for frame in sorted(records)])


def seen(share, rough_px):
    """Return a record with a given matched share [-] and residual [px] of the lower arch."""
    share, rough = (np.array([usual, lower])[:, None] * np.ones(3) for usual, lower in ((0.6, share), (0.6, rough_px)))
    none, weight = OutlineSums.zeros(3), np.full((2, 3), 100.0)
    edges = none._replace(score_px=500 * share, weight=weight, square=100 * 0.828 * rough**2)
    solution = SimpleNamespace(outline=edges, visible_px=np.full((2, 3), 500.0))
    return FrameRecord(solution, np.full(2, TRACKED, np.int8), np.ones((2, 3), bool), np.zeros((2, 3)))


@pytest.mark.parametrize(
    ("share", "rough_px", "given_up"),
    [(0.12, 1.1, True), (0.12, 0.7, False), (0.5, 1.1, False), (0.5, 0.6, False)],
)
def test_an_arch_that_fits_far_less_and_far_more_roughly_than_usual_is_lost(share, rough_px, given_up):
    known = {frame: seen(0.5, 0.6) for frame in range(10)} | {4: seen(share, rough_px)}
    mark_poorly_seen_lost(known)
    lost = {frame: (record.status == LOST).tolist() for frame, record in known.items()}
    assert lost == {frame: [False, given_up and frame == 4] for frame in range(10)}
    if given_up:
        assert [loss.reason for loss in known[4].losses] == [LostReason.NONE, LostReason.LOW_SCORE]
        assert known[4].losses[1].value == pytest.approx(share / 0.5)


def test_few_frames_give_no_reference():
    known = {frame: seen(0.5, 0.6) for frame in range(4)} | {4: seen(0.12, 1.1)}
    mark_poorly_seen_lost(known)
    assert (known[4].status == TRACKED).all()


def test_poorly_seen_frames_of_a_take_are_lost(records, monkeypatch):
    _, capture = records
    monkeypatch.setattr(passes, "_POOR_SHARE", 2.0)  # so that every frame counts as poorly seen
    monkeypatch.setattr(passes, "_POOR_RESIDUAL", 0.0)
    tracks = track(capture)
    assert (tracks.status == LOST).all() and (tracks.lost_reason == LostReason.LOW_SCORE).all()
