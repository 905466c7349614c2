"""What a process that goes on gives back to the system."""

from __future__ import annotations

import ctypes
import sys

_M_MMAP_THRESHOLD = -3  # of glibc's malloc.h
_LARGE_BYTES = 8_000_000  # smaller ones cost time to map: from 1 MB on, a tenth of that of a report


def map_large_arrays() -> None:
    """Let arrays of more than 8 MB go back to the system as soon as they are freed, from here on, with glibc.

    It does so at first, but stops for arrays as large as the largest that was freed. This holds for the whole process,
    so that it is for programs and workers alone.
    """
    if sys.platform == "linux":
        option = getattr(ctypes.CDLL(None), "mallopt", None)
        if option is not None:
            option(_M_MMAP_THRESHOLD, _LARGE_BYTES)


def give_back_memory() -> None:
    """Return memory that was freed to the system; where the C library is not glibc, leave that to it.

    glibc keeps what lies below anything still in use: some 100 MB after each stage of a build, on top of which the next
    one takes its own.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
