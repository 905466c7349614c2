"""Clips of a capture: paths and reading options, brightness over time, and time codes.

Time codes (SMPTE ST 12-1) count frames since midnight; digits after "HH:MM:SS:" number the frames within a second.
At 29.97, 59.94 and 119.88 frames per second they may skip the first 2, 4 or 8 frame numbers of every minute that
is not a multiple of ten ("drop frame", with ";" or "." before the frames), to agree with the clock.

Rates of time code tracks are read from QuickTime and MP4 files here, since FFmpeg does not report them (Apple,
"QuickTime File Format Specification", atoms and timecode sample description).
"""

from __future__ import annotations

import math
import os
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, CaptureError

_CODE = re.compile(r"(\d{1,2}):(\d{2}):(\d{2})([:;.,])(\d{2,3})")
_HOURS_PER_DAY = 24
_PATH = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd")
_HEAD, _LONG_HEAD = 8, 16  # header lengths [bytes] of an atom (size and type), and of an atom above 4 GB
_TO_ENTRIES = 8  # length [bytes] of version, flags and count before the entries of a table
_MOST_ATOMS = 100_000  # maximum number of atoms that are read, which limits the search in damaged files


@dataclass(frozen=True)
class ClipSource:
    """Video or image sequence, with properties that its files may lack."""

    path: Path  # the video file, or a pattern of image files as in `formats.file_names`
    fps: float | None = None  # frame rate of an image sequence; ignored for videos
    #: "display", "linear", "cineon" or a name in the OpenColorIO config; if None, the file type decides
    colour_space: str | None = None
    colour_config: Path | None = None  # OpenColorIO config
    pixel_aspect: float | None = None  # width of a pixel divided by its height; if None, as stated in the file
    timecode: str = ""  # time code of the first image; if "", as stated in the file

    @property
    def is_light(self) -> bool:
        """Whether the images are floating-point linear light (EXR)."""
        return self.path.suffix.lower() == ".exr"


@dataclass(frozen=True, eq=False)
class LightCurve:
    """Brightness of one clip over time."""

    times_s: Array  # presentation times relative to the first image [s], shape (n,)
    frames: NDArray[np.int64]  # frame number of each image, shape (n,)
    brightness: Array  # mean brightness of each image, 0 to 255, shape (n,)
    # Times of abrupt darkening, shape (a,), and of abrupt brightening, shape (b,) [frames].
    off_frames: Array
    on_frames: Array


def frame_of_timecode(text: str, fps: float) -> int:
    """Convert a time code HH:MM:SS:FF, or with ";" or "." before FF for drop-frame counting, to frames since midnight.

    `fps` is the frame rate [Hz]; time codes at 23.976 Hz count 24 frames per second.

    Raises:
        CaptureError: the text is not a time code, or not valid at this frame rate.
    """
    found = _CODE.fullmatch(text.strip())
    if found is None:
        raise CaptureError(f'the time code "{text:.40}" is not of the form HH:MM:SS:FF.')
    hours, minutes, seconds, frame = (int(found[k]) for k in (1, 2, 3, 5))
    number = math.ceil(fps - 0.01)
    if hours >= _HOURS_PER_DAY or minutes > 59 or seconds > 59 or frame >= number:
        raise CaptureError(
            f'the time code "{text}" is not valid: at {fps:g} frames per second, the last one is '
            f"23:59:59:{number - 1:02}."
        )
    total = (3600 * hours + 60 * minutes + seconds) * number + frame
    if found[4] == ":":
        return total
    if number not in (30, 60, 120):
        raise CaptureError(
            f'the time code "{text}" is drop-frame, which is defined only at 29.97, 59.94 and 119.88, not at {fps:g}.'
        )
    dropped = number // 15
    if frame < dropped and seconds == 0 and minutes % 10:
        raise CaptureError(f'the time code "{text}" does not exist in drop-frame counting.')
    whole = 60 * hours + minutes
    return total - dropped * (whole - whole // 10)


def timecode_rates(path: AnyPath) -> list[Fraction]:
    """Return the frame rates of a file's time code tracks; empty for other files.

    Raises:
        OSError: the file cannot be read.
    """
    with open(path, "rb") as file:
        size = file.seek(0, os.SEEK_END)
        return [rate for place in _atoms(file, 0, size, _PATH) if (rate := _rate(file, place))]


def _atoms(file: BinaryIO, start: int, stop: int, path: tuple[bytes, ...]) -> Iterator[int]:
    """Yield the content offsets of the atoms at a path of atom types."""
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
    """Return the rate in the first entry of a sample description table; None if it is not a time code."""
    file.seek(place + _TO_ENTRIES)
    entry = file.read(34)
    if len(entry) < 33 or entry[4:8] != b"tmcd":
        return None
    # The time scale and the units per frame are stored after type, index and flags.
    scale, duration = struct.unpack_from(">2I", entry, 24)
    return Fraction(scale, duration) if scale and duration else None
