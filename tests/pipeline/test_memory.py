"""Freed memory that lies below memory in use goes back to the system."""

import ctypes
import re
import sys
from pathlib import Path

import pytest

from jawusd.pipeline.memory import give_back_memory

PIECES, PIECE_BYTES = 3000, 60_000  # too small to be mapped one by one


def resident_mb():
    return int(re.search(r"VmRSS:\s+(\d+)", Path("/proc/self/status").read_text())[1]) / 1024


@pytest.mark.skipif(
    sys.platform != "linux" or not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="the C library is not glibc"
)
def test_what_lies_below_memory_in_use_is_given_back():
    pieces = [bytearray(b"1") * PIECE_BYTES for _ in range(PIECES)]
    kept = pieces[-1]
    pieces.clear()
    before = resident_mb()
    give_back_memory()
    assert before - resident_mb() > 0.5 * PIECES * PIECE_BYTES / 2**20
    assert len(kept) == PIECE_BYTES
