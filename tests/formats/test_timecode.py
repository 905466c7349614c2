"""Time codes against a count of every number there is."""

from itertools import count

import pytest

from jawusd.base.errors import CaptureError
from jawusd.formats.clips import frame_of_timecode


@pytest.mark.parametrize(("fps", "number", "dropped"), [(30000 / 1001, 30, 2), (60000 / 1001, 60, 4)])
def test_dropped_numbers_are_those_the_count_leaves_out(fps, number, dropped):
    frames = count()
    for minute in range(21):
        for second in range(60):
            for frame in range(dropped if second == 0 and minute % 10 else 0, number):
                text = f"00:{minute:02}:{second:02};{frame:02}"
                assert frame_of_timecode(text, fps) == next(frames)


@pytest.mark.parametrize("fps", [23.976, 24.0, 25.0, 29.97, 30.0, 50.0, 59.94, 120.0])
def test_all_numbers_are_counted_without_dropping(fps):
    number = round(fps)
    assert frame_of_timecode("00:00:00:00", fps) == 0
    assert frame_of_timecode(f"01:00:00:{number - 1:02}", fps) == 3600 * number + number - 1


@pytest.mark.parametrize(
    ("text", "fps"),
    [("10:20:30", 24.0), ("10:20:30:24", 24.0), ("24:00:00:00", 24.0), ("00:01:00;00", 29.97), ("00:00:10;00", 24.0)],
)
def test_codes_that_cannot_be(text, fps):
    with pytest.raises(CaptureError, match="time code"):
        frame_of_timecode(text, fps)
