"""Videos that name other files, or pictures larger than memory, are refused before anything else is opened."""

import os
import shutil

import av
import cv2
import numpy as np
import pytest
from package_copy import ROOT

from jawusd.base.errors import CaptureError
from jawusd.media import pictures, video
from jawusd.media.containers import MOST_PX, read_sound
from jawusd.media.pictures import read_gray
from jawusd.media.video import Video

VIDEO = ROOT / "examples" / "capture" / "video" / "cam0.mp4"


@pytest.fixture
def elsewhere(tmp_path):
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    return shutil.copy(VIDEO, folder / "secret.mp4")


def playlist(kind, name):
    return {
        "hls": f'#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXT-X-MAP:URI="{name}"\n#EXTINF:10,\n{name}\n#EXT-X-ENDLIST\n',
        "concat": f"ffconcat version 1.0\nfile {name}\n",
        "sdp": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 5004 RTP/AVP 33\n",
    }[kind]


@pytest.mark.parametrize("kind", ["hls", "concat", "sdp"])
@pytest.mark.parametrize("suffix", [".mp4", ".m3u8", ".ffconcat", ".sdp"])
@pytest.mark.parametrize("opened", [Video, lambda path: read_sound(path, 16000)])
def test_playlists_name_no_other_files(opened, suffix, kind, elsewhere, tmp_path):
    place = tmp_path / "capture"
    place.mkdir()
    (place / "link.mp4").symlink_to(elsewhere)
    (place / f"video{suffix}").write_text(playlist(kind, "link.mp4"))
    with pytest.raises(CaptureError, match="cannot be"):
        opened(place / f"video{suffix}")


def test_the_whole_of_such_a_playlist_would_be_read(elsewhere):
    """What the test above is about: FFmpeg follows it."""
    (elsewhere.parent / "video.mp4").write_text(playlist("concat", "secret.mp4"))
    with av.open(str(elsewhere.parent / "video.mp4")) as container:
        assert next(container.decode(video=0)).width > 0


def test_videos_of_huge_pictures_are_refused(monkeypatch):
    monkeypatch.setattr(video, "MOST_PX", 64 * 64)
    with pytest.raises(CaptureError, match="at most 4096 px in total"):
        Video(VIDEO)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp", ".webp"])
def test_huge_pictures_are_none(suffix, tmp_path, monkeypatch):
    path = tmp_path / f"000000{suffix}"
    cv2.imwrite(str(path), np.zeros((80, 60), np.uint8))
    assert read_gray(path).shape == (80, 60)
    monkeypatch.setattr(pictures, "MOST_PX", 80 * 60 - 1)
    assert read_gray(path) is None


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg", ".dpx", ".exr"])
def test_huge_frames_of_sequences_are_refused_before_they_are_decoded(suffix, tmp_path, monkeypatch):
    """177 bytes of PNG took 1.3 GB before."""
    kind = {".exr": "gbrpf32le", ".dpx": "rgb48be", ".tif": "rgb48le", ".jpg": "yuvj420p"}.get(suffix, "rgb48be")
    path = tmp_path / f"a{suffix}"
    with av.open(str(path), "w", "image2", options={"update": "1"}) as out:
        codec = {".jpg": "mjpeg", ".tif": "tiff"}.get(suffix, suffix[1:])
        stream = out.add_stream(codec, 24, options={})
        stream.width, stream.height, stream.pix_fmt = 64, 80, kind
        frame = av.VideoFrame.from_ndarray(np.zeros((80, 64, 3), np.uint8), "rgb24").reformat(format=kind)
        out.mux([*stream.encode(frame), *stream.encode(None)])
    assert pictures.read_stored(path)[0].shape == (80, 64, 3)
    monkeypatch.setattr(pictures, "MOST_STORED_PX", 64 * 80 - 1)
    with pytest.raises(CaptureError, match="more than 5119 px"):
        pictures.read_stored(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes of POSIX")
def test_headers_of_pipes_are_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "0001.exr")
    with pytest.raises(CaptureError, match="is not a regular file"):
        pictures.read_header(tmp_path / "0001.exr")


def test_a_header_that_announces_more_than_memory_is_none(tmp_path):
    """A bitmap of few bytes, 32767 px square; OpenCV would take a gigabyte for it."""
    path = tmp_path / "000000.png"
    cv2.imwrite(str(tmp_path / "a.bmp"), np.zeros((8, 8), np.uint8))
    data = bytearray((tmp_path / "a.bmp").read_bytes())
    data[18:26] = (32767).to_bytes(4, "little") * 2
    path.write_bytes(data)
    assert MOST_PX < 32767**2 and read_gray(path) is None
