"""The record of finished stages, and the lock of the output folder."""

import json
import os
import signal
import subprocess
import sys

import pytest

from jawusd.errors import FormatError, OutputError
from jawusd.pipeline.state import BUILD_FILE, BuildState, hash_files, hash_value, locked


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
    # A damaged or hostile record must not reach out of the folder.
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
