"""Segmentation stopped at any moment and resumed, compared with one that was never stopped."""

import cv2
import numpy as np
import pytest
from package_copy import ROOT

from jawusd.formats.capture import load_capture
from jawusd.media.overlay import LOWER_COLOUR, UPPER_COLOUR
from jawusd.pipeline.segment import SegmentOptions, segment_teeth
from jawusd.pipeline.segment_record import LEARNED, RECORD, with_masks, write_summary
from jawusd.segmentation.files import mask_path, write_mask, write_sheet

FRAMES = 4


class Stopped(Exception):
    """Replaces the end of a process."""


@pytest.fixture(scope="module")
def take():
    """Return the first frames of the example without its masks, and its offsets."""
    capture = load_capture(ROOT / "examples" / "capture" / "capture.toml")
    cameras = tuple(camera.model_copy(update={"masks": None}) for camera in capture.cameras)
    first = capture.frames[0]
    with np.load(capture.folder / "truth" / "truth.npz") as truth:
        offsets = dict(zip(truth["camera_names"].tolist(), truth["offsets"].tolist(), strict=True))
    return capture.model_copy(update={"cameras": cameras, "frames": (first, first + FRAMES)}), offsets


def run(take, folder, keys=None, stop_at=None):
    done = []

    def progress(stage, finished, total):
        done.append((stage, finished, total))
        if len(done) == stop_at:
            raise Stopped

    return segment_teeth(*take, folder, SegmentOptions(keys, True, 2), progress), done


@pytest.fixture(scope="module")
def undisturbed(take, tmp_path_factory):
    folder = tmp_path_factory.mktemp("masks") / "whole"
    return folder, *run(take, folder)


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize("torn", [False, True])
def test_work_taken_up_gives_the_masks_of_work_never_stopped(take, undisturbed, tmp_path, torn):
    whole, entries, done = undisturbed
    stages = ("follow", "segment")
    assert [(stage, k) for stage, k, _ in done] == [(stage, k + 1) for stage in stages for k in range(FRAMES)]
    with pytest.raises(Stopped):
        run(take, tmp_path, stop_at=FRAMES + 3)
    journal = tmp_path / RECORD
    if torn:  # the last line of the record did not reach the disk
        journal.write_bytes(journal.read_bytes()[:-40])
    again, _ = run(take, tmp_path)
    assert again == entries
    assert contents(tmp_path) == contents(whole)


@pytest.mark.slow
def test_finished_masks_teach_and_are_written_as_they_were_drawn(take, undisturbed, tmp_path):
    capture, offsets = take
    own = capture.frames[0] + 2 - offsets["cam0"]
    given = with_masks(capture, undisturbed[0]).cameras[0].masks
    drawn = {}
    for row in ("upper", "lower"):
        made = cv2.imread(str(getattr(given, row)) % own, cv2.IMREAD_GRAYSCALE)
        drawn[row] = cv2.dilate(made, np.ones((5, 5), np.uint8))  # an artist draws wider
        path = mask_path(tmp_path / "keys", "cam0", row, own)
        path.parent.mkdir(parents=True)
        write_mask(path, drawn[row])
    entries, done = run(take, tmp_path / "masks", tmp_path / "keys")
    assert done[-1] == ("segment again", FRAMES, FRAMES)
    for row, mask in drawn.items():
        path = mask_path(tmp_path / "masks", "cam0", row, own)
        assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), mask)
    learned = write_summary(capture, entries, tmp_path / "masks")["learned"]
    assert learned["pictures"] == 1
    assert learned["disagreement"][1] < 0.9 * learned["disagreement"][0]
    assert (tmp_path / "masks" / LEARNED).exists()
    wider, before = (
        cv2.imread(str(mask_path(folder, "cam0", "upper", own + 1)), cv2.IMREAD_GRAYSCALE).mean()
        for folder in (tmp_path / "masks", undisturbed[0])
    )
    assert wider > before


@pytest.mark.slow
def test_doubtful_masks_are_shown_over_their_pictures(take, undisturbed, tmp_path):
    capture, offsets = take
    own = capture.frames[0] + 1 - offsets["cam0"]
    videos = {camera.name: camera.video for camera in capture.cameras}
    write_sheet(tmp_path / "sheet.png", [("cam0", own, "outline"), ("cam1", 0, "lost")], videos, undisturbed[0])
    shown = cv2.cvtColor(cv2.imread(str(tmp_path / "sheet.png")), cv2.COLOR_BGR2RGB).astype(int)
    drawn, bare = shown[:, : shown.shape[1] // 3], shown[:, shown.shape[1] // 3 : 2 * shown.shape[1] // 3]
    for colour in (UPPER_COLOUR, LOWER_COLOUR):
        assert (np.abs(drawn - colour).max(axis=2) < 40).sum() > 100
        assert (np.abs(bare - colour).max(axis=2) < 40).sum() < 20  # that picture has no masks
