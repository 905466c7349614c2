"""What is no file is not read: pipes that nobody writes to would be waited for, devices read for ever."""

import os
import threading
from pathlib import Path

import pytest

from jawusd.base.errors import JawusdError
from jawusd.base.inputs import check_input
from jawusd.cameras.calibration import load_calibration
from jawusd.cameras.files import load_cameras_file
from jawusd.formats.capture import load_capture
from jawusd.formats.keys import load_keys
from jawusd.formats.landmarks import load_landmarks
from jawusd.formats.model import load_model
from jawusd.formats.poses import read_parameters, read_poses
from jawusd.formats.tracks import load_tracks
from jawusd.media.containers import read_sound
from jawusd.media.pictures import read_gray
from jawusd.media.video import Video
from jawusd.meshes.meshio import load_mesh

READERS = {
    "calibration.toml": load_calibration,
    "transforms.json": load_cameras_file,
    "capture.toml": load_capture,
    "keys.json": load_keys,
    "landmarks.json": load_landmarks,
    "model.npz": load_model,
    "tracks.npz": load_tracks,
    "poses.csv": read_poses,
    "d.csv": read_parameters,
    "scan.ply": load_mesh,
    "scan.stl": load_mesh,
    "video.mp4": Video,
    "sound.wav": lambda path: read_sound(path, 48_000),
}


@pytest.mark.parametrize("name", READERS)
def test_named_pipes_are_no_files(name, tmp_path):
    os.mkfifo(tmp_path / name)
    found = []

    def read():
        try:
            READERS[name](tmp_path / name)
        except JawusdError as error:
            found.append(str(error))

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    thread.join(10)
    assert found and name in found[0] and ("is not a regular file" in found[0] or "no such video" in found[0])


@pytest.mark.parametrize("name", READERS)
def test_folders_are_no_files(name, tmp_path):
    (tmp_path / name).mkdir()
    words = r"(?i)not a regular file|no such|no frames|is a folder|directory|capture.toml"
    with pytest.raises(JawusdError, match=words):
        READERS[name](tmp_path / name)


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="no devices here")
def test_devices_are_no_files():
    with pytest.raises(JawusdError, match="is not a regular file"):
        check_input("/dev/zero")


def test_pictures_that_are_pipes_are_none(tmp_path):
    os.mkfifo(tmp_path / "0.png")
    assert read_gray(tmp_path / "0.png") is None


@pytest.mark.skipif(not Path("/dev/fd").exists(), reason="no /dev/fd here")
def test_what_a_shell_hands_over_is_read():
    """The shell's <(program) is a pipe without a name."""
    out, into = os.pipe()
    os.write(into, b"frame,d1,d2,d3\n1,2,3,4\n")
    os.close(into)
    frames, d = read_parameters(Path(f"/dev/fd/{out}"))
    assert list(frames) == [1] and d.tolist() == [[2, 3, 4]]
    os.close(out)
