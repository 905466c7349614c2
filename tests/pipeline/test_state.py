"""The record of finished stages, and the lock of the output folder."""

import errno
import fcntl
import json
import os
import signal
import subprocess
import sys

import pytest

from jawusd.base.errors import FormatError, OutputError
from jawusd.formats.notes import SyncNotes
from jawusd.pipeline.report import CheckResult
from jawusd.pipeline.state import BUILD_FILE, LABELS, BuildState, changed_files, hash_files, hash_value, locked


def finished(folder):
    state = BuildState(folder)
    (folder / "a.bin").write_bytes(b"one")
    state.finish("track", "inputs", [folder / "a.bin"], 1.5, {"lost": [3]})
    return state


def test_a_finished_stage_is_valid_again_later(tmp_path):
    finished(tmp_path)
    record = BuildState(tmp_path).valid("track", "inputs")
    assert record.result == {"lost": [3]} and record.seconds == 1.5


@pytest.mark.parametrize("damage", ["inputs", "content", "missing"])
def test_a_change_of_inputs_or_of_the_files_makes_a_stage_stale(tmp_path, damage):
    finished(tmp_path)
    if damage == "content":
        (tmp_path / "a.bin").write_bytes(b"two")
    if damage == "missing":
        (tmp_path / "a.bin").unlink()
    assert BuildState(tmp_path).valid("track", "other" if damage == "inputs" else "inputs") is None


def test_hashes_see_content_and_names_not_order_of_keys(tmp_path):
    (tmp_path / "a").write_bytes(b"1")
    (tmp_path / "b").write_bytes(b"1")
    assert hash_files([tmp_path / "a"]) != hash_files([tmp_path / "b"])
    assert hash_value({"a": 1, "b": 2}) == hash_value({"b": 2, "a": 1}) != hash_value({"a": 1, "b": 3})


def test_clear_deletes_only_what_builds_wrote(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    state = finished(folder)
    (folder / "mine.txt").write_text("keep")
    (tmp_path / "outside").write_text("keep")
    # A damaged or hostile record must not refer to files outside the folder.
    state.stages["track"].outputs["../outside"] = "x"
    state.clear()
    assert sorted(os.listdir(folder)) == ["mine.txt"] and (tmp_path / "outside").exists()


@pytest.mark.parametrize(
    "text", ["", "[]", '{"format": "jawusd-build/1"}', '{"format": "jawusd-build/9", "stages": {}}']
)
def test_a_damaged_record_is_one_clear_error(tmp_path, text):
    (tmp_path / BUILD_FILE).write_text(text)
    with pytest.raises(FormatError, match=BUILD_FILE):
        BuildState(tmp_path)


def test_build_json_is_readable_by_others(tmp_path):
    finished(tmp_path)
    data = json.loads((tmp_path / BUILD_FILE).read_text())
    assert data["format"] == "jawusd-build/1" and set(data["stages"]["track"]["outputs"]) == {"a.bin"}


HOLD = "import sys,time,pathlib; from jawusd.pipeline.state import locked\n" \
    "with locked(pathlib.Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"  # fmt: skip


def test_two_builds_on_one_folder_the_second_refuses_until_the_first_dies(tmp_path):
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout.readline().strip() == "held"
        with pytest.raises(OutputError, match="another jawusd build"), locked(tmp_path):
            pass
    finally:
        holder.send_signal(signal.SIGKILL)
        holder.wait()
        holder.stdout.close()
    with locked(tmp_path):
        pass


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL, errno.EIO])
def test_a_file_system_without_locks_is_a_warning(tmp_path, monkeypatch, caplog, number):
    def none(*_):
        raise OSError(number, os.strerror(number))

    (tmp_path / ".jawusd-tmp-of-another").write_text("x")
    monkeypatch.setattr(fcntl, "flock", none)
    with locked(tmp_path):
        # another build may be running: unfinished files may belong to it
        assert (tmp_path / ".jawusd-tmp-of-another").exists()
    assert "the file system has no locks" in caplog.text and os.strerror(number) in caplog.text


@pytest.mark.parametrize("name", [".jawusd-lock", LABELS])
def test_links_out_of_the_folder_are_not_followed(tmp_path, name):
    folder, outside = tmp_path / "out", tmp_path / "outside"
    folder.mkdir()
    (folder / name).symlink_to(outside)
    with pytest.raises(OutputError, match="is a (symbolic )?link"), locked(folder):
        pass
    assert not outside.exists()


def forged(folder, change):
    """Modify build.json, with a matching hash."""
    path = folder / BUILD_FILE
    data = json.loads(path.read_text())
    change(data["stages"])
    data["sha256"] = hash_value(data["stages"])
    path.write_text(json.dumps(data))


def nested(levels):
    value = []
    for _ in range(levels):
        value = [value]
    return value


RECORDS = {
    "outputs a list": lambda stages: stages["track"].update(outputs=["a.bin"]),
    "outputs of numbers": lambda stages: stages["track"].update(outputs={"a.bin": 3}),
    "outputs elsewhere": lambda stages: stages["track"].update(outputs={"../a.bin": "0" * 64}),
    "outputs from the root": lambda stages: stages["track"].update(outputs={"/etc/passwd": "0" * 64}),
    "no outputs": lambda stages: stages["track"].pop("outputs"),
    "a stage as text": lambda stages: stages.update(track="done"),
    "seconds as text": lambda stages: stages["track"].update(seconds="long"),
    "seconds huge": lambda stages: stages["track"].update(seconds=10**400),
    "seconds infinite": lambda stages: stages["track"].update(seconds=float("inf")),
    "inputs a list": lambda stages: stages["track"].update(inputs=[]),
    "result a list": lambda stages: stages["track"].update(result=[1]),
}


@pytest.mark.parametrize("name", RECORDS)
def test_a_forged_record_is_one_clear_error(tmp_path, name):
    finished(tmp_path)
    forged(tmp_path, RECORDS[name])
    with pytest.raises(FormatError, match="is damaged"):
        BuildState(tmp_path)
    assert [found.kind for found in changed_files(tmp_path)] == ["build_changed"]


def test_a_record_nested_beyond_reason_is_one_clear_error(tmp_path):
    finished(tmp_path)
    text = (tmp_path / BUILD_FILE).read_text()
    (tmp_path / BUILD_FILE).write_text(text.replace("[\n", "[" * 50_000, 1).replace("3\n", "]" * 50_000 + "3\n", 1))
    with pytest.raises(FormatError, match=BUILD_FILE):
        BuildState(tmp_path)


@pytest.mark.parametrize(
    "offsets", ["2", ["a"], {"cam": "soon"}, {"cam": 10**400}, {"cam": 1.5}, {"cam": float("nan")}, None, nested(200)]
)
def test_forged_results_are_one_clear_error(tmp_path, offsets):
    state = BuildState(tmp_path)
    state.finish("sync", "", [], 1.0, {"offsets": offsets, "method": "given"})
    with pytest.raises(FormatError, match=r"is damaged \(sync\.offsets"):
        BuildState(tmp_path).result("sync", SyncNotes)


@pytest.mark.parametrize("found", [{"frame": float("inf")}, {"frame": "x"}, {"value": "x"}, "text", {"kind": []}])
def test_forged_findings_are_one_clear_error(tmp_path, found):
    BuildState(tmp_path).finish("check", "", [], 1.0, {"findings": [found]})
    with pytest.raises(FormatError, match=r"is damaged \(check\.findings"):
        BuildState(tmp_path).result("check", CheckResult)


@pytest.mark.parametrize("damage", ["content", "missing", "cut", "folder", "pipe"])
def test_files_that_are_not_what_the_build_wrote_are_named(tmp_path, damage):
    state = finished(tmp_path)
    assert state.changed() == [] and changed_files(tmp_path) == []
    path = tmp_path / "a.bin"
    if damage in ("missing", "folder", "pipe"):
        path.unlink()
    if damage == "folder":
        path.mkdir()
    elif damage == "pipe":
        os.mkfifo(path)
    elif damage != "missing":
        path.write_bytes(b"two" if damage == "content" else b"o")
    (found,) = changed_files(tmp_path)
    gone = damage in ("missing", "folder", "pipe")
    message = "is missing, although the build wrote it" if gone else "replaced after the build"
    assert (found.severity, found.path) == ("error", "a.bin") and message in found.message
