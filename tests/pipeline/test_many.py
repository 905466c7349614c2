"""Builds of many captures: a killed worker, a bad capture, an interrupt, a missing cluster."""

import contextlib
import csv
import json
import os
import signal
import socket
import subprocess
import sys
import time

import dask
import psutil
import pytest
from distributed import LocalCluster
from package_copy import ROOT
from run_jawusd import heed_signals, without_report
from short_example import results, write_short
from typer.testing import CliRunner

from jawusd.base.errors import CaptureError, ClusterError, OutputError
from jawusd.cli.main import app
from jawusd.cli.text_build import outcome_lines
from jawusd.formats.capture_list import ListedCapture
from jawusd.pipeline import many
from jawusd.pipeline.build import BuildOptions, build
from jawusd.pipeline.many import Outcome, build_many

FRAMES = 16  # a model needs 15
WAIT_SECONDS = 400
# A cluster in the process of the tests, on loopback and without a dashboard.
INSIDE = {
    "processes": False,
    "host": "tcp://127.0.0.1",
    "dashboard_address": "127.0.0.1:0",
    "scheduler_kwargs": {"dashboard": False},
}


def started(folder, *arguments):
    """Start the program on the list of a folder, in a new process group as in a terminal."""
    command = [sys.executable, "-m", "jawusd", "build-many", str(folder / "list.txt"), "-o", str(folder / "out")]
    how = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    how["env"] = without_report(folder / "hidden")
    return subprocess.Popen([*command, *arguments], **how, preexec_fn=heed_signals)


def worker_on(process, folder):
    """Wait until the tracking of a folder is under way and return the process that holds its lock."""
    end = time.monotonic() + WAIT_SECONDS
    while time.monotonic() < end and process.poll() is None:
        with contextlib.suppress(psutil.Error):
            for child in psutil.Process(process.pid).children(recursive=True):
                held = {file.path for file in child.open_files()}
                if str(folder / ".jawusd-lock") in held and "sync" in recorded(folder):
                    return child
        time.sleep(0.05)
    raise AssertionError(f"no worker came to {folder}: {process.communicate()}")


def recorded(folder):
    path = folder / "build.json"
    return json.loads(path.read_text())["stages"] if path.exists() else {}


@pytest.fixture(scope="module")
def shoot(tmp_path_factory):
    """One capture listed twice, and a missing one."""
    folder = tmp_path_factory.mktemp("shoot")
    write_short(folder / "take", FRAMES, without=("skull",))
    (folder / "list.txt").write_text("# a shoot\ntake, first\nnowhere\ntake, second\n")
    return folder


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_a_killed_worker_and_a_bad_capture_leave_the_rest_as_serial_builds_make_it(shoot, monkeypatch):
    process = started(shoot, "--workers", "2", "--json")
    worker_on(process, shoot / "out" / "first").send_signal(signal.SIGKILL)
    answer, told = process.communicate(timeout=WAIT_SECONDS)
    assert process.returncode == 1 and "Traceback" not in told, told
    builds = {row["name"]: row for row in json.loads(answer)["builds"]}
    assert [row["status"] for row in builds.values()] == ["built", "failed", "built"]
    assert builds["first"]["frames"] == builds["first"]["tracked"] == FRAMES
    assert "no such" in builds["nowhere"]["error"] and not (shoot / "out" / "nowhere").exists()
    monkeypatch.setattr("jawusd.pipeline.build.missing_packages", lambda: "no report: nothing here reads it")
    build(shoot / "take", shoot / "serial", BuildOptions(), lambda *_: None)
    serial = results(shoot / "serial")
    assert len(serial) > 50
    for name in ("first", "second"):
        assert results(shoot / "out" / name) == serial


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize(
    ("send", "number"), [(os.killpg, signal.SIGINT), (os.kill, signal.SIGTERM), (os.killpg, signal.SIGTERM),
                         (os.kill, signal.SIGHUP)],
    ids=["Ctrl+C", "kill", "end of a service", "end of a terminal"],
)  # fmt: skip
def test_an_interrupt_leaves_no_process_and_no_half_file(shoot, tmp_path, monkeypatch, send, number):
    (tmp_path / "list.txt").write_text(f"{shoot / 'take'}\n")
    (tmp_path / "scratch").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "scratch"))
    process = started(tmp_path, "--workers", "1")
    worker_on(process, tmp_path / "out" / "take")
    children = psutil.Process(process.pid).children(recursive=True)
    send(process.pid, number)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 128 + number and "Traceback" not in told, told
    assert os.listdir(tmp_path / "scratch") == [] and (tmp_path / "out" / "builds.csv").is_file()
    assert psutil.wait_procs(children, timeout=5)[1] == []
    assert set(os.listdir(tmp_path / "out" / "take")) <= {".jawusd-lock", "build.json"}
    (row,) = json.loads((tmp_path / "out" / "builds.json").read_text())["builds"]
    assert row["status"] == "stopped"


@pytest.fixture(scope="module")
def here():
    """A scheduler with a worker inside this process, so that tests can replace its functions."""
    with LocalCluster(n_workers=1, threads_per_worker=1, **INSIDE) as found:
        yield found.scheduler_address


def made_up_build(path, folder, options, progress):
    """Replace `build`: the name of the capture selects the outcome."""
    progress("track", 1, 2)
    if path.name == "bad":
        raise CaptureError("is bad.", path=path)
    if path.name == "fault":
        raise ZeroDivisionError("by accident")
    while path.name == "endless":
        progress("track", 2, 2)
        time.sleep(0.01)
    seconds = {"track": 2.0, "fit": 0.5}
    return {
        "seconds": seconds,
        "reused": list(seconds) if path.name == "kept" else ["track"],
        "track": {"frames": 7, "tracked": 6, "sigma_mm": {"incisor": 0.1}},
        "fit": {"errors": {"train": {"mandible": {"mean": 0.25}}}},
    }


def listed(tmp_path, *names):
    return [ListedCapture(tmp_path / name, name) for name in names]


def test_every_way_a_build_can_go_is_one_row(here, tmp_path, monkeypatch):
    monkeypatch.setattr(many, "build", made_up_build)
    options = many.ManyOptions(BuildOptions(), cluster=here)
    told = []
    found = build_many(listed(tmp_path, "bad", "fault", "kept", "good"), tmp_path / "out", options, told.append)
    assert [o.status for o in found] == ["failed", "failed", "kept", "built"]
    assert "bad: is bad." in found[0].error
    assert "ZeroDivisionError in test_many.py, line" in found[1].error
    good = Outcome("good", str(tmp_path / "good"), "built", 7, 6, 0.25, None, 0.1, 2.5)
    assert found[3] == good
    assert "[4/4]" in "\n".join(told)
    rows = list(csv.DictReader((tmp_path / "out" / "builds.csv").read_text().splitlines()))
    assert [row["name"] for row in rows] == ["bad", "fault", "kept", "good"] and rows[3]["model_mm"] == "0.25"
    table = outcome_lines(found)
    assert len({len(line) for line in table[:5]}) == 1 and "0.250" in table[4] and "is bad." in table[5]


def test_an_interrupted_run_calls_its_builds_off(here, tmp_path, monkeypatch):
    monkeypatch.setattr(many, "build", made_up_build)

    def interrupt(line):
        if line.startswith("[1/3]"):
            raise KeyboardInterrupt

    options = many.ManyOptions(BuildOptions(), cluster=here)
    with pytest.raises(KeyboardInterrupt):
        build_many(listed(tmp_path, "good", "endless", "never"), tmp_path / "out", options, interrupt)
    rows = json.loads((tmp_path / "out" / "builds.json").read_text())["builds"]
    assert [row["status"] for row in rows] == ["built", "stopped", "stopped"]
    # The worker is free again: another run on the same cluster succeeds.
    again = build_many(listed(tmp_path, "good"), tmp_path / "again", options, lambda line: None)
    assert again[0].status == "built"


def test_a_folder_with_a_build_needs_a_word(here, tmp_path, monkeypatch):
    monkeypatch.setattr(many, "build", made_up_build)
    (tmp_path / "out" / "good").mkdir(parents=True)
    (tmp_path / "out" / "good" / "build.json").write_text("{}")
    captures = listed(tmp_path, "other", "good")
    with pytest.raises(OutputError, match="--resume"):
        build_many(captures, tmp_path / "out", many.ManyOptions(BuildOptions(), cluster=here), lambda line: None)
    assert not (tmp_path / "out" / "other").exists()
    options = many.ManyOptions(BuildOptions(resume=True), cluster=here)
    assert build_many(captures, tmp_path / "out", options, lambda line: None)[1].status == "built"


def test_local_workers_listen_to_this_machine_alone_and_a_deadly_capture_is_given_up():
    with many.local_cluster(workers=1, retries=0) as client:
        me = psutil.Process()
        heard = [c for p in (me, *me.children(recursive=True)) for c in p.net_connections() if c.status == "LISTEN"]
        assert {c.laddr.ip for c in heard} == {"127.0.0.1"}
        assert list(client.run(dask.config.get, "distributed.worker.profile.enabled").values()) == [False]
        many.check_workers(client, ROOT)
        with pytest.raises(ClusterError, match="cannot access"):
            many.check_workers(client, ROOT / "missing")
        future = client.submit(os._exit, 1)
        future.exception(timeout=60)
        outcome = many._outcome(future, ListedCapture(ROOT, "x"))
    assert outcome.status == "failed" and "every process that ran it died" in outcome.error


def silent():
    """Return a socket that accepts connections and never answers."""
    listener = socket.create_server(("127.0.0.1", 0))
    return listener, f"tcp://127.0.0.1:{listener.getsockname()[1]}"


def test_a_scheduler_that_does_not_answer_is_one_clear_error(monkeypatch, tmp_path):
    monkeypatch.setattr(many, "CONNECT_SECONDS", 1)
    listener, address = silent()
    with (
        listener,
        pytest.raises(ClusterError, match=f"no scheduler answers at {address}"),
        many.existing_cluster(address),
    ):
        pass
    (tmp_path / "list.txt").write_text("capture\n")
    command = ["build-many", str(tmp_path / "list.txt"), "-o", str(tmp_path / "out"), "--cluster", "bogus://here"]
    result = CliRunner().invoke(app, command)
    assert isinstance(result.exception, ClusterError) and "bogus://here" in str(result.exception)
    assert CliRunner().invoke(app, [*command, "--workers", "2"]).exit_code == 2


def test_a_scheduler_without_workers_is_one_clear_error(monkeypatch):
    monkeypatch.setattr(many, "CONNECT_SECONDS", 1)
    with (
        LocalCluster(n_workers=0, **INSIDE) as empty,
        pytest.raises(ClusterError, match="has no worker"),
        many.existing_cluster(empty.scheduler_address),
    ):
        pass


def test_workers_of_another_version_are_refused(here, monkeypatch):
    monkeypatch.setattr(many, "_look", lambda folder: ("0.0.1", True))
    with many.existing_cluster(here) as client, pytest.raises(ClusterError, match=r"runs jawusd 0\.0\.1"):
        many.check_workers(client, ROOT)


def test_without_dask_the_command_names_its_extra():
    code = "import sys; sys.modules['distributed'] = None; sys.argv[1:] = ['build-many', 'x', '-o', 'y']\n"
    code += "from jawusd.cli.main import main; main()"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert result.returncode == 4 and "jawusd[many]" in result.stderr and "Traceback" not in result.stderr
