"""Read from QuickTime and MP4 files what FFmpeg does not pass on: how fast their time code tracks count.

Apple, "QuickTime File Format Specification": atoms; timecode sample description.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from fractions import Fraction
from typing import BinaryIO

_PATH = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd")
_HEAD, _LONG_HEAD = 8, 16  # bytes of an atom's size and type; of one of more than 4 GB
_TO_ENTRIES = 8  # version, flags and count of a table
_MOST_ATOMS = 100_000  # a damaged file has no end of them


def timecode_rates(path: str | os.PathLike[str]) -> list[Fraction]:
    """Return how many frames per second the time code tracks of a file count; none where it has none, or is another.

    Raises:
        OSError: it cannot be read.
    """
    with open(path, "rb") as file:
        size = file.seek(0, os.SEEK_END)
        return [rate for place in _atoms(file, 0, size, _PATH) if (rate := _rate(file, place))]


def _atoms(file: BinaryIO, start: int, stop: int, path: tuple[bytes, ...]) -> Iterator[int]:
    """Yield where the contents of atoms begin that lie on a path of types."""
    for _ in range(_MOST_ATOMS):
        file.seek(start)
        head = file.read(_LONG_HEAD)
        if stop - start < _HEAD or len(head) < _HEAD:
            return
        size, kind = struct.unpack_from(">I4s", head)
        inside = start + _HEAD
        if size == 1 and len(head) == _LONG_HEAD:
            size, inside = struct.unpack_from(">Q", head, _HEAD)[0], start + _LONG_HEAD
        end = min(stop, start + size) if size else stop
        if end < inside:
            return
        if kind == path[0]:
            if len(path) == 1:
                yield inside
            else:
                yield from _atoms(file, inside, end, path[1:])
        start = end


def _rate(file: BinaryIO, place: int) -> Fraction | None:
    """Return the rate in the first entry of a table of sample descriptions; None if it is no time code."""
    file.seek(place + _TO_ENTRIES)
    entry = file.read(34)
    if len(entry) < 33 or entry[4:8] != b"tmcd":
        return None
    # After type, index and flags: units per second, and those of a frame.
    scale, duration = struct.unpack_from(">2I", entry, 24)
    return Fraction(scale, duration) if scale and duration else None
