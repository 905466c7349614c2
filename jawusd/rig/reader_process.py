"""A second Python that opens USD first, one stage after the other, for programs that cannot be forked."""

from __future__ import annotations

import atexit
import contextlib
import io
import json
import os
import selectors
import subprocess
import sys
import threading
from pathlib import Path
from typing import IO, cast

from jawusd.formats.allowed_folders import SETTING, allow_folders, allowed_folders
from jawusd.rig import child_limits
from jawusd.rig.child_limits import End, end_of_death

_PROGRAM = "from jawusd.rig.reader_process import main; main()"
_ALONE = {"PXR_WORK_THREAD_LIMIT": "1", "TF_ENV_SETTING_ALERTS_ENABLED": "0"}
_ALONE |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # only processes of one thread may leave the network
_READY, _MOST_START_S = "READY", 60


class ReaderProcess:
    """Hold a Python that reads stages: 0.4 s to start, some 5 ms a stage; a new one after a stage that ends it."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._owner = 0
        self._has_read = False
        self._lock = threading.Lock()
        atexit.register(self.close)

    def runs(self) -> bool:
        """Tell whether it was started, by this process: not by one that this is a fork of."""
        return self._process is not None and self._owner == os.getpid()

    def read(self, path: Path, memory: int) -> End | None:
        """Read a stage there with so much memory [bytes]; return None where no program can be started."""
        with self._lock:
            used = self.runs() and self._has_read
            end = self._ask(path, memory)
            if end is End.CRASHED and used:  # maybe for what it had read before
                end = self._ask(path, memory)
        return end

    def close(self) -> None:
        """Let it end."""
        if self._process is not None and self.runs():
            _end(self._process)
        self._process = None

    def _ask(self, path: Path, memory: int) -> End | None:
        """Return what the process answers, or how it ended without an answer; None if there is none."""
        if not self.runs():
            self._process = self._started()
        process = self._process
        if process is None:
            return None
        allowed = [str(folder) for folder in allowed_folders()]
        request = {"path": str(path.absolute()), "memory": memory, "allowed": allowed}
        self._has_read = True
        answer, in_time = _answer(process, child_limits.MOST_WAIT_S, json.dumps(request))
        if answer in (End.WHOLE.name, End.SLOW.name):
            return End[answer]
        self.close()
        if answer:
            return End.LARGE
        return end_of_death(process.returncode) if in_time else End.SLOW

    def _started(self) -> subprocess.Popen[str] | None:
        """Start the process; return None in a program that Python is part of, and where it cannot be started."""
        if not Path(sys.executable or "").stem.lower().startswith(("python", "mayapy", "hython")):
            return None
        environment = {**os.environ, **_ALONE, "PYTHONPATH": os.pathsep.join(_folders())}
        environment.pop(SETTING, None)  # every request says what is allowed
        try:
            process = subprocess.Popen(
                [sys.executable, "-P", "-c", _PROGRAM], env=environment, text=True, encoding="utf-8",
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        except OSError:
            return None
        if _answer(process, _MOST_START_S)[0] != _READY:
            _end(process)
            return None
        self._owner, self._has_read = os.getpid(), False
        return process


def _folders() -> list[str]:
    """Return the folders that Python imports from, without the one it stands in unless this package lies there."""
    folders = [folder for folder in sys.path if folder]
    own = str(Path(__file__).resolve().parents[2])
    return folders if own in folders else [own, *folders]


def _answer(process: subprocess.Popen[str], most_s: float, request: str | None = None) -> tuple[str, bool]:
    """Return the next line a process writes, "" if it ends before, and whether it did so in time: else it is killed."""
    if process.stdin is None or process.stdout is None:
        return "", True
    if request is not None:
        with contextlib.suppress(OSError):  # it has ended
            process.stdin.write(request + "\n")
            process.stdin.flush()
    in_time = _writes(process.stdout, most_s)
    if not in_time:
        process.kill()
    return process.stdout.readline().strip(), in_time


def _writes(pipe: IO[str], most_s: float) -> bool:
    """Wait until a pipe, from which lines were read whole, has something to read or ends; tell whether it did in time.

    Without a thread where that can be had: a program that is short of memory cannot start one.
    """
    if sys.platform != "win32":
        with selectors.DefaultSelector() as selector:
            selector.register(pipe, selectors.EVENT_READ)
            return bool(selector.select(most_s))
    buffer = cast(io.TextIOWrapper, pipe).buffer
    waiting = threading.Thread(target=cast(io.BufferedReader, buffer).peek, args=(1,), daemon=True)
    waiting.start()
    waiting.join(most_s)
    return not waiting.is_alive()


def _end(process: subprocess.Popen[str]) -> None:
    process.kill()
    with contextlib.suppress(OSError, ValueError):  # what was not written to it
        process.communicate()
    process.wait()


def main() -> None:
    """Read stages that standard input names, a line of JSON each, and answer with the name of an `End`."""
    requests = os.fdopen(os.dup(0), encoding="utf-8")
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    child_limits.leave_all()
    answers.write(_READY + "\n")
    for line in requests:
        request = json.loads(line)
        allow_folders(request["allowed"])
        answers.write(child_limits.read_whole(Path(request["path"]), request["memory"]).name + "\n")
