"""Freed memory is returned to the system."""

import ctypes
import re
import subprocess
import sys
from pathlib import Path

import pytest

from jawusd.base.guard import trim_memory

GLIBC = sys.platform == "linux" and hasattr(ctypes.CDLL(None), "malloc_trim")
LARGE_ARRAYS = """
import re
from pathlib import Path
from jawusd.base.guard import map_large_arrays

def resident_mb():
    return int(re.search(r"VmRSS:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 1024

map_large_arrays()
larger = bytearray(b"1") * 30_000_000
del larger
arrays = [bytearray(b"1") * 20_000_000 for _ in range(5)]
above = bytearray(b"1") * 100_000
before = resident_mb()
arrays.clear()
print(before - resident_mb())
"""
PIECES, PIECE_BYTES = 3000, 60_000  # too small for a mapping each


def resident_mb():
    return int(re.search(r"VmRSS:\s+(\d+)", Path("/proc/self/status").read_text())[1]) / 1024


@pytest.mark.skipif(not GLIBC, reason="the C library is not glibc")
def test_large_arrays_are_given_back_when_they_are_freed():
    run = subprocess.run([sys.executable, "-c", LARGE_ARRAYS], capture_output=True, text=True, check=True)
    assert float(run.stdout) > 90


@pytest.mark.skipif(not GLIBC, reason="the C library is not glibc")
def test_what_lies_below_memory_in_use_is_given_back():
    pieces = [bytearray(b"1") * PIECE_BYTES for _ in range(PIECES)]
    kept = pieces[-1]
    pieces.clear()
    before = resident_mb()
    trim_memory()
    assert before - resident_mb() > 0.5 * PIECES * PIECE_BYTES / 2**20
    assert len(kept) == PIECE_BYTES
