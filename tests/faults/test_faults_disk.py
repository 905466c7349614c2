"""A full or read-only disk gives one clear error, and existing files are kept."""

import os
import resource
import subprocess
import sys

import pytest
from package_copy import ROOT

WRITERS = {
    "npz": "write_npz_atomic(path, {'a': np.random.default_rng(0).normal(size=size)})",
    "text": "write_text_atomic(path, 'x' * size)",
    "usda": "write_layer(layer(size), path)",
    "usdc": "write_layer(layer(size), path)",
    "mkv": "video(path, size)",
}
PROGRAM = """
import sys, resource
from pathlib import Path
import numpy as np
from pxr import Sdf
from jawusd.base.errors import OutputError
from jawusd.formats.atomic import write_npz_atomic, write_text_atomic
from jawusd.media.writers import VideoWriter
from jawusd.rig.layers import new_layer, write_layer

def layer(size):
    made = new_layer()
    values = np.random.default_rng(0).normal(size=size)
    prim = Sdf.CreatePrimInLayer(made, "/Actor")
    Sdf.AttributeSpec(prim, "a", Sdf.ValueTypeNames.DoubleArray).default = values.tolist()
    return made

def video(path, size):
    noise = np.random.default_rng(0).integers(0, 255, (480, 640), np.uint8)
    with VideoWriter(path, (640, 480), 24.0, lossless=True) as writer:
        for _ in range(1 if size < 1000 else 40):
            writer.write(noise)

path = Path(sys.argv[1])
size = 100
{write}
before = path.read_bytes()
{limit}
size = 1_200_000
try:
    {write}
except OutputError as error:
    assert str(path) in str(error), error
    assert path.read_bytes() == before and [p.name for p in path.parent.iterdir()] == [path.name]
    print("refused")
"""
LIMIT = "resource.setrlimit(resource.RLIMIT_FSIZE, (600_000, 600_000))"


def run(program, path):
    command = [sys.executable, "-c", program, str(path)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=environment)


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_file_that_does_not_fit_leaves_the_one_before(tmp_path, suffix):
    if not hasattr(resource, "RLIMIT_FSIZE"):
        pytest.skip("no limit of file sizes here")
    program = PROGRAM.replace("{write}", WRITERS[suffix]).replace("{limit}", LIMIT)
    done = run(program, tmp_path / f"file.{suffix}")
    assert (done.stdout.strip(), done.returncode) == ("refused", 0), done.stderr[-2000:]


@pytest.fixture
def disk(tmp_path):
    """A file system of 1 MB; only root can mount it."""
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", place]
    mounted = subprocess.run(command, capture_output=True, check=False)
    if mounted.returncode:
        pytest.skip("file systems cannot be mounted here")
    yield place
    subprocess.run(["umount", "-l", place], check=True)


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_full_disk_leaves_the_file_before(disk, suffix):
    program = PROGRAM.replace("{write}", WRITERS[suffix]).replace("{limit}", "")
    done = run(program, disk / f"file.{suffix}")
    assert (done.stdout.strip(), done.returncode) == ("refused", 0), done.stderr[-2000:]


def test_a_build_into_a_read_only_folder_is_one_error(disk):
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    command = [sys.executable, "-m", "jawusd", "build", str(ROOT / "examples" / "capture"), "-o", str(disk / "rig")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=environment)
    assert done.returncode == 10 and "Read-only file system" in done.stderr and "Traceback" not in done.stderr
