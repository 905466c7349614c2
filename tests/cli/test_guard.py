"""The process that guards a command: how commands end, what is passed on, and memory limits."""

import contextlib
import os
import pty
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import jawusd
from jawusd.base import guard
from jawusd.base.errors import ResourceError

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="signals and limits of Linux")
BEGIN = "import os, resource, signal, sys, time; from jawusd.base import guard; guard.run_in_child(); "


def guarded(code, *words, **settings):
    """Run code in a guarded process."""
    line = [sys.executable, "-c", BEGIN + code, *words]
    environment = {**os.environ, **settings.pop("env", {})}
    return subprocess.run(line, capture_output=True, text=True, check=False, timeout=60, env=environment, **settings)


@contextlib.contextmanager
def started(code):
    """Start code in a guarded process; yield it and the process id of the child, which the code prints."""
    line = [sys.executable, "-c", BEGIN + "print(os.getpid(), flush=True); " + code]
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        yield process, int(process.stdout.readline())


@pytest.mark.parametrize("name", ["SIGSEGV", "SIGBUS", "SIGABRT", "SIGILL", "SIGFPE"])
def test_a_crash_is_one_message_with_the_current_file(name):
    code = f"guard.note_input(sys.argv[1]); os.kill(os.getpid(), signal.{name})"
    done = guarded(code, "/captures/a\udcff/cam\n0.png")
    assert done.returncode == ResourceError.exit_code
    assert done.stderr.startswith("jawusd: /captures/a\\xff/cam\\n0.png: a library crashed") and name in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_crash_without_a_file_names_the_command():
    assert "jawusd view 'my actor': a library crashed" in guarded("os.abort()", "view", "my actor").stderr


def test_memory_is_limited_and_its_end_is_one_message(tmp_path):
    code = "from jawusd.cli import main as m; m.app = lambda: bytearray(10**9); m.main()"
    done = guarded(code, "info", env={guard.SETTING: "0.5"})
    assert done.returncode == ResourceError.exit_code and done.stderr.count("\n") == 1
    assert "jawusd info: needs more memory than jawusd may use here, 0.5 GB." in done.stderr
    assert guarded(code, env={guard.SETTING: "0"}).returncode == 0


def test_address_space_that_is_only_reserved_is_free():
    code = "import mmap; mmap.mmap(-1, 4 * 10**9, prot=0); mmap.mmap(-1, 4 * 10**9, flags=mmap.MAP_SHARED)"
    assert guarded(code, env={guard.SETTING: "0.5"}).returncode == 0


def test_the_limit_is_a_share_of_the_machine_that_can_be_set(monkeypatch):
    monkeypatch.delenv(guard.SETTING, raising=False)
    monkeypatch.setattr(guard, "machine_memory", lambda: 32 * 10**9)
    assert guard.memory_limit() == 24 * 10**9
    monkeypatch.setattr(guard, "machine_memory", lambda: 10**9)
    assert guard.memory_limit() == 4 * 10**9
    for wrong in ("much", "-1", "nan"):
        monkeypatch.setenv(guard.SETTING, wrong)
        with pytest.raises(ResourceError, match="must be a number of GB"):
            guard.memory_limit()
        assert guarded("", env={guard.SETTING: wrong}).stderr.startswith("jawusd: JAWUSD_MEMORY_GB is")


@pytest.mark.parametrize("most_mb", [60, 300, 900])
def test_too_little_address_space_is_one_message(most_mb):
    """Without memory, libraries crash, or report good files as damaged."""
    limited = f"import resource; resource.setrlimit(resource.RLIMIT_AS, ({most_mb} << 20,) * 2); "
    line = [sys.executable, "-c", limited + "from jawusd.__main__ import main; main()", "check", "capture.toml"]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert done.returncode == ResourceError.exit_code and done.stderr.count("\n") == 1
    assert "(ulimit -v); at least 1.5 GB is needed" in done.stderr


def test_no_core_files_are_left():
    assert guarded("print(resource.getrlimit(resource.RLIMIT_CORE)[0])").stdout == "0\n"


def test_too_much_processor_time_is_one_message():
    code = "guard.note_input('/rigs/bomb.usda')\nwith guard.most_cpu(1):\n    while True: pass"
    done = subprocess.run([sys.executable, "-c", BEGIN + "\n" + code], capture_output=True, text=True, check=False)
    assert done.returncode == ResourceError.exit_code
    assert done.stderr.startswith("jawusd: /rigs/bomb.usda: takes too much processor time")
    after = "\nwith guard.most_cpu(1): pass\nprint(resource.getrlimit(resource.RLIMIT_CPU)[0])"
    done = subprocess.run([sys.executable, "-c", BEGIN + after], capture_output=True, text=True, check=False)
    assert int(done.stdout) == resource.getrlimit(resource.RLIMIT_CPU)[0]


def test_exit_codes_streams_and_signal_masks_pass_through():
    done = guarded("print(sys.stdin.read(), signal.pthread_sigmask(0, ())); sys.exit(7)", input="x")
    assert (done.returncode, done.stdout, done.stderr) == (7, "x set()\n", "")


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1"])
def test_signals_pass_through_to_handlers(name):
    code = f"signal.signal(signal.{name}, lambda *_: sys.exit(5)); print(flush=True); time.sleep(60)"
    with started(code) as (process, _):
        process.stdout.readline()
        process.send_signal(getattr(signal, name))
        assert process.wait(30) == 5 and process.stderr.read() == ""


def test_a_command_that_a_signal_ends_ends_by_that_signal():
    with started("time.sleep(60)") as (process, _):
        process.terminate()
        assert process.wait(30) == -signal.SIGTERM and process.stderr.read() == ""


def test_no_child_outlives_the_guard():
    with started("time.sleep(60)") as (process, child):
        process.kill()
    for _ in range(500):
        if not Path(f"/proc/{child}").exists() or ") Z" in Path(f"/proc/{child}/stat").read_text():
            return
        time.sleep(0.01)
    pytest.fail("it still runs")


SHELL = """
import os, signal, subprocess, sys
signal.signal(signal.SIGTTOU, signal.SIG_IGN)
job = subprocess.Popen([sys.executable, "-c", sys.argv[1]], process_group=0)
os.tcsetpgrp(0, job.pid)
while True:
    _, status = os.waitpid(job.pid, os.WUNTRACED)
    if not os.WIFSTOPPED(status):
        break
    print("stopped", os.WSTOPSIG(status), flush=True)
    os.killpg(job.pid, signal.SIGCONT)
print("status", os.waitstatus_to_exitcode(status), flush=True)
"""


@pytest.mark.skipif(sys.version_info < (3, 11), reason="process groups of subprocess")
def test_keys_of_a_terminal_reach_the_command_once():
    """Ctrl+Z stops the whole job, fg continues it, Ctrl+C interrupts once, and the command has the terminal."""
    code = BEGIN + "seen = []\nsignal.signal(signal.SIGINT, lambda *_: seen.append(1))\n"
    code += "print('ready', sys.stderr.isatty(), flush=True)\n"
    code += "while not seen: time.sleep(.05)\ntime.sleep(.5); sys.exit(40 + len(seen))"
    shell, terminal = pty.fork()
    if shell == 0:
        os.execv(sys.executable, [sys.executable, "-c", SHELL, code])
    text = ""
    for key, wanted in ((b"", "ready True"), (b"\x1a", "stopped"), (b"\x03", "status 41")):
        os.write(terminal, key)
        with contextlib.suppress(OSError):  # the terminal was closed
            while wanted not in text:
                text += os.read(terminal, 1000).decode()
        assert wanted in text
    os.waitpid(shell, 0)


def test_without_fork_a_second_python_is_the_child(tmp_path):
    (tmp_path / "sitecustomize.py").write_text("import os; del os.fork")
    path = os.pathsep.join([str(tmp_path), str(Path(jawusd.__file__).parents[1])])
    line = [sys.executable, "-m", "jawusd", "info", str(tmp_path / "none.usda")]
    done = subprocess.run(line, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": path})
    assert done.returncode == 8 and done.stderr.endswith("none.usda: there is no such file.\n")
    (tmp_path / "sitecustomize.py").write_text(
        "import os; del os.fork\nif '_JAWUSD_CHILD' in os.environ: os.kill(os.getpid(), 11)"
    )
    done = subprocess.run(line, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": path})
    assert done.returncode == ResourceError.exit_code and "none.usda: a library crashed" in done.stderr
