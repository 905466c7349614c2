"""One rule for the report and the viewer: which frames fit their masks worst."""

import numpy as np
from report_data import report_data

from jawusd.formats.tracks import uncovered_percent, worst_frames
from jawusd.pipeline.pictures import chosen_frames
from jawusd.viewer.plots import frames_to_inspect


def take():
    tracks = report_data(count=90).tracks
    tracks.coverage_error[:] = 0.005
    tracks.masks_used[:] = True
    return tracks


def test_masks_that_were_not_used_do_not_count():
    tracks = take()
    tracks.coverage_error[30, 1, 0] = 0.5
    tracks.masks_used[30, 1, 0] = False
    tracks.coverage_error[60] = 0.05
    np.testing.assert_allclose(uncovered_percent(tracks)[30], 0.5)
    assert frames_to_inspect(tracks, 24.0)[0] == tracks.frames[60]
    assert chosen_frames(tracks, 24.0)[0] == (60, "5.00 % of the worse arch's masks uncovered")


def test_a_frame_without_used_masks_is_never_chosen():
    tracks = take()
    tracks.coverage_error[10], tracks.masks_used[10] = 0.9, False
    assert np.isnan(uncovered_percent(tracks)[10]).all()
    assert 10 not in {index for index, _ in chosen_frames(tracks, 24.0)}
    assert tracks.frames[10] not in frames_to_inspect(tracks, 24.0)


def test_the_worst_frames_keep_half_a_second_apart_and_away_from_those_taken():
    badness = np.array([5.0, 4.0, np.nan, 3.0, 2.0, 1.0])
    frames = np.array([0, 5, 10, 20, 40, 60])
    assert worst_frames(badness, frames, fps=24.0, most=9) == [0, 3, 4, 5]
    assert worst_frames(badness, frames, fps=24.0, most=2, taken=[3]) == [0, 4]
