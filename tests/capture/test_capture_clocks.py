"""Synchronisation by time code and by frame numbers."""

from fractions import Fraction

import numpy as np
import pytest
from clip_files import counting_at, with_exr_header, write_prores, write_sequence

from jawusd.base.errors import SyncError
from jawusd.capture.sync import estimate_offsets
from jawusd.formats.capture import Capture
from jawusd.formats.clips import ClipSource, frame_of_timecode
from jawusd.media.footage import open_clip
from jawusd.media.masks import MaskReader

IMAGES = np.full((8, 32, 32, 3), 90, np.uint8)


def capture(folder, method, cameras, fps=24.0):
    scans = {"upper_teeth": "u.ply", "lower_teeth": "l.ply"}
    rows = [{"name": name, **rest} for name, rest in cameras.items()]
    return Capture(folder=folder, name="x", fps=fps, scans=scans, cameras=rows, sync={"method": method})


def test_time_codes_of_clips(tmp_path):
    clips = {
        "a": {"video": write_prores(tmp_path / "a.mov", IMAGES, Fraction(24), "01:00:00:23")},
        "b": {"video": write_prores(tmp_path / "b.mov", IMAGES, Fraction(24), "01:00:01:02")},
        "c": {"video": write_sequence(tmp_path / "c", IMAGES, "png8"), "timecode": "01:00:00:20"},
    }
    found = estimate_offsets(capture(tmp_path, "timecode", clips))
    assert found.offsets == {"a": 0, "b": 3, "c": -3} and found.method == "time code"


def test_time_codes_over_midnight_and_with_dropped_numbers(tmp_path):
    pattern = write_sequence(tmp_path / "c", IMAGES, "png8")
    for first, second, fps, offset in (
        ("23:59:59:22", "00:00:00:01", 24.0, 3),
        ("00:00:59;28", "00:01:00;03", 30000 / 1001, 3),
    ):
        clips = {name: {"video": pattern, "timecode": code} for name, code in (("a", first), ("b", second))}
        assert estimate_offsets(capture(tmp_path, "timecode", clips, fps)).offsets == {"a": 0, "b": offset}


NTSC = Fraction(30000, 1001)


# Rate of the pictures, rate of the time code, first time codes of two clips, frames between them.
@pytest.mark.parametrize(
    ("rate", "counted", "codes", "offset"),
    [
        (2 * NTSC, NTSC, ("10:00:00;10", "10:00:00;20"), 20),
        (2 * NTSC, NTSC, ("10:00:59;28", "10:01:00;03"), 6),
        (2 * NTSC, NTSC, ("10:00:59:29", "10:01:00:01"), 4),
        (Fraction(50), Fraction(25), ("09:59:59:24", "10:00:00:01"), 4),
        (Fraction(60), Fraction(30), ("00:00:00:00", "00:00:00:07"), 14),
        (4 * NTSC, NTSC, ("10:00:00;00", "10:00:00;01"), 4),
        (Fraction(100), Fraction(25), ("10:00:00:02", "10:00:00:00"), -8),
        (Fraction(48), Fraction(24), ("23:59:59:23", "00:00:00:01"), 4),
        (2 * NTSC, 2 * NTSC, ("10:00:59;58", "10:01:00;05"), 3),
        (4 * NTSC, 4 * NTSC, ("10:00:59;118", "10:01:00;009"), 3),
        (NTSC, NTSC, ("10:00:59;28", "10:01:00;03"), 3),
    ],
)
def test_time_code_tracks_count_at_their_own_rate(tmp_path, rate, counted, codes, offset):
    clips = {}
    for name, code in zip("ab", codes):
        start = frame_of_timecode(code, float(counted))
        drops = ";" in code
        path = write_prores(
            tmp_path / f"{name}.mov", np.repeat(IMAGES, 4, 0), rate, "00:00:00;00" if drops else "00:00:00:00"
        )
        clips[name] = {"video": counting_at(path, counted, start)}
        assert open_clip(path).timecode == code and open_clip(path).timecode_fps == pytest.approx(float(counted))
    found = estimate_offsets(capture(tmp_path, "timecode", clips, float(rate)))
    assert found.offsets == {"a": 0, "b": offset}
    assert any("frames share one" in note for note in found.notes) == (rate != counted)


def test_a_time_code_whose_numbers_hold_parts_of_pictures_is_refused(tmp_path):
    path = write_prores(tmp_path / "a.mov", IMAGES, Fraction(60), "00:00:00:00")
    clips = {"a": {"video": counting_at(path, Fraction(24), 0)}}
    with pytest.raises(SyncError, match="has 24 frames per second, .* 60 frames per second"):
        estimate_offsets(capture(tmp_path, "timecode", clips, 60.0))


def test_headers_of_fast_pictures_count_pairs(tmp_path):
    """They cannot represent more than 39 frames per second."""
    clips = {}
    for name, frame in (("a", 0x10), ("b", 0x13)):
        pattern = write_sequence(tmp_path / name, IMAGES, "exr")
        for file in sorted((tmp_path / name).iterdir()):
            with_exr_header(file, timeCode_timecode=(0x01000000 | frame).to_bytes(4, "little") + bytes(4))
        clips[name] = {"video": pattern}
    assert estimate_offsets(capture(tmp_path, "timecode", clips, 50.0)).offsets == {"a": 0, "b": 6}
    assert estimate_offsets(capture(tmp_path, "timecode", clips, 25.0)).offsets == {"a": 0, "b": 3}


def test_a_rate_that_no_file_states_is_said_to_be_assumed(tmp_path):
    pattern = write_sequence(tmp_path / "c", IMAGES, "png8")
    clips = {name: {"video": pattern, "timecode": code} for name, code in (("a", "01:00:00:10"), ("b", "01:00:00:13"))}
    found = estimate_offsets(capture(tmp_path, "timecode", clips, 50.0))
    assert found.offsets == {"a": 0, "b": 3} and "count 50 frames per second" in found.notes[0]
    assert estimate_offsets(capture(tmp_path, "timecode", clips, 25.0)).notes == ()


def test_clocks_of_clips_of_other_rates_are_not_compared(tmp_path):
    clips = {
        "a": {"video": write_prores(tmp_path / "a.mov", IMAGES, Fraction(50), "00:00:00:00")},
        "b": {"video": write_prores(tmp_path / "b.mov", IMAGES, Fraction(25), "00:00:00:00")},
    }
    with pytest.raises(SyncError, match="camera b has 25 frames per second, but camera a has 50"):
        estimate_offsets(capture(tmp_path, "timecode", clips, 50.0))


def test_clocks_that_tell_nothing(tmp_path):
    pattern = write_sequence(tmp_path / "c", IMAGES, "png8")
    clips = {"a": {"video": pattern, "timecode": "00:00:00:00"}, "b": {"video": pattern}}
    with pytest.raises(SyncError, match="camera b: the clip has no time code") as error:
        raise_with_place(tmp_path, clips)
    assert "timecode = " in error.value.hint
    clips["b"]["timecode"] = "00:00:09:00"
    with pytest.raises(SyncError, match="according to its timecode, starts 216 frames after camera a"):
        raise_with_place(tmp_path, clips)
    clips["b"]["timecode"] = "noon"
    with pytest.raises(SyncError, match=r'the time code "noon" is not of the form HH:MM:SS:FF'):
        raise_with_place(tmp_path, clips)


def raise_with_place(folder, clips):
    try:
        estimate_offsets(capture(folder, "timecode", clips))
    except SyncError as error:
        raise SyncError(error.statement(), hint=error.hint) from error


def test_numbers_of_pictures(tmp_path):
    clips = {
        "a": {"video": write_sequence(tmp_path / "a", IMAGES, "png8", first=1001)},
        "b": {"video": write_sequence(tmp_path / "b", IMAGES, "png8", first=1004)},
        "c": {"video": write_sequence(tmp_path / "c", IMAGES, "png8", first=0), "start_frame": 999},
    }
    assert estimate_offsets(capture(tmp_path, "numbers", clips)).offsets == {"a": 0, "b": 3, "c": -2}


def test_masks_carry_the_numbers_of_the_pictures(tmp_path):
    import cv2

    clip = open_clip(ClipSource(write_sequence(tmp_path / "v", IMAGES, "png8", left_out=(1003,)), fps=24.0))
    (tmp_path / "m").mkdir()
    for number in (1001, 1002, 1004, 1005):
        mask = np.zeros((32, 32), np.uint8)
        mask[: number - 1000, :] = 255
        cv2.imwrite(str(tmp_path / "m" / f"{number}.png"), mask)
    with MaskReader(tmp_path / "m" / "%d.png", (32, 32), timeline=clip.timeline) as masks:
        rows = [None if (mask := masks.read(k)) is None else int((mask[:, 0] > 127).sum()) for k in range(8)]
    assert rows == [1, 2, None, 4, 5, None, None, None]
