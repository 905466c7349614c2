"""Disturb builds: kill them at a chosen moment, and say what a folder holds."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from package_copy import ROOT

from jawusd.base.npz import check_format
from jawusd.pipeline.state import BUILD_FILE, LOCK_FILE, hash_value

REPORT = "report.html"
UNFINISHED = ".jawusd-tmp-"
POLL_S = 0.005


def start_build(capture, out, *options):
    """Start `jawusd build` in a process group of its own."""
    command = [sys.executable, "-m", "jawusd", "build", str(capture), "-o", str(out), *options]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment, start_new_session=True
    )


def kill(process):
    """Kill a build as a power cut would; return whether it was still at work."""
    working = process.poll() is None
    if working:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    process.stderr.close()
    return working


def finish(process, timeout_s=3600):
    """Let a build end and return its exit code and what it said."""
    _, said = process.communicate(timeout=timeout_s)
    return process.returncode, said


def stages(out):
    """Return the records of finished stages; a build.json that is half written or changed fails here."""
    path = Path(out) / BUILD_FILE
    if not path.exists():
        return {}
    data = json.loads(path.read_text())
    check_format(data["format"], "jawusd-build", 1, path)
    if data["sha256"] != hash_value(data["stages"]):
        raise ValueError(f"{path} does not match its hash")
    return data["stages"]


def wait_for_stage(process, out, before):
    """Wait until stages are finished, or the build has ended."""
    while process.poll() is None and not before <= set(stages(out)):
        time.sleep(POLL_S)


def digests(out):
    """Return the SHA-256 of every file of a rig's folder by its name.

    Left out are the lock, what a killed build left unfinished, build.json (see `records`) and the report, which says
    how many seconds each stage took.
    """
    left_out = {LOCK_FILE, BUILD_FILE, REPORT}
    files = [path for path in sorted(Path(out).rglob("*")) if path.is_file() and path.name not in left_out]
    files = [path for path in files if UNFINISHED not in str(path)]
    return {str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def records(out):
    """Return what build.json says of every stage, but for times, command lines and the report's own hash."""
    kept = {}
    for name, record in stages(out).items():
        outputs = {file: found for file, found in record["outputs"].items() if file != REPORT}
        result = {key: value for key, value in record["result"].items() if key != "origin"}
        kept[name] = {"inputs": record["inputs"], "outputs": outputs, "result": result}
    return kept


def unfinished(out):
    """Return the names of temporary files."""
    return [str(path.relative_to(out)) for path in Path(out).rglob(f"{UNFINISHED}*")]
