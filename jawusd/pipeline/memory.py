"""What a process that goes on gives back to the system."""

from __future__ import annotations

import ctypes
import sys


def give_back_memory() -> None:
    """Return memory that was freed to the system; where the C library is not glibc, leave that to it.

    glibc keeps what lies below anything still in use: some 100 MB after each stage of a build, on top of which the next
    one takes its own.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
