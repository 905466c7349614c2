"""Time code: the count of frames since midnight that cameras write to their files, SMPTE ST 12-1.

Numbers after "HH:MM:SS:" count frames of a second. At 29.97, 59.94 and 119.88 frames per second the count may leave
out the first two, four or eight numbers of every minute but each tenth ("drop frame", written with ";" or "." before
the frames), to keep to the clock.
"""

from __future__ import annotations

import math
import re

from jawusd.base.errors import CaptureError

_CODE = re.compile(r"(\d{1,2}):(\d{2}):(\d{2})([:;.,])(\d{2,3})")
_PER_DAY_HOURS = 24


def frame_of_timecode(text: str, fps: float) -> int:
    """Return how many frames a time code counts since midnight.

    Args:
        text: HH:MM:SS:FF, or with ";" or "." before FF if frame numbers are dropped.
        fps: frames per second; of a rate like 23.976 time codes count 24 numbers.

    Raises:
        CaptureError: it is no time code, or none of this rate.
    """
    found = _CODE.fullmatch(text.strip())
    if found is None:
        raise CaptureError(f'the time code "{text:.40}" is not HH:MM:SS:FF.')
    hours, minutes, seconds, frame = (int(found[k]) for k in (1, 2, 3, 5))
    number = math.ceil(fps - 0.01)
    if hours >= _PER_DAY_HOURS or minutes > 59 or seconds > 59 or frame >= number:
        raise CaptureError(
            f'the time code "{text}" cannot be: at {fps:g} frames per second the last one is 23:59:59:{number - 1:02}.'
        )
    total = (3600 * hours + 60 * minutes + seconds) * number + frame
    if found[4] == ":":
        return total
    if number not in (30, 60, 120):
        raise CaptureError(
            f'the time code "{text}" drops frame numbers; that is done at 29.97, 59.94 and 119.88, not at {fps:g}.'
        )
    dropped = number // 15
    if frame < dropped and seconds == 0 and minutes % 10:
        raise CaptureError(f'the time code "{text}" is left out in drop-frame counting.')
    whole = 60 * hours + minutes
    return total - dropped * (whole - whole // 10)
