"""Video reading and writing against OpenCV's sequential decoder and broken files."""

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from jawusd.base.errors import CaptureError
from jawusd.media.pixels import TO_RGB
from jawusd.media.video import Video
from jawusd.media.writers import VideoWriter

SIZE = (96, 64)


def picture(k: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Make an RGB picture whose content tells its number: a block that moves and a brightness that changes."""
    w, h = size
    image = np.full((h, w, 3), 40, np.uint8)
    image[:, :, 0] = np.linspace(20, 200, w).astype(np.uint8)
    image[10:30, (3 * k) % (w - 20) : (3 * k) % (w - 20) + 20] = 60 + (k * 29) % 180
    return image


def write_b_frames(path: Path, pts: list[int], rotation: int = 0, **options: str) -> None:
    """Write H.264 with B-frames and a given time stamp [ms] for each picture."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(1000))
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        stream.options = {"bf": "3", "g": "12", "crf": "10", "threads": "1"} | options
        if rotation:
            stream.set_display_rotation(rotation)
        for k, t in enumerate(pts):
            frame = av.VideoFrame.from_ndarray(picture(k), format="rgb24")
            frame.pts, frame.time_base = t, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def opencv_gray(path: Path) -> list[np.ndarray]:
    capture = cv2.VideoCapture(str(path))
    images = []
    while (got := capture.read())[0]:
        images.append(cv2.cvtColor(got[1], cv2.COLOR_BGR2GRAY))
    return images


@pytest.fixture(scope="module")
def variable(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[int]]:
    """A variable-rate H.264 with B-frames, 60 pictures."""
    rng = np.random.default_rng(0)
    pts = np.cumsum(rng.integers(15, 80, 60)).tolist()
    path = tmp_path_factory.mktemp("video") / "variable.mp4"
    write_b_frames(path, pts)
    return path, pts


def test_reading_agrees_with_opencv(variable: tuple[Path, list[int]]) -> None:
    path, pts = variable
    expected = opencv_gray(path)
    video = Video(path)
    assert video.count == len(expected) == 60 and video.size_px == SIZE and video.rotation_deg == 0
    frames = list(video.frames())
    assert [f.index for f in frames] == list(range(60))
    assert np.allclose(video.times_s, (np.array(pts) - pts[0]) / 1000, atol=1e-6)
    for frame, image in zip(frames, expected, strict=True):
        # OpenCV goes YUV -> BGR -> gray, which clips saturated colours; luma differs by rounding only.
        assert np.abs(frame.image.astype(int) - image).mean() < 1.5
        assert not frame.image.flags.writeable
    rgb = next(video.frames(17, 18, colour="rgb")).image
    assert rgb.shape == (64, 96, 3) and np.abs(rgb.astype(int) - picture(17)).mean() < 6


def test_every_seek_lands_on_its_frame(variable: tuple[Path, list[int]]) -> None:
    video = Video(variable[0])
    expected = [f.image.copy() for f in video.frames()]
    for first in np.random.default_rng(1).permutation(60):
        frames = list(video.frames(first, min(first + 3, 60)))
        assert [f.index for f in frames] == list(range(first, min(first + 3, 60)))
        assert all(np.array_equal(f.image, expected[f.index]) for f in frames)


def test_a_seek_decodes_from_the_key_frame_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_b_frames(tmp_path / "even.mp4", list(range(0, 2400, 40)), sc_threshold="0")
    video, decoded, read = Video(tmp_path / "even.mp4"), [], Video._decoded

    def counted(*arguments: object) -> Iterator[av.VideoFrame]:
        for frame in read(*arguments):
            decoded.append(round(frame.time / 0.04))
            yield frame

    monkeypatch.setattr(Video, "_decoded", counted)
    assert video.keys.tolist() == [0, 12, 24, 36, 48]
    needed = 0
    for first in range(video.count):
        decoded.clear()
        next(video.frames(first))
        assert decoded[-1] == first and len(decoded) <= first % 12 + 1
        needed += len(decoded)
    assert needed < sum(k % 12 + 1 for k in range(video.count)) * 0.8  # no B-frames that nothing is made from


def test_dense_key_frames_do_not_confuse_seeking(tmp_path: Path) -> None:
    path = tmp_path / "dense.mp4"
    write_b_frames(path, list(range(0, 1600, 40)), g="3", bf="2", **{"keyint-min": "1"})
    video = Video(path)
    expected = [f.image.copy() for f in video.frames()]
    for first in range(video.count):
        assert np.array_equal(next(video.frames(first)).image, expected[first])


@pytest.mark.parametrize("rotation", [90, -90, 180])
def test_rotation_is_honoured_as_opencv_does(tmp_path: Path, rotation: int) -> None:
    path = tmp_path / "turned.mp4"
    write_b_frames(path, list(range(0, 400, 40)), rotation=rotation)
    video = Video(path)
    expected = opencv_gray(path)
    assert video.rotation_deg == rotation % 360
    assert video.size_px == expected[0].shape[::-1] == (SIZE if rotation == 180 else SIZE[::-1])
    found = list(video.frames())
    assert len(found) == len(expected) == 10
    for frame, image in zip(found, expected, strict=True):
        assert np.abs(frame.image.astype(int) - image).mean() < 1.5
    assert next(video.frames(colour="rgb")).image.shape[:2] == expected[0].shape


@pytest.mark.parametrize("rotation", [0, 90, 180, -90])
@pytest.mark.parametrize("pixels", ["yuv420p", "yuv444p", "yuv420p10le", "gray", "bgr0"])
def test_parts_of_colour_pictures_are_those_of_the_whole(tmp_path: Path, rotation: int, pixels: str) -> None:
    """Against ffmpeg's own conversion of the whole picture."""
    path, size = tmp_path / "film.mkv", (320, 240)
    noise = np.random.default_rng(1).integers(0, 256, (size[1] // 4, size[0] // 4, 3), np.uint8)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=24)
        stream.width, stream.height, stream.pix_fmt = *size, pixels
        if rotation:
            stream.set_display_rotation(rotation)
        frame = av.VideoFrame.from_ndarray(cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC), format="rgb24")
        container.mux(stream.encode(frame.reformat(format=pixels)))
        container.mux(stream.encode(None))
    video = Video(path)
    whole = next(video.frames(colour="rgb")).image
    if "10" not in pixels:
        with av.open(str(path)) as container:
            shown = next(container.decode(video=0)).to_ndarray(format="rgb24", interpolation=TO_RGB)
        assert np.array_equal(whole, np.rot90(shown, video.rotation_deg // 90))
    for rows, columns in ((slice(11, 60), slice(41, 93)), (slice(0, 30), slice(140, 240))):
        (picture,) = video.colour_pictures([0])
        assert picture is not None and picture.shape == whole.shape
        apart = np.abs(picture[rows, columns].astype(int) - whole[rows, columns])
        assert apart.shape == whole[rows, columns].shape
        assert apart.max(initial=0) <= 3 and (apart > 0).mean() < 0.02  # ffmpeg rounds by where in a row a pixel lies
    assert np.array_equal(np.asarray(next(video.colour_pictures([0]))), whole)


def test_lossless_gray_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    pictures = [rng.integers(0, 256, (33, 47), dtype=np.uint8) for _ in range(7)]
    path = tmp_path / "masks.mkv"
    with VideoWriter(path, (47, 33), 23.976, lossless=True) as out:
        for image in pictures:
            out.write(image)
        assert not path.exists()
    video = Video(path)
    assert video.count == 7 and video.fps == pytest.approx(24000 / 1001, rel=1e-3)
    assert all(np.array_equal(f.image, p) for f, p in zip(video.frames(), pictures, strict=True))
    assert all(np.array_equal(i, p) for i, p in zip(opencv_gray(path), pictures, strict=True))


def test_h264_writer_is_read_by_opencv(tmp_path: Path) -> None:
    path = tmp_path / "out.mp4"
    with VideoWriter(path, SIZE, 24) as out:
        for k in range(10):
            out.write(picture(k))
        out.write(picture(10)[..., 0].copy())
    capture = cv2.VideoCapture(str(path))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(24)
    for k in range(10):
        ok, image = capture.read()
        assert ok and np.abs(image[..., ::-1].astype(int) - picture(k)).mean() < 6
    assert np.allclose(Video(path).times_s, np.arange(11) / 24, atol=1e-4)


def test_a_failed_writer_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "out.mp4"
    with pytest.raises(ValueError, match="image"), VideoWriter(path, SIZE, 24) as out:
        out.write(picture(0))
        out.write(np.zeros((3, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []
    for bad in (dict(size_px=(95, 64)), dict(fps=0), dict(lossless=True)):
        with pytest.raises(ValueError):
            VideoWriter(**(dict(path=path, size_px=SIZE, fps=24) | bad))


def test_missing_empty_and_foreign_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"gone\.mp4: there is no such video"):
        Video(tmp_path / "gone.mp4")
    empty, text, sound = tmp_path / "empty.mp4", tmp_path / "text.mp4", tmp_path / "sound.wav"
    empty.touch()
    with pytest.raises(CaptureError, match=r"empty\.mp4: the file is empty.*Copy"):
        Video(empty)
    text.write_text("not a video" * 100)
    with pytest.raises(CaptureError, match=r"text\.mp4: the video cannot be opened"):
        Video(text)
    with av.open(str(sound), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
    with pytest.raises(CaptureError, match=r"sound\.wav: the file has no video stream"):
        Video(sound)


def test_truncated_files_name_the_frame(tmp_path: Path) -> None:
    path = tmp_path / "whole.mp4"
    write_b_frames(path, list(range(0, 2400, 40)))
    data = path.read_bytes()
    no_index = tmp_path / "cut.mp4"  # the index stands at the end of the file
    no_index.write_bytes(data[: len(data) // 2])
    with pytest.raises(CaptureError, match=r"cut\.mp4: the video cannot be opened"):
        Video(no_index)
    fast = tmp_path / "fast.mp4"  # the index stands at the start: pictures are announced that are not there
    with av.open(str(path)) as source, av.open(str(fast), "w", options={"movflags": "faststart"}) as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.size:
                packet.stream = stream
                target.mux(packet)
    fast.write_bytes(fast.read_bytes()[: len(data) * 2 // 3])
    with pytest.raises(CaptureError, match=r"fast\.mp4: frame \d+ of 60 cannot be read: the file is truncated"):
        Video(fast)


def test_a_truncated_stream_ends_where_it_breaks(tmp_path: Path) -> None:
    path = tmp_path / "masks.mkv"
    rng = np.random.default_rng(4)
    with VideoWriter(path, SIZE, 24, lossless=True) as out:
        for _ in range(20):
            out.write(rng.integers(0, 256, SIZE[::-1], dtype=np.uint8))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    video = Video(path)
    assert 5 < video.count < 15
    with pytest.raises(CaptureError, match=rf"19 are requested, but the video has frames 0 to {video.count - 1}"):
        video.frames(0, 20)


@pytest.mark.parametrize(("pixels", "bits"), [("yuv420p", 8), ("yuv422p10le", 10)])
def test_colours_are_those_of_the_standard(tmp_path, pixels, bits):
    """Even pictures, stored without loss, against the formula of ITU-R BT.601, video range."""
    rng = np.random.default_rng(4)
    path, scale = tmp_path / "even.mkv", 1 << (bits - 8)
    wanted = rng.integers(30, 220, (24, 3)).astype(float)  # not at the ends: there some are cut off
    luma = wanted @ [0.299, 0.587, 0.114]
    blue, red = (wanted[:, 2] - luma) / 1.772, (wanted[:, 0] - luma) / 1.402
    stored = np.rint(scale * np.column_stack([16 + 219 / 255 * luma, 128 + 224 / 255 * blue, 128 + 224 / 255 * red]))
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=24)
        stream.width, stream.height, stream.pix_fmt = *SIZE, pixels
        for values in stored:
            frame = av.VideoFrame(*SIZE, pixels)
            for plane, value in zip(frame.planes, values, strict=True):
                kind = np.dtype("<u2" if bits > 8 else "u1")
                plane.update(np.full(plane.buffer_size // kind.itemsize, value, kind))
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    found = np.array([frame.image.reshape(-1, 3).mean(0) for frame in Video(path).frames(colour="rgb")])
    assert np.abs(found - wanted).max() < 1.6  # 8 bits of the colours are 1.1 levels apart
    assert np.abs((found - wanted).mean(0)).max() < 0.35
