"""Packed records round-trip."""

import errno

import numpy as np
import pytest
from small_take import make_capture, track, write_masks

from jawusd.base.errors import OutputError
from jawusd.formats.tracks import LostReason
from jawusd.tracking.contour import frame_record
from jawusd.tracking.contour.frame_record import NO_LOSS, FrameRecord, Loss, PackedRecords
from jawusd.tracking.sequence import passes

FRAMES = 4


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """Return the records of a take before packing."""
    made = {}

    class Kept(PackedRecords):
        def __setitem__(self, frame, record):
            made[frame] = record
            super().__setitem__(frame, record)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(passes, "PackedRecords", Kept)
        track(make_capture(write_masks(tmp_path_factory.mktemp("take"), FRAMES), FRAMES))
    return made


def test_records_round_trip(records):
    packed = PackedRecords()
    packed.update(records)
    assert list(packed) == list(records) and len(packed) == FRAMES
    for frame, record in records.items():
        found = packed[frame]
        for name in ("status", "used", "coverage"):
            np.testing.assert_array_equal(getattr(found, name), getattr(record, name))
            assert getattr(found, name).dtype == getattr(record, name).dtype
        np.testing.assert_array_equal(np.array(found.losses, float), np.array(record.losses, float))
        own, kept = record.solution, found.solution
        for name in ("poses", "centres", "visible_px"):
            np.testing.assert_array_equal(getattr(kept, name), getattr(own, name))
        for name in ("scatters", "gum_scatters"):
            np.testing.assert_allclose(getattr(kept, name), getattr(own, name), rtol=1e-6, atol=1e-30)
        for one, other in zip(kept.outline, own.outline, strict=True):
            assert one.shape == other.shape
            np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-30)


def test_a_replaced_record_is_not_served_from_the_cache(records):
    packed = PackedRecords()
    packed.update(records)
    first, second = sorted(packed)[:2]
    assert packed[first].losses[1].reason == LostReason.NONE
    old = records[first]
    lost = (NO_LOSS, Loss(LostReason.LOW_SCORE, 0.3, 0.6))
    packed[first] = FrameRecord(old.solution, old.status, old.used, old.coverage, lost)
    assert packed[first].losses[1] == lost[1]
    del packed[first]
    assert first not in packed and second in packed
    assert list(packed.kept([second])) == [second]


def test_long_takes_are_stored_in_a_file_and_read_back(records, monkeypatch):
    monkeypatch.setattr(frame_record, "_IN_MEMORY", 1000)
    packed = PackedRecords()
    for frame in range(40 * FRAMES):
        packed[frame] = records[sorted(records)[frame % FRAMES]]
    assert packed._store._file._rolled  # there is a file
    copy = packed.kept(packed)
    packed[0] = records[sorted(records)[1]]
    for frame in (0, 1, 40 * FRAMES - 1):
        found, own = copy[frame].solution, records[sorted(records)[frame % FRAMES]].solution
        np.testing.assert_array_equal(found.poses, own.poses)
    np.testing.assert_array_equal(packed[0].solution.poses, packed[1].solution.poses)
    assert packed[0] is not packed[1]


def test_a_full_folder_is_one_message(records, monkeypatch):
    def full(data):
        raise OSError(errno.ENOSPC, "No space left on device")

    packed = PackedRecords()
    monkeypatch.setattr(packed._store._file, "write", full)
    with pytest.raises(OutputError, match="of a long take: No space left") as caught:
        packed.update(records)
    assert "TMPDIR" in caught.value.hint
