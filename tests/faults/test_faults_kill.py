"""Builds that are killed and resumed write the same files as an undisturbed one.

The stages only write random data by seed, so that kills hit the writing; tests/benchmarks/faults.py kills whole builds.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from faults import digests, records, stages, unfinished
from package_copy import ROOT
from short_example import write_short

ENVIRONMENT = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests' / 'support'}"}
PROGRAM = """
import sys, time
import numpy as np
from pathlib import Path
from jawusd.formats.atomic import scratch_folder, write_npz_atomic
from jawusd.pipeline import build
from stage_results import stage_result

def stub(number, name):
    def work(run, *_):
        rng = np.random.default_rng(number)
        paths = [run.folder / f"{name}{k}.npz" for k in range(12)]
        for path in paths:
            with scratch_folder(path) as folder:
                (folder / "half").write_bytes(b"x")
                write_npz_atomic(path, {"a": rng.normal(size=20_000)})
        return paths, stage_result(name, {"cam0": 0, "cam1": 2, "cam2": -1})
    setattr(build, f"_{name}", work)

for number, name in enumerate(("sync", "track", "fit", "refine", "bake", "report")):
    stub(number, name)
print("ready", flush=True)
build.build(sys.argv[1], sys.argv[2], build.BuildOptions(resume=True), lambda *_: None)
"""


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A capture that is soon checked: most of a build is writing."""
    return write_short(tmp_path_factory.mktemp("short") / "capture", 16)


def start(capture, out):
    command = [sys.executable, "-c", PROGRAM, str(capture), str(out)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT, start_new_session=True
    )
    assert process.stdout.readline().strip() == "ready"
    return process


def end(process):
    process.wait()
    process.stdout.close()
    return process.returncode


@pytest.fixture(scope="module")
def left_alone(capture, tmp_path_factory):
    """A finished build, and its duration."""
    folder = tmp_path_factory.mktemp("left") / "alone"
    begun = time.perf_counter()
    assert end(start(capture, folder)) == 0
    return folder, time.perf_counter() - begun


@pytest.mark.slow
def test_killed_builds_end_as_one_that_was_left_alone(capture, left_alone, tmp_path):
    alone, whole_s = left_alone
    exact, rng, killed = digests(alone), np.random.default_rng(0), 0
    assert len(exact) == 72
    out = tmp_path / "killed"
    for _ in range(3):
        process = start(capture, out)
        time.sleep(rng.uniform(0.05, 0.4) * whole_s)
        killed += process.poll() is None
        os.killpg(process.pid, signal.SIGKILL)
        end(process)
        there = digests(out) if out.exists() else {}
        assert {name: exact[name] for name in there} == there  # no incomplete files
    assert killed >= 1
    assert end(start(capture, out)) == 0
    assert digests(out) == exact and records(out) == records(alone) and unfinished(out) == []


@pytest.mark.slow
def test_what_a_killed_build_left_is_cleared_and_nothing_else(capture, tmp_path):
    out = tmp_path / "out"
    (out / "masks").mkdir(parents=True)
    for name in (".jawusd-tmp-geo-1.usdc", "masks/.jawusd-tmp-000001-2.png", ".mine", "masks/.jawusd-mine"):
        (out / name).write_bytes(b"x")
    (out / ".jawusd-tmp-folder").mkdir()
    assert end(start(capture, out)) == 0
    assert unfinished(out) == [] and (out / ".mine").exists() and (out / "masks" / ".jawusd-mine").exists()


@pytest.mark.slow
def test_a_record_that_was_changed_is_refused(capture, left_alone, tmp_path):
    out = shutil.copytree(left_alone[0], tmp_path / "out")
    path = out / "build.json"
    data = json.loads(path.read_text())
    data["stages"]["sync"]["result"]["offsets"]["cam1"] = 3
    path.write_text(json.dumps(data))
    assert stages_are_refused(out)
    assert end(start(capture, out)) != 0


def stages_are_refused(out):
    try:
        stages(out)
    except ValueError:
        return True
    return False
