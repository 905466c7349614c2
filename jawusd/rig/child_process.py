"""Open USD in a child process first: a crash or an endless wait in OpenUSD ends the child, and becomes one message."""

from __future__ import annotations

import atexit
import gc
import os
import selectors
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pxr import Work

from jawusd.errors import RigError
from jawusd.formats.allowed_folders import SETTING, is_allowed
from jawusd.rig import child_limits
from jawusd.rig.child_limits import End, end_of_death, leave_all, memory_of_child, read_whole
from jawusd.rig.reader_process import ReaderProcess

_MOST_SLEEP_S = 3  # of a copy of this process: then a new one decides
_TRIES = 20  # to find all other threads asleep, a millisecond apart
_EXIT_CODES = {End.WHOLE: 0, End.LARGE: 3}
_TRUST = f"If you trust it, allow its folder with --allow or the setting {SETTING}: then it is read without limits."
_MORE_MEMORY = "Give the process more address space (ulimit -v)."

_reader = ReaderProcess()
_known: dict[Path, dict[Path, tuple[int, ...]]] = {}
_begun: dict[Path, _Copy] = {}


def begin_in_child(path: Path) -> None:
    """Let a copy of this process begin what `try_in_child` will wait for, while this one imports what it needs next.

    Does nothing where it would have to be a new Python, where there is no such file, and where memory is limited: how
    much the copy may use shows when this process has all it needs.
    """
    if not path.is_file() or is_allowed(path) or _is_known(path) or _reader.runs():
        return
    memory = memory_of_child()
    if memory == child_limits.MOST_MEMORY and _can_fork():
        _drop(_begun.pop(path.absolute(), None))
        _begun[path.absolute()] = _copied(path, memory)


def try_in_child(path: Path) -> None:
    """Open a stage and read all it holds in a child process, unless its folder is allowed or it was read before.

    What the child refuses with a message is left to the caller, who comes to the same message.

    Raises:
        RigError: The child crashed, or needed more time or memory than it may have.
    """
    begun = _begun.pop(path.absolute(), None)
    if is_allowed(path) or _is_known(path):
        _drop(begun)
        return
    memory = memory_of_child()
    copied = begun is not None or (not _reader.runs() and _can_fork())
    end = _end_of(begun or _copied(path, memory)) if copied else None
    if end in (None, End.CRASHED):
        end = _reader.read(path, memory) or end
    if end is None and not copied and _can_fork():  # the second Python has ended, and no new one can be started
        end = _end_of(_copied(path, memory))
    if end in (End.LARGE, End.CRASHED) and memory < child_limits.MOST_MEMORY:
        found = f"cannot be read with {memory >> 20} MB, half of the memory that this process may still use."
        raise RigError(found, path=path, hint=_MORE_MEMORY)
    if end not in (None, End.WHOLE):  # None: no child can be had
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


@dataclass(frozen=True)
class _Copy:
    """A copy of this process that reads a stage.

    Attributes:
        child: Its process number.
        pipe: What ends when it has read.
        owner: The process that may wait for it.
    """

    child: int
    pipe: int
    owner: int


def _copied(path: Path, memory: int) -> _Copy:
    """Begin to read in a copy of this process, some 5 ms."""
    reading, writing = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of Python 3.12, for the idle threads of OpenUSD
        child = os.fork()
    if child == 0:
        try:
            Work.SetConcurrencyLimit(1)  # the threads of the parent are not here
            gc.disable()  # it would copy what is shared with the parent
            leave_all()
            os._exit(_EXIT_CODES[read_whole(path, memory)])
        finally:  # nothing else of the parent's runs here
            os._exit(1)
    os.close(writing)
    return _Copy(child, reading, os.getpid())


def _end_of(copy: _Copy) -> End | None:
    """Return how a copy ends; None where it waits, maybe for what another thread held."""
    ended = False
    try:
        ended = _ends(copy.child, copy.pipe)
    finally:
        status = _closed(copy, kill=not ended)
    if not ended:
        return None
    return next((end for end, code in _EXIT_CODES.items() if code == status), end_of_death(status))


def _closed(copy: _Copy, kill: bool) -> int:
    """Wait for the end of a copy and return its exit code."""
    os.close(copy.pipe)
    if kill:
        os.kill(copy.child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(copy.child, 0)[1])


def _drop(copy: _Copy | None) -> None:
    if copy is not None and copy.owner == os.getpid():  # not in a fork of this process
        _closed(copy, kill=True)


@atexit.register
def _drop_all() -> None:
    while _begun:
        _drop(_begun.popitem()[1])


def _ends(child: int, reading: int) -> bool:
    """Wait for a child to close its end of a pipe; return False where it has slept too long, or worked too long.

    Its main thread does all its work; a thread of the task scheduler may run in circles for workers that were not
    copied.
    """
    slept_s, worked = 0, 0
    with selectors.DefaultSelector() as selector:
        selector.register(reading, selectors.EVENT_READ)
        for _ in range(child_limits.MOST_WAIT_S):
            if selector.select(1.0):
                return True
            state, ticks = _state_and_time(f"{child}/task/{child}")
            slept_s = slept_s + 1 if state == "S" and ticks == worked else 0
            worked = ticks
            if slept_s > _MOST_SLEEP_S:
                return False
    return False
