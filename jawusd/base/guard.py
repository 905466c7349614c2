"""Run the command in a child process with resource limits, and report crashes of native libraries as one message.

OpenUSD, FFmpeg, OpenCV and other libraries may crash or exhaust memory on a damaged file. The parent only waits for the
child, and forwards signals and the exit code.
"""

from __future__ import annotations

import contextlib
import gc
import mmap
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

from jawusd.base.errors import AnyPath, ResourceError

try:
    import resource
except ImportError:  # Windows has no resource limits
    resource = None  # type: ignore[assignment]  # a module on other systems

#: Environment variable with the maximum memory [GB] of a command; 0 for no limit.
SETTING = "JAWUSD_MEMORY_GB"

_FRACTION, _MIN_GB = 0.75, 4.0  # default limit: fraction of the memory, and minimum for usual builds
_MIN_SPACE_GB = 1.5  # minimum accepted address space; OpenUSD's libraries take 1.3 GB
_CHILD = "_JAWUSD_CHILD"  # environment variable set in the child on systems without fork
_SI_KERNEL = 0x80  # si_code (siginfo.h) of a signal from the terminal, which also goes to the child
_PR_SET_PDEATHSIG = 1  # from Linux's prctl.h
_PASSED = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2", "SIGTSTP", "SIGCONT")
_KEYS = ("SIGINT", "SIGQUIT", "SIGTSTP")
_CRASHES = ("SIGSEGV", "SIGBUS", "SIGABRT", "SIGILL", "SIGFPE", "SIGSYS", "SIGTRAP")

_current: mmap.mmap | None = None


def run_in_child() -> None:
    """Continue in a child process with limits; the parent waits for it and exits with its status.

    Call this before heavy imports and before any thread starts.
    """
    global _current
    try:
        limit = memory_limit()
        _check_address_space()
    except ResourceError as error:
        _exit_with_error(error)
    if os.environ.pop(_CHILD, None):
        return
    if not hasattr(os, "fork"):
        _run_in_subprocess()
    _current = mmap.mmap(-1, mmap.PAGESIZE)
    passed = {getattr(signal, name) for name in _PASSED}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {*passed, signal.SIGCHLD})
    parent = os.getpid()
    gc.freeze()  # prevents garbage collection from copying the pages that parent and child share
    child = os.fork()
    if child:
        _exit_like(_wait(child, passed))
    signal.pthread_sigmask(signal.SIG_SETMASK, before)
    _end_with_parent(parent)
    limit_process(limit)


def memory_limit() -> int:
    """Return how much memory a command may use [bytes]; 0 means no limit.

    Raises:
        ResourceError: The environment variable is not a number.
    """
    named = os.environ.get(SETTING)
    if not named:
        return int(max(_FRACTION * machine_memory(), _MIN_GB * 1e9))
    with contextlib.suppress(ValueError):
        if 0 <= (limit := float(named)) < 1e6:
            return int(limit * 1e9)
    raise ResourceError(f"{SETTING} is {named!r}; it must be a number of GB from 0 to 1e6, 0 for no limit.")


def machine_memory() -> int:
    """Return the memory of the machine or container [bytes]; 0 if unknown."""
    try:
        found = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # Windows has no sysconf
        return 0
    for name in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with contextlib.suppress(OSError, ValueError):  # "max" means no limit
            found = min(found, int(Path(name).read_text()))
    return found


def _check_address_space() -> None:
    """Check that OpenUSD's libraries fit into the address space; otherwise valid files would be reported as damaged."""
    space = -1 if resource is None else resource.getrlimit(resource.RLIMIT_AS)[0]  # -1: no limit
    if 0 <= space < _MIN_SPACE_GB * 1e9:
        found = (
            f"address space is limited to {space / 1e9:.2g} GB (ulimit -v); at least {_MIN_SPACE_GB:g} GB is needed."
        )
        raise ResourceError(found)


def limit_process(memory: int, cpu_s: int | None = None) -> None:
    """Limit the memory [bytes], 0 for no limit, and the processor time [s] of this process and its children.

    Private writable memory counts, but not address space that CUDA, numba and threads only reserve.
    """
    if resource is None:
        return
    _lower(resource.RLIMIT_CORE, 0)
    if memory:
        _lower(resource.RLIMIT_DATA, memory)
    if cpu_s is not None:
        _lower(resource.RLIMIT_CPU, cpu_s)


def _lower(kind: int, most: int) -> None:
    soft, hard = resource.getrlimit(kind)
    if soft == resource.RLIM_INFINITY or most < soft:
        resource.setrlimit(kind, (most, hard))


def out_of_memory(path: AnyPath | None = None) -> ResourceError:
    """Return the out-of-memory error for a file, by default the one recorded last; its message includes the limit."""
    limits = []
    if resource is not None:
        found = (resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_DATA, resource.RLIMIT_AS))
        limits = [limit for limit in found if limit != resource.RLIM_INFINITY]
    allowed = f", {min(limits) / 1e9:.2g} GB" if limits else ""
    return ResourceError(
        f"needs more memory than jawusd may use here{allowed}.", path=path or current_file(), hint=_MORE
    )


_MORE = f"Raise the limit with {SETTING} (and ulimit -v), or use a smaller input."


def note_input(path: AnyPath) -> None:
    """Record the file about to be read, which the error message names if the program crashes."""
    if _current is not None:
        name = os.fsencode(os.path.abspath(path))[: mmap.PAGESIZE - 1]
        _current[:] = name.ljust(mmap.PAGESIZE, b"\0")


def current_file() -> str:
    """Return the last recorded file, or the command line if there is none."""
    import shlex

    noted = bytes(_current).rstrip(b"\0") if _current is not None else b""
    return os.fsdecode(noted) if noted else shlex.join(["jawusd", *sys.argv[1:]])


@contextlib.contextmanager
def most_cpu(seconds: int) -> Iterator[None]:
    """Limit the processor time [s] of the enclosed block; no effect outside the guarded child."""
    if resource is None or _current is None:
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_CPU)
    _lower(resource.RLIMIT_CPU, int(time.process_time()) + 1 + seconds)
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_CPU, (soft, hard))


def _end_with_parent(parent: int) -> None:
    """Make the system kill this process when its parent ends (Linux only)."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)


def _wait(child: int, passed: set[signal.Signals]) -> int:
    """Forward signals until the child ends; return its wait status."""
    while True:
        number, is_from_terminal = _next_signal({*passed, signal.SIGCHLD})
        if number != signal.SIGCHLD:
            if not is_from_terminal:
                os.kill(child, number)
            continue
        pid, status = os.waitpid(child, os.WNOHANG | os.WUNTRACED)
        if pid and os.WIFSTOPPED(status):
            os.kill(os.getpid(), signal.SIGSTOP)  # stop as well, so that the shell registers a stopped job
        elif pid:
            return status


def _next_signal(awaited: set[signal.Signals]) -> tuple[int, bool]:
    """Return the next signal, and whether a terminal has sent it to all processes of the group."""
    if hasattr(signal, "sigwaitinfo"):
        found = signal.sigwaitinfo(awaited)
        return found.si_signo, found.si_code == _SI_KERNEL
    number = signal.sigwait(awaited)  # macOS does not report the sender
    try:
        in_front = os.tcgetpgrp(0) == os.getpgrp()
    except OSError:
        in_front = False
    return number, in_front and signal.Signals(number).name in _KEYS


def _exit_like(status: int) -> NoReturn:
    """End this process as its child ended: with the same exit code or signal, or with a message after a crash."""
    if os.WIFEXITED(status):
        os._exit(os.WEXITSTATUS(status))
    number = signal.Signals(os.WTERMSIG(status))
    if number.name in (*_CRASHES, "SIGXCPU", "SIGKILL"):
        _exit_with_error(_crash(number.name))
    signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {number})
    os.kill(os.getpid(), number)
    os._exit(128 + number)


def _crash(name: str) -> ResourceError:
    if name == "SIGXCPU":
        found, hint = "takes too much processor time to read: the file is damaged or malicious.", ""
    elif name == "SIGKILL":
        found, hint = "the program was killed here, by the system (out of memory) or by a user.", _MORE
    else:
        found = f"a library crashed here ({name}): the file is damaged, or memory ran out."
        hint = "Run `jawusd -v COMMAND` to see where."
    return ResourceError(found, path=current_file(), hint=hint or None)


def _exit_with_error(error: ResourceError) -> NoReturn:
    with contextlib.suppress(OSError):
        os.write(2, f"jawusd: {error}\n".encode(errors="backslashreplace"))
    os._exit(error.exit_code)


def _run_in_subprocess() -> NoReturn:
    """Run the program in a second Python process and exit with its status, on systems without fork."""
    import subprocess

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl+C in the console reaches both processes
    line = [sys.executable, "-m", "jawusd", *sys.argv[1:]]
    code = subprocess.run(line, env={**os.environ, _CHILD: "1"}, check=False).returncode
    if code < 0 or code >= 0xC0000000:  # Windows exit codes of uncaught exceptions
        _exit_with_error(_crash(f"{code & 0xFFFFFFFF:#x}"))
    os._exit(code)


_M_MMAP_THRESHOLD = -3  # parameter of mallopt, from glibc's malloc.h
# size [bytes] above which glibc maps arrays; mapping is slow, so a limit of 1 MB makes a report take 10 % longer
_LARGE_BYTES = 8_000_000


def map_large_arrays() -> None:
    """Make glibc return the memory of arrays above 8 MB to the system as soon as they are freed.

    By default, glibc raises its threshold to the size of the largest block freed so far. The setting is process-wide;
    libraries should not call this.
    """
    _call_glibc("mallopt", _M_MMAP_THRESHOLD, _LARGE_BYTES)


def trim_memory() -> None:
    """Return freed memory to the system with glibc; other C libraries do so on their own.

    glibc keeps free blocks that lie below a block in use: about 100 MB after each stage of a build.
    """
    _call_glibc("malloc_trim", 0)


def _call_glibc(name: str, *values: int) -> None:
    """Call a function of the C library if it has it."""
    if sys.platform == "linux":
        import ctypes

        function = getattr(ctypes.CDLL(None), name, None)
        if function is not None:
            function(*values)
