"""Outputs may replace only files, and links within their folder; pipes and devices are written to."""

import ast
import os
import stat
import subprocess
import sys
import threading
from contextlib import suppress

import numpy as np
import pytest
from package_copy import ROOT

from jawusd.base.errors import OutputError
from jawusd.formats.atomic import refuse_existing, write_bytes_atomic, write_npz_atomic, write_text_atomic
from jawusd.media.writers import VideoWriter
from jawusd.report.style import new_figure, save_figure
from jawusd.rig.layers import new_layer, write_layer


def write_video(path):
    with VideoWriter(path, (64, 48), 24.0, lossless=True) as writer:
        writer.write(np.zeros((48, 64), np.uint8))


#: One writer of every kind, with its suffix.
WRITERS = {
    ".bin": lambda path: write_bytes_atomic(path, b"new"),
    ".html": lambda path: write_text_atomic(path, "<p>new</p>"),
    ".npz": lambda path: write_npz_atomic(path, {"a": np.zeros(3)}),
    ".usdc": lambda path: write_layer(new_layer(), path),
    ".usda": lambda path: write_layer(new_layer(), path),
    ".mkv": write_video,
}
every_writer = pytest.mark.parametrize("suffix", WRITERS)


@every_writer
def test_a_link_out_of_its_folder_is_refused_and_stays(tmp_path, suffix):
    outside, folder = tmp_path / f"outside{suffix}", tmp_path / "folder"
    folder.mkdir()
    outside.write_bytes(b"mine")
    link = folder / f"out{suffix}"
    link.symlink_to(outside)
    with pytest.raises(OutputError, match="link that leads out of its folder"):
        WRITERS[suffix](link)
    assert link.is_symlink() and outside.read_bytes() == b"mine" and os.listdir(folder) == [link.name]


@every_writer
@pytest.mark.parametrize("dangles", [False, True])
def test_a_link_within_its_folder_is_followed_and_stays(tmp_path, suffix, dangles):
    real, link = tmp_path / f"real{suffix}", tmp_path / f"out{suffix}"
    link.symlink_to(real.name)
    if not dangles:
        real.write_bytes(b"old")
    WRITERS[suffix](link)
    assert link.is_symlink() and real.is_file() and not real.is_symlink() and real.read_bytes() != b"old"


@every_writer
def test_a_pipe_gets_the_whole_content_and_stays(tmp_path, suffix):
    pipe, plain = tmp_path / f"out{suffix}", tmp_path / f"plain{suffix}"
    os.mkfifo(pipe)
    reader = subprocess.Popen(["cat", str(pipe)], stdout=subprocess.PIPE)
    held = None  # the reader gets everything before the end
    while held is None and reader.poll() is None:
        with suppress(OSError):  # until the reader has opened it
            held = os.open(pipe, os.O_WRONLY | os.O_NONBLOCK)
        threading.Event().wait(0.01)
    WRITERS[suffix](pipe)
    os.close(held)
    got, _ = reader.communicate(timeout=60)
    WRITERS[suffix](plain)
    assert len(got) == plain.stat().st_size and got[:16] == plain.read_bytes()[:16]  # encodes of a video differ
    assert stat.S_ISFIFO(pipe.lstat().st_mode)
    assert {path.name for path in tmp_path.iterdir()} == {pipe.name, plain.name}


@every_writer
def test_a_pipe_that_no_program_reads_is_refused_instead_of_waited_for(tmp_path, suffix):
    pipe = tmp_path / f"out{suffix}"
    os.mkfifo(pipe)
    with pytest.raises(OutputError, match="no program reads this pipe"):
        WRITERS[suffix](pipe)
    assert stat.S_ISFIFO(pipe.lstat().st_mode)


@every_writer
def test_a_device_is_written_to_and_stays(tmp_path, suffix):
    device = tmp_path / f"null{suffix}"
    try:
        os.mknod(device, stat.S_IFCHR | 0o666, os.makedev(1, 3))
        device.write_bytes(b"x")
    except PermissionError:
        pytest.skip("devices cannot be made here")
    WRITERS[suffix](device)
    assert stat.S_ISCHR(device.lstat().st_mode)


@every_writer
@pytest.mark.parametrize("kind", ["folder", "disk"])
def test_folders_and_disks_are_refused_before_any_work(tmp_path, suffix, kind):
    there = tmp_path / f"out{suffix}"
    if kind == "folder":
        there.mkdir()
    else:
        try:
            os.mknod(there, stat.S_IFBLK | 0o600, os.makedev(240, 200))
        except PermissionError:
            pytest.skip("devices cannot be made here")
    with pytest.raises(OutputError, match="not replaced by a file"):
        refuse_existing(there, force=True)
    with pytest.raises(OutputError, match="not replaced by a file"):
        WRITERS[suffix](there)


def test_a_dangling_link_needs_force_and_a_device_does_not(tmp_path):
    link = tmp_path / "out.csv"
    link.symlink_to("nothing.csv")
    with pytest.raises(OutputError, match="exists already"):
        refuse_existing(link, force=False)
    refuse_existing(link, force=True)
    refuse_existing(tmp_path / "null" if os.name == "nt" else type(link)("/dev/null"), force=False)


def test_the_longest_name_a_file_system_allows_can_be_written(tmp_path):
    for name in ("n" * 251 + ".csv", "n." + "s" * 253, "\U0001f9b7" * 63):
        write_text_atomic(tmp_path / name, "x")
        assert (tmp_path / name).read_text() == "x"
    with pytest.raises(OutputError, match="name too long"):
        write_text_atomic(tmp_path / ("n" * 256), "x")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="bytes that are no text make no names here")
def test_names_of_any_bytes_can_be_written_and_texts_that_would_name_them_say_so(tmp_path):
    name = os.fsdecode(b"\xff\xfe.csv")
    write_text_atomic(tmp_path / name, "x")
    assert os.listdir(os.fsencode(tmp_path)) == [b"\xff\xfe.csv"]
    with pytest.raises(OutputError, match=r"would contain a name that is not UTF-8: .*\\xff\\xfe"):
        write_text_atomic(tmp_path / "list.csv", f"path\n{name}\n")


def test_standard_output_is_written_to_also_where_it_is_a_file(tmp_path):
    program = "from jawusd.formats.atomic import *; write_text_atomic('/dev/stdout', 'content')"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with open(tmp_path / "there.txt", "wb") as there:
        there.write(b"before ")
        there.flush()
        subprocess.run([sys.executable, "-c", program], stdout=there, check=True, env=environment)
    assert (tmp_path / "there.txt").read_text() == "before content"
    piped = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, check=True, env=environment)
    assert piped.stdout == b"content" and os.path.islink("/dev/stdout")


def test_a_file_system_without_modes_and_fsync_is_written_to(tmp_path, monkeypatch):
    def cannot(*arguments):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(os, "fsync", cannot)
    monkeypatch.setattr(os, "chmod", cannot)
    write_text_atomic(tmp_path / "a.txt", "x")
    assert (tmp_path / "a.txt").read_text() == "x"


def writes(source):
    """Return whether a module opens files for writing, writes whole ones, or moves them."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            modes = [a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
            if name.split(".")[-1] == "open" and any(mode[:1] in ("w", "a", "x") and len(mode) <= 3 for mode in modes):
                return True
            if name in ("os.replace", "os.rename", "shutil.move") or name.endswith((".write_text", ".write_bytes")):
                return True
    return False


@pytest.mark.parametrize("line", ["open(p, 'w')", "io.open(p, 'ab')", "os.replace(a, b)", "path.write_text(t)"])
def test_writing_is_found(line):
    assert writes(line) and not writes("open(p, 'rb'); row['w'].replace('a', 'w')")


def test_no_other_place_of_the_package_replaces_or_makes_files():
    """All outputs go through `formats.atomic`; exceptions are listed here with their reasons."""
    allowed = {
        "jawusd/cli/output.py",  # adds lines to a log that `destination` allows
        "jawusd/pipeline/segment_record.py",  # adds lines to its own record
        "jawusd/viewer/motion_panel.py",  # in its own folder, as is the next one
        "jawusd/plugins/extension.py",
        "jawusd/rig/reader_process.py",  # pipes to its own child
    }
    found = set()
    for path in (ROOT / "jawusd").rglob("*.py"):
        text = path.read_text()
        if writes(text) and "atomic_path" not in text:
            found.add(path.relative_to(ROOT).as_posix())
    assert found <= allowed


def test_pictures_of_figures_go_the_same_way(tmp_path):
    (tmp_path / "plot.svg").symlink_to(tmp_path.parent / "elsewhere.svg")
    with pytest.raises(OutputError, match="link that leads out of its folder"):
        save_figure(new_figure(2, 2, 1, 1)[0], tmp_path, "plot")
    assert not (tmp_path.parent / "elsewhere.svg").exists()
