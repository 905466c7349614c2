"""Clips as numbered pictures of any depth, and what files say of time, shape and colour."""

import struct
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from clip_files import KINDS, with_exr_header, write_picture, write_prores, write_sequence

from jawusd.base.errors import CaptureError
from jawusd.formats.clips import ClipSource
from jawusd.formats.file_names import gaps, groups, numbered_files
from jawusd.media.checks import rate_findings
from jawusd.media.footage import open_clip
from jawusd.media.pictures import read_header, read_stored
from jawusd.media.pixels import to_display
from jawusd.media.writers import VideoWriter

SIZE = (48, 64)


@pytest.fixture(scope="module")
def images():
    """Return smooth coloured pictures, (6, 48, 64, 3)."""
    rng = np.random.default_rng(0)
    rough = rng.integers(0, 256, (6, 12, 16, 3), dtype=np.uint8)
    return np.stack([cv2.resize(image, SIZE[::-1], interpolation=cv2.INTER_CUBIC) for image in rough])


@pytest.mark.parametrize("kind", KINDS)
def test_every_lossless_kind_shows_the_same_pictures(images, tmp_path, kind):
    clip = open_clip(ClipSource(write_sequence(tmp_path, images, kind), fps=24.0))
    assert clip.count == 6 and clip.size_px == (64, 48) and clip.timeline.rate == 24.0
    shown = np.stack([frame.image for frame in clip.frames(colour="rgb")])
    assert np.array_equal(shown, images)
    gray = next(clip.frames(2, 3)).image
    assert np.abs(gray.astype(int) - cv2.cvtColor(images[2], cv2.COLOR_RGB2GRAY)).max() <= 1


def test_gaps_are_frames_without_a_picture(images, tmp_path):
    clip = open_clip(ClipSource(write_sequence(tmp_path, images, "png8", left_out=(1002, 1004)), fps=25.0))
    assert clip.count == 4 and clip.timeline.count == 6 and clip.timeline.missing == 2
    assert [clip.timeline.picture(k) for k in range(6)] == [0, None, 1, None, 2, 3]
    assert [clip.timeline.number(k) for k in range(6)] == [1001, None, 1003, None, 1005, 1006]
    assert clip.times_s.tolist() == [0.0, 2 / 25, 4 / 25, 5 / 25]
    shown = [None if k is None else k.copy() for k in clip.pictures([0, None, 1, 3], colour="rgb")]
    for found, wanted in zip(shown, (0, None, 2, 5)):
        assert found is None if wanted is None else np.array_equal(found, images[wanted])
    assert gaps(clip.numbers.tolist()) == "1002, 1004"
    (told,) = rate_findings({"a": clip}, 25.0, "capture.toml")
    assert told.kind == "pictures_missing" and told.message == "images 1002, 1004 are missing"


@pytest.mark.parametrize(
    "name", ["take.%04d.png", "take.%d.png", "take.####.png", "take.*.png", "*.png", "take.??02.png"]
)
def test_patterns_people_write(images, tmp_path, name):
    write_sequence(tmp_path, images, "png8")
    (tmp_path / "notes.txt").touch()
    expected = [1002] if "?" in name else list(range(1001, 1007))
    assert list(numbered_files(tmp_path / name)) == expected


def test_patterns_that_cannot_be(images, tmp_path):
    write_sequence(tmp_path, images, "png8")
    for name, said in (
        ("take.####.exr", "no file in the folder matches take.####.exr"),
        ("take.%04d.%04d.png", "two numbers"),
        ("take.%04x.png", "needs a number such as %06d"),
    ):
        with pytest.raises(CaptureError, match=said.replace(".", r"\.")):
            numbered_files(tmp_path / name)
    with pytest.raises(CaptureError) as error:
        numbered_files(tmp_path / "shot.####.png")
    assert "take.%04d.png" in error.value.hint
    (tmp_path / "other.1001.png").touch()
    with pytest.raises(CaptureError, match="both have the number 1001"):
        numbered_files(tmp_path / "*.png")
    with pytest.raises(CaptureError, match="no folder"):
        numbered_files(tmp_path / "none" / "*.png")
    with pytest.raises(CaptureError, match="is a folder"):
        open_clip(tmp_path)


def test_a_video_with_a_sign_in_its_name_is_a_video(tmp_path):
    with VideoWriter(tmp_path / "take #3.mp4", (64, 48), 24.0) as writer:
        for _ in range(3):
            writer.write(np.zeros((48, 64), np.uint8))
    assert open_clip(tmp_path / "take #3.mp4").count == 3


def test_names_are_grouped_by_what_stays():
    found = groups(["a.0001.png", "a.0002.png", "b_9.png", "b_10.png", "read.me"])
    assert found == {"a.%04d.png": [1, 2], "b_%d.png": [9, 10]}


def test_pictures_that_do_not_belong_together(images, tmp_path):
    pattern = write_sequence(tmp_path, images[:2], "png8")
    write_picture(tmp_path / "take.1003.png", images[0, :24], "png8")
    with pytest.raises(CaptureError, match=r"64 x 24 px, but the first image is 64 x 48 px"):
        list(open_clip(pattern).frames())
    (tmp_path / "take.1003.png").write_bytes(b"no picture")
    with pytest.raises(CaptureError, match="cannot be read"):
        list(open_clip(pattern).frames())


def test_light_is_shown_by_the_curve_of_srgb():
    light = np.array([[0.0, 0.0021, 0.18, 0.5, 1.0, 7.0, np.nan, -1.0]], np.float32)
    # IEC 61966-2-1: 12.92 * 0.0021, 1.055 * 0.18^(1/2.4) - 0.055, ...
    assert to_display(light, 1, None, None).tolist() == [[0, 7, 118, 188, 255, 255, 0, 0]]
    assert to_display(light.astype(np.float16), 1, None, None).tolist() == [[0, 7, 118, 188, 255, 255, 0, 0]]
    assert to_display(np.array([[0, 1023]], np.uint16), 1023, None, None).tolist() == [[0, 255]]


def test_film_scans_are_shown_by_their_density():
    """White and black of a negative; 445 lies 0.8 in density below white: (10^-0.8 - 0.0108) / (1 - 0.0108) = 0.149."""
    code = np.array([[95, 445, 685, 1023]], np.uint16)
    shown = to_display(code, 1023, "cineon", None)[0]
    assert shown[0] == 0 and shown[2] == shown[3] == 255 and abs(int(shown[1]) - 108) <= 1


def test_a_colour_space_that_nobody_knows(tmp_path):
    with pytest.raises(CaptureError, match='"Log C" is unknown; expected display, linear, cineon'):
        to_display(np.zeros((2, 2), np.uint16), 65535, "Log C", None)


def test_an_opencolorio_config_is_used(images, tmp_path):
    ocio = pytest.importorskip("PyOpenColorIO")
    config = ocio.Config.CreateFromBuiltinConfig("cg-config-v1.0.0_aces-v1.3_ocio-v2.1")
    (tmp_path / "config.ocio").write_text(config.serialize())
    pattern = write_sequence(tmp_path, images[:1], "exr")
    source = ClipSource(pattern, colour_space="Linear Rec.709 (sRGB)", colour_config=tmp_path / "config.ocio")
    shown = next(open_clip(source).frames(colour="rgb")).image
    display = config.getDefaultDisplay()
    transform = ocio.DisplayViewTransform("Linear Rec.709 (sRGB)", display, config.getDefaultView(display))
    wanted = read_stored(tmp_path / "take.1001.exr")[0].astype(np.float32)
    config.getProcessor(transform).getDefaultCPUProcessor().applyRGB(wanted)
    assert np.abs(shown - 255 * np.clip(wanted, 0, 1)).max() <= 0.51
    with pytest.raises(CaptureError, match="cannot convert"):
        bad = ClipSource(pattern, colour_space="Nothing", colour_config=tmp_path / "config.ocio")
        next(open_clip(bad).frames())


def test_headers_of_exr_and_dpx(images, tmp_path):
    exr = with_exr_header(
        write_picture(tmp_path / "a.exr", images[0], "exr"),
        timeCode_timecode=struct.pack("<2I", 0x01022364, 0),
        framesPerSecond_rational=struct.pack("<iI", 24000, 1001),
    )
    found = read_header(exr)
    assert found.timecode == "01:02:23;24"
    assert found.fps == pytest.approx(23.976, abs=1e-3)
    assert read_stored(exr)[0].shape == (48, 64, 3)  # still a picture
    dpx = write_picture(tmp_path / "a.dpx", images[0], "dpx10")
    data = bytearray(dpx.read_bytes())
    order = ">" if data[:4] == b"SDPX" else "<"
    struct.pack_into(f"{order}I", data, 1920, 0x10203012)
    struct.pack_into(f"{order}f", data, 1940, 25.0)
    struct.pack_into(f"{order}2I", data, 1628, 2, 1)
    data[801] = 1
    dpx.write_bytes(bytes(data))
    found = read_header(dpx)
    assert (found.timecode, found.fps, found.pixel_aspect, found.colour_space) == ("10:20:30:12", 25.0, 2.0, "cineon")
    assert read_header(write_picture(tmp_path / "a.png", images[0], "png8")).timecode == ""


def test_prores_of_ten_bits_keeps_brightness_and_time_code(images, tmp_path):
    gray = images.mean(-1, keepdims=True)
    images = np.rint(gray + 0.3 * (images - gray)).astype(np.uint8)  # colours of skin, not of signals
    path = write_prores(tmp_path / "take.mov", images, Fraction(24000, 1001), "10:20:30:12")
    clip = open_clip(path)
    assert clip.timecode == "10:20:30:12" and clip.count == 6
    assert clip.timeline.rate == pytest.approx(23.976, abs=1e-3)
    for frame, image in zip(clip.frames(colour="rgb"), images):
        apart = frame.image.astype(float) - image
        assert abs(apart.mean()) < 1.0 and np.abs(apart).mean() < 4.0
    shown = next(clip.frames()).image.astype(float)
    with av.open(str(path)) as container:
        plane = next(container.decode(video=0)).planes[0]
        stored = np.frombuffer(memoryview(plane), np.uint16).reshape(-1, plane.line_size // 2)[:48, :64]
    assert np.abs(shown - (stored.astype(float) - 64) * 255 / 876).max() <= 1.0  # ITU-R BT.709: 64 .. 940
