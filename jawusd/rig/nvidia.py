"""The findings of NVIDIA's validator (usd-validation-nvidia), where it is installed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from jawusd.base.errors import RigError
from jawusd.rig.rules import Finding

PROGRAM = "nvidia_usd_validate"
_TIMEOUT_S = 600
_SEVERITIES = {"INFO": "info", "WARNING": "warning"}


def find_nvidia_validator() -> Path | None:
    """Return the validator's program beside this Python or on the path, or None."""
    found = shutil.which(PROGRAM, path=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]))
    return Path(found) if found else None


def nvidia_findings(path: str | os.PathLike[str], program: Path) -> list[Finding]:
    """Return the findings of NVIDIA's validator, as `find_nvidia_validator` gives it, with its default rules.

    Raises:
        RigError: The program failed to give a report.
    """
    with tempfile.TemporaryDirectory() as scratch:
        report = Path(scratch) / "report.json"
        command = [str(program), "--json-output", str(report), str(path)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
        except subprocess.TimeoutExpired as error:
            raise RigError(f"{PROGRAM} did not finish in {_TIMEOUT_S} s.", path=path) from error
        if not report.is_file():
            raise RigError(f"{PROGRAM} gave no report: {done.stderr.strip()[-300:]}", path=path)
        rules = json.loads(report.read_text(encoding="utf-8")).get("rules", [])
    return [
        Finding(
            _SEVERITIES.get(issue["severity"], "error"),
            issue["rule"]["name"],
            str(issue["at"] or "/"),
            issue["message"],
        )
        for rule in rules
        for issue in rule["issues"]
    ]
