"""Open USD in a child process first: a crash or an endless wait in OpenUSD ends the child, and becomes one message."""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import gc
import os
import selectors
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterable
from enum import Enum
from pathlib import Path

from pxr import Sdf, Usd, Work

from jawusd.errors import RigError
from jawusd.formats.allowed_folders import SETTING, allowed_folders, is_allowed
from jawusd.rig.untrusted import open_checked

#: Limits of a child: processor time [s], address space beyond what it starts with [bytes], and waiting [s], for disks
#: that are slow. Rigs of scans take .02 s, stages of a million prims some five.
MOST_CPU_S, MOST_MEMORY, MOST_WAIT_S = 10, 4 << 30, 60

_MOST_SLEEP_S = 3  # of a copy of this process: then a new one decides
_TRIES = 200  # to find all other threads asleep, a millisecond apart
_FULL, _IS_STARTED = 3, 4  # exit codes of a child that needs more memory, and of a new process that did its work
_NEW_NETWORK = 0x40000000 | 0x10000000  # CLONE_NEWNET | CLONE_NEWUSER of linux/sched.h
_TRUST = f"If you trust it, allow its folder with --allow or the setting {SETTING}: then it is read without limits."


class _End(Enum):
    """How a child ended, as messages say it."""

    WHOLE = "is whole"
    SLOW = f"takes OpenUSD more than {MOST_CPU_S} s to read"
    LARGE = f"needs more than {MOST_MEMORY >> 30} GB to be read"
    CRASHED = "ends OpenUSD when it is read"


_known: dict[Path, dict[Path, tuple[int, ...]]] = {}


def try_in_child(path: Path) -> None:
    """Open a stage and read all it holds in a child process, unless its folder is allowed or it was read before.

    What the child refuses with a message is left to the caller, who comes to the same message.

    Raises:
        RigError: The child crashed, or needed more time or memory than it may have.
    """
    if is_allowed(path) or _is_known(path):
        return
    end = _forked(path) if _can_fork() else None
    if end in (None, _End.CRASHED):
        end = _started(path) or end
    if end not in (None, _End.WHOLE):  # None: no child can be had
        raise RigError(f"{end.value}: it is damaged, or was made to.", path=path, hint=_TRUST)


def remember(path: Path, files: Iterable[Path]) -> None:
    """Note the files of a stage that was opened: in this process it is not tried again before one of them changes."""
    _known[path.absolute()] = {file: _state(file) for file in files}


def _is_known(path: Path) -> bool:
    files = _known.get(path.absolute())
    return files is not None and all(_state(file) == state for file, state in files.items())


def _state(file: Path) -> tuple[int, ...]:
    try:
        found = file.stat()
    except OSError:
        return ()
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns


def _can_fork() -> bool:
    """Return whether no other thread can hold a lock that a copy of this process would wait for: on Linux, all sleep.

    Threads of OpenUSD end what they have begun within milliseconds; threads of Python may stand anywhere.
    """
    if sys.platform != "linux" or threading.active_count() > 1:
        return False
    for _ in range(_TRIES):
        if all(_state_and_time(f"self/task/{thread}")[0] == "S" for thread in _other_threads()):
            return True
        time.sleep(0.001)
    return False


def _other_threads() -> list[int]:
    return [int(name) for name in os.listdir("/proc/self/task") if int(name) != os.getpid()]


def _state_and_time(process: str) -> tuple[str, int]:
    """Return what a process or thread does (R runs, S sleeps) and its processor time [ticks]; S if it has ended."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return "S", 0
    return fields[0], int(fields[11]) + int(fields[12])


def _forked(path: Path) -> _End | None:
    """Read in a copy of this process, some 5 ms; return None where it waits, maybe for what another thread held."""
    reading, writing = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of Python 3.12, for the idle threads of OpenUSD
        child = os.fork()
    if child == 0:
        try:
            Work.SetConcurrencyLimit(1)  # the threads of the parent are not here
            os._exit(_read(path))
        finally:  # nothing else of the parent's runs here
            os._exit(1)
    os.close(writing)
    ended = False
    try:
        ended = _ends(child, reading)
    finally:
        os.close(reading)
        if not ended:
            os.kill(child, signal.SIGKILL)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return _end(status, whole=0) if ended else None


def _ends(child: int, reading: int) -> bool:
    """Wait for a child to close its end of a pipe; return False where it has slept too long, or worked too long."""
    slept_s, worked = 0, 0
    with selectors.DefaultSelector() as selector:
        selector.register(reading, selectors.EVENT_READ)
        for _ in range(MOST_WAIT_S):
            if selector.select(1.0):
                return True
            state, ticks = _state_and_time(str(child))
            slept_s = slept_s + 1 if state == "S" and ticks == worked else 0
            worked = ticks
            if slept_s > _MOST_SLEEP_S:
                return False
    return False


def _started(path: Path) -> _End | None:
    """Read in a new Python, some 0.4 s; return None where there is no program to start."""
    if (
        not Path(sys.executable or "").stem.lower().startswith(("python", "mayapy", "hython"))
    ):  # a program that Python is part of
        return None
    program = "import sys; from jawusd.rig.child_process import main; sys.exit(main(sys.argv[1]))"
    folders = os.pathsep.join(map(str, allowed_folders()))
    environment = {**os.environ, SETTING: folders, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", program, str(path.absolute())],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            env=environment, timeout=MOST_WAIT_S, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return _End.SLOW
    except OSError:
        return None
    return None if done.returncode == 1 else _end(done.returncode, whole=_IS_STARTED)


def _end(status: int, whole: int) -> _End:
    if status == whole:
        return _End.WHOLE
    if status == _FULL:
        return _End.LARGE
    return _End.SLOW if -status == getattr(signal, "SIGXCPU", None) else _End.CRASHED


def main(path: str) -> int:
    """Read a stage in this process, which ends thereafter; return its exit code."""
    return _read(Path(path)) or _IS_STARTED


def _read(path: Path) -> int:
    gc.disable()  # it would copy what is shared with the parent
    faulthandler.disable()
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):  # the parent prints what there is to say
        os.dup2(nothing, stream)
    _limit()
    try:
        _read_all(open_checked(path))
    except MemoryError:
        return _FULL
    except Exception:  # the parent comes to the same, and says so
        return 0
    return 0


def _limit() -> None:
    """Limit memory and time of this process; let it write no files, and leave the network where users may."""
    try:
        import resource
    except ImportError:  # on Windows, where waiting has a limit and nothing else
        return
    limits = [(resource.RLIMIT_CPU, MOST_CPU_S), (resource.RLIMIT_CORE, 0), (resource.RLIMIT_FSIZE, 0)]
    with contextlib.suppress(OSError):
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limits.append((resource.RLIMIT_AS, pages * resource.getpagesize() + MOST_MEMORY))
    for kind, most in limits:
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
    if sys.platform == "linux":
        ctypes.CDLL(None).unshare(_NEW_NETWORK)


def _read_all(stage: Usd.Stage) -> None:
    """Read all values of a stage's layers, which binary layers do when asked, and visit all prims, of instances too."""
    for layer in stage.GetUsedLayers():
        Sdf.Layer.CreateAnonymous(".usda").TransferContent(layer)
    for _ in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        pass
