"""What files ask for when they are shown: turns are done, mirrored and skewed pictures refused, fields named."""

import av
import numpy as np
import pytest
from PIL import Image

from jawusd.base.errors import CaptureError
from jawusd.media.checks import decoded_findings
from jawusd.media.pictures import read_picture, read_stored
from jawusd.media.video import Video

PICTURE = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)


def write(path, matrix=None, count=3, codec="libx264", first=0, **options):
    """Write a clip with a display matrix (a, b, c, d), or options of the encoder."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=24)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.options = options
        if matrix is not None:
            a, b, c, d = (round(value * 65536) for value in matrix)
            stream.set_display_matrix([a, b, 0, c, d, 0, 0, 0, 1 << 30])
        for k in range(count):
            frame = av.VideoFrame.from_ndarray(np.roll(PICTURE, k, 1))
            frame.pts = first + k
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@pytest.mark.parametrize("suffix", [".mp4", ".mov"])
@pytest.mark.parametrize(
    ("matrix", "turn"),
    [((1, 0, 0, 1), 0), ((0, -1, 1, 0), 90), ((-1, 0, 0, -1), 180), ((0, 1, -1, 0), 270), ((2, 0, 0, 2), 0)],
)
def test_turns_are_done(tmp_path, suffix, matrix, turn):
    assert Video(write(tmp_path / f"a{suffix}", matrix)).rotation_deg == turn


@pytest.mark.parametrize("suffix", [".mp4", ".mov"])
@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        ((-1, 0, 0, 1), "mirrors"),
        ((1, 0, 0, -1), "mirrors"),
        ((0, 1, 1, 0), "mirrors"),
        ((0, -1, -1, 0), "mirrors"),
        ((-1.5, 0, 0, 1.5), "mirrors"),
        ((0.6, 0.8, 0.8, -0.6), "mirrors"),
        ((0.8, 0.6, -0.6, 0.8), "only rotations by multiples of 90"),
        ((1, 0.3, 0, 1), "only rotations by multiples of 90"),
        ((1, 0, 0.2, 1), "only rotations by multiples of 90"),
    ],
)
def test_mirrors_and_skews_are_refused(tmp_path, suffix, matrix, said):
    path = write(tmp_path / f"a{suffix}", matrix)
    with pytest.raises(CaptureError, match=rf"a{suffix}: the display matrix .*{said}"):
        Video(path)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_turned_photographs_are_turned_as_opencv_does(tmp_path, orientation):
    """Boards are read with OpenCV, footage with FFmpeg."""
    exif = Image.Exif()
    exif[0x112] = orientation
    path = tmp_path / "0001.jpg"
    Image.fromarray(np.kron(PICTURE[:6, :8], np.ones((8, 8, 1), np.uint8))).save(path, exif=exif, quality=95)
    ours, cv = read_stored(path)[0], read_picture(path, 1)[..., ::-1]
    assert ours.shape == cv.shape and np.abs(ours.astype(int) - cv).mean() < 3


@pytest.mark.parametrize("orientation", [2, 4, 5, 7])
def test_mirrored_photographs_are_refused(tmp_path, orientation):
    exif = Image.Exif()
    exif[0x112] = orientation
    Image.fromarray(PICTURE).save(tmp_path / "0001.jpg", exif=exif)
    with pytest.raises(CaptureError, match=r"0001\.jpg: the orientation in the file is mirrored"):
        read_stored(tmp_path / "0001.jpg")


def woven(path):
    return [f.kind for f in decoded_findings(Video(path), "left") if f.camera == "left" and f.severity == "warning"]


@pytest.mark.parametrize("order", ["tff", "bff"])
@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".ts"])
def test_fields_of_h264_are_named(tmp_path, suffix, order):
    assert woven(write(tmp_path / f"a{suffix}", **{"x264-params": f"{order}=1"})) == ["interlaced"]


def test_fields_of_mpeg2_are_named(tmp_path):
    assert woven(write(tmp_path / "a.mkv", codec="mpeg2video", flags="+ildct+ilme", field_order="tt")) == ["interlaced"]


@pytest.mark.parametrize("codec", ["libx264", "mpeg4", "ffv1"])
def test_progressive_pictures_and_those_of_no_known_order_are_not(tmp_path, codec):
    assert woven(write(tmp_path / "a.mkv", codec=codec)) == []


def test_fields_that_begin_in_mid_clip_are_named(tmp_path):
    fields = write(tmp_path / "b.ts", count=10, first=14, **{"x264-params": "tff=1"})
    parts = [write(tmp_path / "a.ts", count=10), fields]
    path = tmp_path / "mixed.ts"
    with av.open(str(path), "w") as out:
        stream = None
        for part in parts:
            with av.open(str(part)) as source:
                stream = stream or out.add_stream_from_template(source.streams.video[0])
                for packet in source.demux(video=0):
                    if packet.size:
                        packet.stream = stream
                        out.mux(packet)
    assert not Video(path).is_interlaced
    assert woven(path) == ["interlaced"]
