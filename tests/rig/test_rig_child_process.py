"""What OpenUSD ends or hangs on ends a child process; whole rigs cost a child once."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from jawusd.errors import RigError
from jawusd.formats.allowed_folders import SETTING
from jawusd.rig import child_limits, child_process, load_rig
from jawusd.rig.child_limits import End
from jawusd.rig.read import open_stage
from jawusd.rig.reader_process import ReaderProcess

HEADER = "#usda 1.0\n"


def doubling(levels):
    """Return the text of a layer of few lines whose stage has 2^levels prims."""
    twice = 'def "L%d" {\ndef "a" (references = </L%d>) {}\ndef "b" (references = </L%d>) {}\n}\n'
    return HEADER + 'def "L0" {}\n' + "".join(twice % (i + 1, i, i) for i in range(levels))


@pytest.fixture(autouse=True)
def reader(monkeypatch):
    """Return the second Python of this test alone, which is not started yet."""
    own = ReaderProcess()
    monkeypatch.setattr(child_process, "_reader", own)
    yield own
    own.close()


@pytest.fixture
def children(reader, monkeypatch):
    """Return the paths that children were asked to read."""
    asked = []
    for where, name in ((child_process, "_copied"), (reader, "read")):
        real = getattr(where, name)
        monkeypatch.setattr(where, name, lambda path, memory, real=real: asked.append(path) or real(path, memory))
    return asked


@pytest.fixture
def forks(anchored_folder, reader, monkeypatch):
    """Let copies be made at any time: on a busy machine, threads may take long to fall asleep."""
    reader.close()  # which baking has started, if this test is the first to bake
    monkeypatch.setattr(child_process, "_can_fork", lambda: sys.platform == "linux")


@pytest.fixture
def no_reader(reader, monkeypatch):
    """Let no second Python be had."""
    monkeypatch.setattr(reader, "read", lambda path, memory: None)


@pytest.fixture
def bomb(tmp_path):
    path = tmp_path / "shot.usda"
    path.write_text(doubling(28))
    return path


def in_thread(function):
    """Return what a function raises in a program of several threads, which is not forked."""
    caught, done = [], threading.Event()
    other = threading.Thread(target=done.wait)
    other.start()
    try:
        function()
    except RigError as error:
        caught.append(error)
    finally:
        done.set()
        other.join()
    return caught


def test_stages_that_take_for_ever_are_one_message(bomb, forks, monkeypatch):
    monkeypatch.setattr(child_limits, "MOST_CPU_S", 1)
    with pytest.raises(RigError, match="takes OpenUSD more than"):
        open_stage(bomb)


@pytest.mark.slow
def test_stages_that_take_all_memory_are_one_message(bomb, forks, no_reader, monkeypatch):
    """Whatever memory the tests before have freed, which the copy uses up before it needs more: hence the time."""
    monkeypatch.setattr(child_limits, "MOST_MEMORY", 150 << 20)
    monkeypatch.setattr(child_limits, "MOST_CPU_S", 600)
    monkeypatch.setattr(child_limits, "MOST_WAIT_S", 600)
    with pytest.raises(RigError, match="GB to be read|ends OpenUSD"):
        open_stage(bomb)


@pytest.mark.parametrize("way", [signal.SIGSEGV, signal.SIGABRT])
def test_crashes_are_one_message(way, anchored_folder, forks, no_reader, monkeypatch):
    monkeypatch.setattr(child_limits, "open_checked", lambda path: os.kill(os.getpid(), way))
    with pytest.raises(RigError, match="ends OpenUSD"):
        open_stage(anchored_folder / "actor.usda")


def test_a_crash_of_a_copy_is_asked_again_of_a_new_process(anchored_folder, forks, monkeypatch, children):
    """The copy may have crashed for the state of this process; the file is whole."""
    monkeypatch.setattr(child_limits, "open_checked", lambda path: os.kill(os.getpid(), signal.SIGSEGV))
    assert open_stage(anchored_folder / "actor.usda")
    assert len(children) == 2


@pytest.mark.skipif(sys.platform != "linux", reason="forks are for Linux")
def test_a_crash_is_one_message_where_the_second_python_is_gone(anchored_folder, forks, no_reader, reader, monkeypatch):
    monkeypatch.setattr(reader, "runs", lambda: True)
    monkeypatch.setattr(child_limits, "open_checked", lambda path: os.kill(os.getpid(), signal.SIGSEGV))
    with pytest.raises(RigError, match="ends OpenUSD"):
        open_stage(anchored_folder / "actor.usda")


@pytest.mark.skipif(sys.platform != "linux", reason="forks are for Linux")
def test_a_copy_that_waits_for_ever_is_left_soon(anchored_folder, forks, monkeypatch, children):
    """As one does that was made while another thread held a lock of OpenUSD."""
    monkeypatch.setattr(child_process, "_MOST_SLEEP_S", 1)
    monkeypatch.setattr(child_limits, "open_checked", lambda path: time.sleep(1000))
    assert open_stage(anchored_folder / "actor.usda")
    assert len(children) == 2


@pytest.mark.skipif(sys.platform != "linux", reason="forks are for Linux")
def test_no_copy_is_made_while_another_thread_works(monkeypatch):
    cases = (
        (1, [], "R", True),
        (1, [1, 2], "S", True),
        (1, [1], "R", False),
        (1, [1], "D", False),
        (2, [1], "S", False),  # a thread of Python may sleep anywhere
    )
    for of_python, others, state, allowed in cases:
        monkeypatch.setattr(child_process.threading, "active_count", lambda count=of_python: count)
        monkeypatch.setattr(child_process, "_other_threads", lambda others=others: others)
        monkeypatch.setattr(child_process, "_state_and_time", lambda process, state=state: (state, 0))
        assert child_process._can_fork() is allowed


@pytest.mark.slow
def test_programs_of_several_threads_start_a_second_python(anchored_folder, bomb, children, monkeypatch):
    def opened():
        load_rig(anchored_folder / "actor.usda")
        open_stage(bomb)

    monkeypatch.setattr(child_limits, "MOST_WAIT_S", 4)
    monkeypatch.setattr(child_process, "_copied", lambda path, memory: pytest.fail("this process has several threads"))
    (error,) = in_thread(opened)
    assert "takes OpenUSD more than" in str(error) and len(children) == 2


def test_a_second_python_reads_one_stage_after_the_other(anchored_folder, reader):
    actor = anchored_folder / "actor.usda"
    assert reader.read(actor, child_limits.MOST_MEMORY) is End.WHOLE
    first = reader._process
    assert reader.read(actor, child_limits.MOST_MEMORY) is End.WHOLE and reader._process is first
    first.kill()  # as a stage that it had read before may have left it
    assert reader.read(actor, child_limits.MOST_MEMORY) is End.WHOLE and reader._process is not first
    reader._owner += 1  # as in a fork of this process, which would read answers to other questions
    assert not reader.runs()
    reader._owner -= 1


def test_a_stage_that_ends_the_second_python_is_one_message(bomb, reader, monkeypatch):
    def end():
        while not reader._has_read:
            time.sleep(0.01)
        os.kill(reader._process.pid, signal.SIGSEGV)

    monkeypatch.setattr(child_process, "_can_fork", lambda: False)
    other = threading.Thread(target=end)
    other.start()
    with pytest.raises(RigError, match="ends OpenUSD"):
        open_stage(bomb)
    other.join()
    assert not reader.runs()


@pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")
def test_a_second_python_writes_no_files_and_has_no_network(anchored_folder, reader):
    import resource

    assert reader.read(anchored_folder / "actor.usda", child_limits.MOST_MEMORY) is End.WHOLE
    process = reader._process.pid
    for kind in (resource.RLIMIT_FSIZE, resource.RLIMIT_CORE):
        assert resource.prlimit(process, kind)[0] == 0
    assert resource.prlimit(process, resource.RLIMIT_CPU)[0] < 60
    alone = subprocess.run(["unshare", "--user", "--net", "true"], capture_output=True, check=False)
    if alone.returncode == 0:  # the system lets users do so
        assert os.readlink(f"/proc/{process}/ns/net") != os.readlink("/proc/self/ns/net")


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_second_python_ends_with_the_program(anchored_folder):
    program = (
        "import os, sys, pathlib; from jawusd.rig.reader_process import ReaderProcess; reader = ReaderProcess(); "
        "reader.read(pathlib.Path(sys.argv[1]), 1 << 30); print(reader._process.pid, flush=True); os._exit(9)"
    )
    line = [sys.executable, "-c", program, str(anchored_folder / "actor.usda")]
    found = subprocess.run(line, capture_output=True, text=True, check=False)
    assert found.returncode == 9
    place = Path(f"/proc/{int(found.stdout)}/stat")
    for _ in range(1000):
        if not place.exists() or ") Z" in place.read_text():
            return
        time.sleep(0.01)
    pytest.fail("it still runs")


@pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")
def test_a_stage_too_large_for_what_this_process_has_left_is_one_message(tmp_path):
    """A second Python that was started before may use more than the program that asks it, which would be ended."""
    program = (
        "import resource, sys; from jawusd.errors import RigError; from jawusd.rig import child_limits, child_process\n"
        "from jawusd.rig.read import open_stage\n"
        "child_process._reader._process = child_process._reader._started(); open_stage(sys.argv[1])\n"
        "most = child_limits._used_memory() + (8 << 20); resource.setrlimit(resource.RLIMIT_CORE, (0, 0))\n"
        "resource.setrlimit(resource.RLIMIT_AS, (most, most)); open_stage(sys.argv[1])\n"
        "try: open_stage(sys.argv[2])\nexcept RigError as error: print(error)"
    )
    for levels in (1, 13):
        (tmp_path / f"{levels}.usda").write_text(doubling(levels))
    line = [sys.executable, "-c", program, str(tmp_path / "1.usda"), str(tmp_path / "13.usda")]
    found = subprocess.run(line, capture_output=True, text=True, check=False, timeout=60)
    assert found.returncode == 0 and "13.usda: cannot be read with " in found.stdout


def test_a_rig_costs_a_child_once(anchored_folder, forks, children):
    actor = anchored_folder / "actor.usda"
    for _ in range(3):
        load_rig(actor)
    assert children == [actor]
    os.utime(anchored_folder / "geo.usdc", ns=(1, 1))
    load_rig(actor)
    assert children == [actor, actor]


@pytest.mark.skipif(sys.platform != "linux", reason="forks are for Linux")
def test_a_child_that_was_begun_is_the_one_that_is_waited_for(anchored_folder, bomb, forks, children, monkeypatch):
    actor = anchored_folder / "actor.usda"
    child_process.begin_in_child(actor)
    load_rig(actor)
    child_process.begin_in_child(actor)  # which is known by now
    assert children == [actor]
    monkeypatch.setattr(child_limits, "MOST_CPU_S", 1)
    child_process.begin_in_child(bomb)
    with pytest.raises(RigError, match="takes OpenUSD more than"):
        open_stage(bomb)
    assert children[:2] == [actor, bomb] and not child_process._begun


@pytest.mark.skipif(sys.platform != "linux", reason="forks are for Linux")
def test_no_child_is_begun_with_limited_memory_or_in_allowed_folders(anchored_folder, forks, children, monkeypatch):
    actor = anchored_folder / "actor.usda"
    with monkeypatch.context() as limited:
        limited.setattr(child_process, "memory_of_child", lambda: child_limits.MOST_MEMORY - 1)
        child_process.begin_in_child(actor)
    monkeypatch.setenv(SETTING, str(anchored_folder))
    child_process.begin_in_child(actor)
    assert children == []


@pytest.mark.skipif(sys.platform != "linux", reason="forks are for Linux")
def test_children_that_nobody_waited_for_end_with_the_program(bomb):
    program = (
        "import sys, pathlib; from jawusd.rig import child_process; child_process._can_fork = lambda: True\n"
        "child_process.begin_in_child(pathlib.Path(sys.argv[1])); "
        "print([copy.child for copy in child_process._begun.values()])"
    )
    found = subprocess.run([sys.executable, "-c", program, str(bomb)], capture_output=True, text=True, check=True)
    (child,) = json.loads(found.stdout)
    assert not Path(f"/proc/{child}").exists()


def test_allowed_folders_are_read_without_a_child(anchored_folder, children, monkeypatch):
    monkeypatch.setenv(SETTING, str(anchored_folder))
    assert load_rig(anchored_folder / "actor.usda")
    assert children == []


@pytest.mark.slow
def test_new_processes_know_the_folders_that_were_allowed(anchored_folder, tmp_path, monkeypatch):
    """What the child refuses, it does not read."""
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "more.usda").write_text(doubling(28))
    (anchored_folder / "shot.usda").write_text(f"{HEADER}( subLayers = [@../elsewhere/more.usda@] )\n")
    monkeypatch.setattr(child_limits, "MOST_WAIT_S", 4)
    monkeypatch.setenv(SETTING, str(tmp_path / "elsewhere"))
    assert "takes OpenUSD" in str(in_thread(lambda: open_stage(anchored_folder / "shot.usda"))[0])


@pytest.mark.parametrize("program", ["/opt/maya/bin/maya.bin", "/nowhere/python3", None])
def test_programs_that_python_is_part_of_read_without_a_child(program, anchored_folder, monkeypatch):
    monkeypatch.setattr(sys, "executable", program)
    assert in_thread(lambda: load_rig(anchored_folder / "actor.usda")) == []


@pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")
def test_a_child_writes_no_files_and_leaves_no_core(anchored_folder, forks, tmp_path, monkeypatch):
    def write(path):
        (tmp_path / "written").write_text("x")

    monkeypatch.setattr(child_limits, "open_checked", write)
    child_process.try_in_child(anchored_folder / "actor.usda")
    assert not (tmp_path / "written").exists() or (tmp_path / "written").stat().st_size == 0
