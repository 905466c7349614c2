"""Which frames have masks, by camera: masks of two cameras that were exchanged begin and end with the wrong frames."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

#: First and last frame with a mask of the upper and of the lower teeth, in a camera's own numbers; None without any.
Ranges = tuple[tuple[int, int] | None, tuple[int, int] | None]


def exchanged_by_frames(
    ranges: Mapping[str, Ranges], offsets: Mapping[str, int], first: int, stop: int
) -> list[tuple[str, str]]:
    """Return pairs of cameras whose masks begin and end with the take only if they are exchanged.

    Args:
        ranges: frames with masks, by camera.
        offsets: reference frame minus own frame number, by camera.
        first, stop: first frame of the take and one past its last, of the reference camera.
    """

    def fits(source: str, camera: str) -> bool:
        shown = [own for own in ranges[source] if own is not None]
        begin, end = min((own[0] for own in shown), default=stop), max((own[1] for own in shown), default=first)
        return begin + offsets[camera] == first and end + offsets[camera] == stop - 1

    wrong = [name for name in ranges if not fits(name, name)]
    return [(a, b) for a, b in combinations(wrong, 2) if fits(a, b) and fits(b, a)]
