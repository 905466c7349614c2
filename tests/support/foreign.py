"""Run scripts in the environments of other programs, or skip with the command that makes them."""

import json
import os
import subprocess
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[1] / "interop" / "scripts"
_MAKE = "python tests/interop/make_environments.py FOLDER, then set JAWUSD_INTEROP=FOLDER"


def environment(name):
    """Return the folder of an environment; skip the test if it was not made."""
    folder = Path(os.environ.get("JAWUSD_INTEROP", "")) / name
    if not os.environ.get("JAWUSD_INTEROP") or not folder.is_dir():
        pytest.skip(f"no environment {name}: {_MAKE} {name}")
    return folder


def run_in(name, script, *arguments, timeout_s=240):
    """Run a script of tests/interop/scripts with the Python of an environment and return the JSON it prints."""
    return run([environment(name) / "bin" / "python", SCRIPTS / script, *arguments], timeout_s)


def run(command, timeout_s=240):
    """Run a command and return the JSON it prints after RESULT."""
    # this process has told OpenUSD of the schema; programs without jawusd do not know it
    alone = {name: value for name, value in os.environ.items() if name != "PXR_PLUGINPATH_NAME"}
    command = [str(part) for part in command]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, env=alone)
    results = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    assert results, done.stdout[-3000:] + done.stderr[-3000:]
    return json.loads(results[-1].removeprefix("RESULT "))
