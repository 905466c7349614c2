"""NVIDIA's validator, replaced by a fake program that writes reports in its format."""

import json
import os
import stat
import sys

import pytest

from jawusd.base.errors import RigError
from jawusd.rig.rules import Finding
from jawusd.rig.validate import PROGRAM, find_nvidia_validator, nvidia_findings


def program(folder, body):
    """Write an executable that does `body` with the report's path in `report`."""
    path = folder / PROGRAM
    lines = [f"#!{sys.executable}", "import sys", "report = sys.argv[sys.argv.index('--json-output') + 1]", body]
    path.write_text("\n".join(lines) + "\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def issue(severity, name, at):
    return {"severity": severity, "rule": {"name": name}, "at": at, "message": f"{name} says so"}


def test_issues_become_findings(tmp_path):
    issues = [issue("FAILURE", "A", None), issue("WARNING", "B", "/Actor"), issue("INFO", "C", "/Actor/geo")]
    text = json.dumps({"status": "FAIL", "rules": [{"issues": issues}]})
    found = nvidia_findings("actor.usda", program(tmp_path, f"open(report, 'w').write({text!r}); sys.exit(1)"))
    assert found == [
        Finding("error", "A", "/", "A says so"),
        Finding("warning", "B", "/Actor", "B says so"),
        Finding("info", "C", "/Actor/geo", "C says so"),
    ]


def test_a_clean_report_is_no_finding(tmp_path):
    text = json.dumps({"status": "PASS", "rules": []})
    assert nvidia_findings("x", program(tmp_path, f"open(report, 'w').write({text!r})")) == []


def test_no_report_is_an_error(tmp_path):
    with pytest.raises(RigError, match="wrote no report: broken"):
        nvidia_findings("x", program(tmp_path, "sys.exit('broken')"))


def test_program_is_found_on_the_path(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    if find_nvidia_validator() is None:
        made = program(tmp_path, "pass")
        assert find_nvidia_validator() == made
    assert os.access(find_nvidia_validator(), os.X_OK)
