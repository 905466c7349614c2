"""What a child process that opens USD first may use, and what it reads: all values and all prims of a stage."""

from __future__ import annotations

import ctypes
import faulthandler
import math
import os
import signal
import sys
import time
from enum import Enum
from pathlib import Path

from pxr import Sdf, Usd

from jawusd.rig.untrusted import open_checked

#: Limits for a stage: processor time [s], address space beyond what a child has before [bytes], and waiting [s], for
#: disks that are slow. Rigs of scans take .02 s, stages of a million prims some five.
MOST_CPU_S, MOST_MEMORY, MOST_WAIT_S = 10, 4 << 30, 60

_NEW_NETWORK = 0x40000000 | 0x10000000  # CLONE_NEWNET | CLONE_NEWUSER of linux/sched.h


class End(Enum):
    """How the reading of a stage ended, as messages say it."""

    WHOLE = "is whole"
    SLOW = f"takes OpenUSD more than {MOST_CPU_S} s to read"
    LARGE = f"needs more than {MOST_MEMORY >> 30} GB to be read"
    CRASHED = "ends OpenUSD when it is read"


def end_of_death(status: int) -> End:
    """Return what ended a child, by its exit code, negative where a signal did."""
    return End.SLOW if -status == getattr(signal, "SIGXCPU", None) else End.CRASHED


def leave_all() -> None:
    """Let this process print nothing and write no files, and leave the network where users may."""
    faulthandler.disable()
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):  # the parent prints what there is to say
        os.dup2(nothing, stream)
    try:
        import resource
    except ImportError:  # on Windows, where waiting has a limit and nothing else
        return
    for kind in (resource.RLIMIT_CORE, resource.RLIMIT_FSIZE):
        resource.setrlimit(kind, (0, resource.getrlimit(kind)[1]))
    if sys.platform == "linux":
        ctypes.CDLL(None).unshare(_NEW_NETWORK)


def memory_of_child() -> int:
    """Return the address space that a child may use beyond what it has before [bytes]: `MOST_MEMORY`, or less.

    Where this process has a limit, it is half of what is left: this process opens what the child has read, and
    allocates more as it uses it; OpenUSD ends a process that cannot have what it asks for.
    """
    try:
        import resource
    except ImportError:
        return MOST_MEMORY
    limit, used = resource.getrlimit(resource.RLIMIT_AS)[0], _used_memory()
    if limit == resource.RLIM_INFINITY or used is None:
        return MOST_MEMORY
    return min(MOST_MEMORY, max(limit - used, 0) // 2)


def read_whole(path: Path, memory: int) -> End:
    """Read a stage in this process, with limits of memory and processor time that end it.

    What the rules of `open_checked` refuse counts as whole: the parent comes to the same, and says so.

    Args:
        path: of the stage.
        memory: address space beyond what this process has, from `memory_of_child` of the process that asks [bytes].
    """
    _limit(memory)
    try:
        stage = open_checked(path)
        for layer in stage.GetUsedLayers():  # binary layers read values when asked
            Sdf.Layer.CreateAnonymous(".usda").TransferContent(layer)
        for _ in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
            pass
    except MemoryError:
        return End.LARGE
    except Exception:
        return End.WHOLE
    return End.WHOLE


def _limit(memory: int) -> None:
    """Limit memory [bytes] and processor time of this process, beyond what it has used so far."""
    try:
        import resource
    except ImportError:
        return
    limits = [(resource.RLIMIT_CPU, math.ceil(time.process_time()) + MOST_CPU_S)]
    if (used := _used_memory()) is not None:
        limits.append((resource.RLIMIT_AS, used + memory))
    for kind, most in limits:
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def _used_memory() -> int | None:
    """Return the address space of this process [bytes]; None where no /proc says it."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGE_SIZE")
