"""Load a rig in a process of its own with limits: for programs that open files from people they do not know."""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np

from jawusd.base import errors, guard
from jawusd.base.inputs import SETTING, allowed_folders
from jawusd.evaluator import JawRig

#: Limits of the process: memory [GB], processor time and waiting, for slow disks [s]. Rigs take 0.3 GB and 1 s.
MOST_MEMORY_GB, MOST_CPU_S, MOST_WAIT_S = 4, 10, 60

_DAMAGED = "it is damaged, or was made to."


def load_separately(path: Path, prim: str | None = None) -> JawRig:
    """Load a rig as `jawusd.load` does, in a second Python; this one gets the arrays alone.

    Raises:
        JawusdError: As `jawusd.load`.
        RigError: The file crashes OpenUSD, or takes too much memory or time; or this program has no Python to start.
    """
    allowed = os.pathsep.join(map(str, allowed_folders()))
    folders = os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, sys.path)])
    environment = {**os.environ, "PXR_WORK_THREAD_LIMIT": "1", SETTING: allowed, "PYTHONPATH": folders}
    limits = [str(int(MOST_MEMORY_GB * 1e9)), str(MOST_CPU_S)]
    line = [_python(), "-P", "-m", __name__, os.path.abspath(path), prim or "", *limits]
    try:
        done = subprocess.run(line, env=environment, capture_output=True, timeout=MOST_WAIT_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise errors.RigError(f"takes more than {MOST_WAIT_S} s to read: {_DAMAGED}", path=path) from error
    if done.returncode == 0:
        with np.load(io.BytesIO(done.stdout), allow_pickle=False) as found:
            arrays = dict(found)
        return JawRig(arrays, json.loads(str(arrays.pop("meta"))))
    with contextlib.suppress(ValueError):
        said = json.loads(done.stdout)
        raise getattr(errors, said.pop("kind"))(said.pop("message"), **said)
    if -done.returncode == getattr(signal, "SIGXCPU", None):
        raise errors.RigError(f"takes more than {MOST_CPU_S} s of work to read: {_DAMAGED}", path=path)
    raise errors.RigError(f"ends the process that reads it (exit code {done.returncode}): {_DAMAGED}", path=path)


def _python() -> str:
    """Return a Python to start; `sys.executable` is the program itself where Python is part of one, such as Maya."""
    own = Path(sys.executable or sys.prefix)
    known = ("python", "mayapy", "hython")
    for program in (own, own.with_name("mayapy"), own.with_name("hython"), Path(sys.prefix, "bin", "python3")):
        if program.stem.lower().startswith(known) and program.is_file():
            return str(program)
    raise errors.RigError("untrusted=True needs a Python to start, and this program has none beside it.")


def main() -> None:
    """Load the rig that the arguments name and write its arrays, or the error, to standard output."""
    from jawusd import load

    path, prim, memory, cpu_s = sys.argv[1:]
    guard.limit_process(int(memory), int(cpu_s))
    try:
        try:
            rig = load(path, prim=prim or None)
        except MemoryError:
            raise guard.out_of_memory(path) from None
    except errors.JawusdError as error:
        said = {"kind": type(error).__name__, **vars(error)}
        sys.stdout.write(json.dumps(said))
        sys.exit(error.exit_code)
    np.savez(sys.stdout.buffer, allow_pickle=False, **rig.arrays, meta=np.array(json.dumps(rig.meta)))


if __name__ == "__main__":
    main()
