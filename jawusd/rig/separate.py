"""Load a rig in a separate process with limited resources, for programs that open files from unknown sources."""

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

#: Limits of the process: memory [GB], processor time [s], and wall time [s], which is longer because disks may be
#: slow. Rigs take 0.3 GB and 1 s.
MAX_MEMORY_GB, MAX_CPU_S, MAX_WAIT_S = 4, 10, 60

_DAMAGED = "the file is damaged or malicious."


def load_separately(path: Path, prim: str | None = None) -> JawRig:
    """Load a rig like `jawusd.load`, but in a second Python process, which returns only the arrays.

    Raises:
        JawusdError: see `jawusd.load`.
        RigError: The file crashes OpenUSD or exceeds the limits, or there is no Python interpreter to start.
    """
    allowed = os.pathsep.join(map(str, allowed_folders()))
    folders = os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, sys.path)])
    environment = {**os.environ, "PXR_WORK_THREAD_LIMIT": "1", SETTING: allowed, "PYTHONPATH": folders}
    limits = [str(int(MAX_MEMORY_GB * 1e9)), str(MAX_CPU_S)]
    line = [_python(), "-P", "-m", __name__, os.path.abspath(path), prim or "", *limits]
    try:
        done = subprocess.run(line, env=environment, capture_output=True, timeout=MAX_WAIT_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise errors.RigError(f"takes more than {MAX_WAIT_S} s to read: {_DAMAGED}", path=path) from error
    if done.returncode == 0:
        with np.load(io.BytesIO(done.stdout), allow_pickle=False) as found:
            arrays = dict(found)
        return JawRig(arrays, json.loads(str(arrays.pop("meta"))))
    with contextlib.suppress(ValueError):
        reported = json.loads(done.stdout)
        raise getattr(errors, reported.pop("kind"))(reported.pop("message"), **reported)
    if -done.returncode == getattr(signal, "SIGXCPU", None):
        raise errors.RigError(f"takes more than {MAX_CPU_S} s of processor time to read: {_DAMAGED}", path=path)
    raise errors.RigError(f"crashes the process that reads it (exit code {done.returncode}): {_DAMAGED}", path=path)


def _python() -> str:
    """Return a Python interpreter; in programs that embed Python, such as Maya, `sys.executable` may not be one."""
    own = Path(sys.executable or sys.prefix)
    known = ("python", "mayapy", "hython")
    for program in (own, own.with_name("mayapy"), own.with_name("hython"), Path(sys.prefix, "bin", "python3")):
        if program.stem.lower().startswith(known) and program.is_file():
            return str(program)
    raise errors.RigError("untrusted=True needs a Python interpreter, but none was found next to this program.")


def main() -> None:
    """Load the rig given by the arguments and write its arrays, or the error, to standard output."""
    from jawusd import load

    path, prim, memory, cpu_s = sys.argv[1:]
    guard.limit_process(int(memory), int(cpu_s))
    try:
        try:
            rig = load(path, prim=prim or None)
        except MemoryError:
            raise guard.out_of_memory(path) from None
    except errors.JawusdError as error:
        sys.stdout.write(json.dumps({"kind": type(error).__name__, **vars(error)}))
        sys.exit(error.exit_code)
    np.savez(sys.stdout.buffer, allow_pickle=False, **rig.arrays, meta=np.array(json.dumps(rig.meta)))


if __name__ == "__main__":
    main()
