"""Damage placed on purpose in clips that are the same bytes every time is found, whatever the number of threads."""

import cv2
import numpy as np
import pytest
from damaged_clips import packets, with_zeros, write_clip

from jawusd.base.errors import CaptureError
from jawusd.media.pictures import read_stored
from jawusd.media.video import Video
from jawusd.media.writers import VideoWriter

THREADS = (1, 2, 8)


def error(path, threads=1):
    """Return the message of the error that reading all pictures raises, None if there is none."""
    try:
        for _ in Video(path).frames(threads=threads):
            pass
    except CaptureError as found:
        return str(found)
    return None


@pytest.mark.parametrize("codec", ["h264", "hevc", "prores", "ffv1"])
def test_clips_are_the_same_bytes_and_are_read(codec, tmp_path):
    (tmp_path / "again").mkdir()
    path, again = write_clip(tmp_path, codec), write_clip(tmp_path / "again", codec)
    if codec != "ffv1":  # Matroska carries a random identifier
        assert path.read_bytes() == again.read_bytes()
    assert [error(path, threads) for threads in THREADS] == [None] * len(THREADS)


# What one decoder thread finds of 16 zeroed bytes in the middle of each picture [share]; eight found less in H.264.
@pytest.mark.slow
@pytest.mark.parametrize(("codec", "least"), [("h264", 0.4), ("prores", 1.0), ("ffv1", 1.0)])
def test_damage_in_slice_data_is_found_whatever_the_threads(codec, least, tmp_path):
    path = write_clip(tmp_path, codec, size=(320, 192))
    data, places = path.read_bytes(), packets(path)
    found = {threads: [] for threads in THREADS}
    for at, size in places[::3]:
        path.write_bytes(with_zeros(data, at + size // 2))
        for threads in THREADS:
            found[threads].append(error(path, threads) is not None)
    assert found[1] == found[2] == found[8]
    assert np.mean(found[1]) >= least


@pytest.mark.parametrize("codec", ["h264", "hevc", "prores", "ffv1"])
@pytest.mark.parametrize("number", [0, 3, 20, 35])
def test_damaged_headers_of_pictures_are_found(codec, number, tmp_path):
    path = write_clip(tmp_path, codec)
    at, _ = packets(path)[number]
    path.write_bytes(with_zeros(path.read_bytes(), at, 24))
    for threads in THREADS:
        assert "cannot be decoded" in (error(path, threads) or "")


@pytest.mark.parametrize("codec", ["h264", "hevc", "prores"])
@pytest.mark.parametrize("table", [b"stsd", b"stts", b"stsz", b"stco", b"stsc"])
def test_damaged_tables_are_found(codec, table, tmp_path):
    path = write_clip(tmp_path, codec)
    data = path.read_bytes()
    path.write_bytes(with_zeros(data, data.rindex(table) - 4, 24))
    assert error(path) is not None


@pytest.mark.parametrize("number", [0, 5, 35])
def test_one_bit_of_ffv1_is_found_by_its_checksum(number, tmp_path):
    """FFmpeg shows the slice of the previous image without a message."""
    path = write_clip(tmp_path, "ffv1")
    data, (at, size) = bytearray(path.read_bytes()), packets(path)[number]
    data[at + size // 2] ^= 4
    path.write_bytes(data)
    for threads in THREADS:
        assert f"frame {number} of 36" in (error(path, threads) or "")


def test_one_bit_of_written_masks_is_found(tmp_path):
    path = tmp_path / "masks.mkv"
    with VideoWriter(path, (64, 48), 24, lossless=True) as out:
        for k in range(5):
            out.write(np.random.default_rng(k).integers(0, 256, (48, 64), np.uint8))
    at, size = packets(path)[2]
    data = bytearray(path.read_bytes())
    data[at + size // 2] ^= 1
    path.write_bytes(data)
    assert "frame 2 of 5" in (error(path) or "")


def test_ffv1_without_checksums_is_read(tmp_path):
    assert error(write_clip(tmp_path, "ffv1", level="1")) is None
    assert error(write_clip(tmp_path, "ffv1", slicecrc="0", slices="4")) is None


def test_hevc_with_hashes_is_compared_with_them(tmp_path):
    path = write_clip(tmp_path, "hevc", **{"x265-params": "pools=none:frame-threads=1:log-level=0:hash=1"})
    assert error(path) is None
    data = path.read_bytes()
    for at, size in packets(path)[1::7]:
        path.write_bytes(with_zeros(data, at + size // 2, 4))
        for threads in THREADS:
            assert "cannot be decoded" in (error(path, threads) or "")


def test_a_picture_made_from_a_damaged_one_is_not_given(tmp_path):
    """Of a clip read in part, too: the pictures before, back to the key frame, are looked at."""
    path = write_clip(tmp_path, "h264", bf="0")
    data = path.read_bytes()
    for number in range(13, 20):
        at, size = packets(path)[number]
        path.write_bytes(with_zeros(data, at + size // 4, size // 2))
        if error(path) is None:
            continue
        for asked in range(number, 24):
            with pytest.raises(CaptureError, match=f"frame {asked} of 36"):
                list(Video(path).frames(asked, asked + 1))
        assert len(list(Video(path).frames(24, 36))) == 12  # from the next key frame on
        path.write_bytes(data)


def test_one_byte_of_a_png_is_found_by_its_checksum(tmp_path):
    path = tmp_path / "0001.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8))
    read_stored(path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(CaptureError, match="damaged"):
        read_stored(path)
