"""Builds that are killed and resumed write the same files as an undisturbed one.

The stages only write random data by seed, so that kills hit the writing; tests/benchmarks/faults.py kills whole builds.
"""

import json
import os
import shutil
import signal
import time

import numpy as np
import pytest
from faults import digests, records, stages, unfinished
from short_example import write_short
from stage_results import stage_result

from jawusd.formats.atomic import scratch_folder, write_npz_atomic
from jawusd.pipeline import build
from jawusd.pipeline.state import no_progress

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="copies of a process")

FILES = 12  # of a stage


def stub(number, name):
    """Return a stage that only writes."""

    def work(run, *_):
        rng = np.random.default_rng(number)
        paths = [run.folder / f"{name}{k}.npz" for k in range(FILES)]
        for path in paths:
            with scratch_folder(path) as folder:
                (folder / "half").write_bytes(b"x")
                write_npz_atomic(path, {"a": rng.normal(size=20_000)})
        return paths, stage_result(name, {"cam0": 0, "cam1": 2, "cam2": -1})

    return work


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A capture that is soon checked: most of a build is writing."""
    return write_short(tmp_path_factory.mktemp("short") / "capture", 16)


def start(capture, out):
    """Start a build in a copy of this process, which has imported what it needs, and return the copy's id."""
    child = os.fork()
    if child == 0:
        try:
            os.setsid()
            build._check = lambda run: ([], {"findings": []})
            for number, name in enumerate(("sync", "track", "fit", "refine", "bake", "report")):
                setattr(build, f"_{name}", stub(number, name))
            build.build(capture, out, build.BuildOptions(resume=True), no_progress)
            os._exit(0)
        finally:
            os._exit(1)
    return child


def end(child):
    """Wait for a copy; return its exit code, or the negative number of the signal that ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


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
    assert len(exact) == 6 * FILES
    out = tmp_path / "killed"
    for _ in range(3):
        child = start(capture, out)
        time.sleep(rng.uniform(0.05, 0.4) * whole_s)
        os.kill(child, signal.SIGKILL)
        killed += end(child) == -signal.SIGKILL
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
