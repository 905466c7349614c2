"""Mask sources in every order and encoding, and every way they can be wrong."""

import re
import struct
import threading
import time
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from subjects.annotator import write_mask

import jawusd
from jawusd.base.errors import CaptureError
from jawusd.media.clip import Timeline
from jawusd.media.masks import FrameMasks, MaskReader, mask_size_px, open_masks
from jawusd.media.pictures import read_gray
from jawusd.media.writers import VideoWriter

SIZE = (64, 40)
BLACK = (3, 9)
MISSING = (5, 6)
COUNT = 14


def mask(k: int) -> np.ndarray:
    image = np.zeros(SIZE[::-1], np.uint8)
    if k not in BLACK:
        image[5 + k : 20 + k, 10 : 30 + k] = 255
    return image


@pytest.fixture
def pattern(tmp_path: Path) -> Path:
    folder = tmp_path / "upper"
    folder.mkdir()
    for k in range(COUNT):
        if k not in MISSING:
            cv2.imwrite(str(folder / f"{k:06d}.png"), mask(k))
    (folder / "notes.txt").write_text("not a mask")
    return folder / "%06d.png"


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "upper.mkv"
    with VideoWriter(path, SIZE, 24, lossless=True) as out:
        for k in range(COUNT):
            out.write(mask(k))
    return path


def check(reader: MaskReader, k: int, missing: tuple[int, ...]) -> None:
    found = reader.read(k)
    if not 0 <= k < COUNT or k in missing:
        assert found is None
    else:
        assert found.dtype == np.uint8 and np.array_equal(found, mask(k))


@pytest.mark.parametrize("kind", ["pattern", "video"])
def test_any_order_gives_the_same_masks(kind: str, request: pytest.FixtureRequest) -> None:
    missing = BLACK + (MISSING if kind == "pattern" else ())
    orders = [range(-2, COUNT + 3), range(COUNT, -1, -1), np.random.default_rng(0).integers(-1, COUNT + 1, 60)]
    orders += [[0, 1, 2, 3, 10, 4, 5, 11, 12, 13, 0, 1, 2]]
    with MaskReader(request.getfixturevalue(kind), SIZE) as reader:
        assert reader.count == COUNT
        for order in orders:
            for k in order:
                check(reader, int(k), missing)


def test_decoding_runs_ahead_but_not_away(video: Path) -> None:
    prepared: list[int] = []

    def prepare(image: np.ndarray) -> tuple[str, int]:
        prepared.append(int(image.sum()))
        return threading.current_thread().name, int(image.sum())

    others = set(threading.enumerate())  # readers that were never closed keep theirs until they are collected
    with MaskReader(video, SIZE, prepare=prepare) as reader:
        assert reader.read(0) == ("MainThread", mask(0).sum())
        assert reader.read(1) == ("jawusd-ahead_0", mask(1).sum())
        deadline = time.monotonic() + 5
        while len(prepared) < 5 and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(0.1)
        assert 5 <= len(prepared) <= 7  # 0 and 1, and four that wait, of which one is black
        assert [reader.read(k) is None for k in range(2, COUNT)] == [k in BLACK for k in range(2, COUNT)]
    assert "jawusd-ahead_0" not in {thread.name for thread in set(threading.enumerate()) - others}


@pytest.mark.parametrize("kind", ["pattern", "video"])
def test_frames_in_a_row_are_those_read_one_by_one(kind: str, request: pytest.FixtureRequest) -> None:
    prepared: list[int] = []

    def prepare(image: np.ndarray) -> np.ndarray:
        prepared.append(int(image.sum()))
        return image

    with MaskReader(request.getfixturevalue(kind), SIZE, prepare=prepare) as reader:
        for first, stop in ((0, 3), (2, 8), (-2, 2), (COUNT - 2, COUNT + 3), (-3, -1), (COUNT, COUNT + 2), (4, 4)):
            some = reader.read_some(first, stop)
            decoded = len(prepared)
            each = [reader.read(k) for k in range(first, stop)]
            assert [a is None for a in some] == [b is None for b in each]
            assert all(np.array_equal(a, b) for a, b in zip(some, each, strict=True) if a is not None)
            assert decoded == sum(mask is not None for mask in some), "only what was asked for"
            reader.close()
            prepared.clear()


def test_closing_ends_a_thread_that_waits_for_room(video: Path) -> None:
    others = set(threading.enumerate())
    with MaskReader(video, SIZE) as reader:
        for first in range(0, 8, 2):
            reader.read(first)
            reader.read(first + 1)
            (waiting,) = (t for t in set(threading.enumerate()) - others if t.name == "jawusd-ahead_0")
            time.sleep(0.05)  # until the thread waits for room
            assert waiting.is_alive()
            reader.close()
            assert not waiting.is_alive()
            check(reader, first + 1, BLACK)


def test_a_video_that_was_made_anew_is_read_anew(video: Path) -> None:
    assert MaskReader(video, SIZE).count == COUNT
    with VideoWriter(video, SIZE, 24, lossless=True) as out:
        for k in range(COUNT + 5):
            out.write(mask(k % COUNT))
    assert MaskReader(video, SIZE).count == COUNT + 5


def test_errors_come_with_their_frame_when_read_ahead(pattern: Path) -> None:
    bad = pattern.parent / "000008.png"
    bad.write_bytes(bad.read_bytes()[:40])
    with MaskReader(pattern, SIZE) as reader:
        for k in range(8):
            check(reader, k, BLACK + MISSING)
        for _ in range(2):
            with pytest.raises(CaptureError, match=r"000008\.png: the mask cannot be decoded.*delete it"):
                reader.read(8)
        check(reader, 10, BLACK + MISSING)


def test_wrong_size_names_file_found_and_allowed(pattern: Path, video: Path) -> None:
    with pytest.raises(CaptureError, match=r"000000\.png: the mask is 64 x 40 px, .* are 128 x 80 px"):
        MaskReader(pattern, (128, 80)).read(2)
    with pytest.raises(CaptureError, match=r"upper\.mkv: the mask is 64 x 40 px, .* are 40 x 64 px"):
        MaskReader(video, (40, 64))


def test_sources_that_are_not_there(tmp_path: Path, pattern: Path, video: Path) -> None:
    for path, message in {
        tmp_path / "gone" / "%06d.png": "there is no folder .*gone",
        pattern.parent / "mask_%06d.png": "no file in the folder",
        pattern.parent / "%06d_%02d.png": "two numbers",
        pattern.parent / "%s.png": "needs a number",
        tmp_path / "gone.mkv": "no such video",
    }.items():
        with pytest.raises(CaptureError, match=message):
            MaskReader(path, SIZE)
    assert MaskReader(video, SIZE, timeline=Timeline(np.arange(COUNT) / 24, 24)).count == COUNT
    with pytest.raises(CaptureError, match=r"has 14 images, but the camera's video has 15"):
        MaskReader(video, SIZE, timeline=Timeline(np.arange(15) / 24, 24))


def test_numbers_without_padding(tmp_path: Path) -> None:
    for k in (7, 12, 1234567):
        cv2.imwrite(str(tmp_path / f"m{k}.png"), mask(1))
        cv2.imwrite(str(tmp_path / f"p{k:06d}.png"), mask(2))
    for pattern, expected in (("m%d.png", mask(1)), ("p%06d.png", mask(2))):
        reader = MaskReader(tmp_path / pattern, SIZE)
        assert reader.count == 1234568 and reader.read(8) is None
        for k in (7, 12, 1234567):
            assert np.array_equal(reader.read(k), expected)


def write_png(path: Path, rows: np.ndarray, depth: int, colour_type: int) -> None:
    """Write the bytes of each row as a PNG of any colour type (PNG specification, section 11)."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", *SIZE, depth, colour_type, 0, 0, 0)
    data = zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b""))


def test_all_png_encodings(tmp_path: Path) -> None:
    expected = mask(1)
    full = np.full_like(expected, 255)
    soft = expected // 255 * 200
    encodings = {
        "gray": (expected, 8, 0),
        "bool": (np.packbits(expected > 0, axis=1), 1, 0),
        "zero_one": (expected // 255, 8, 0),
        "sixteen": (expected.astype(">u2") * 257, 16, 0),
        "la_in_alpha": (np.dstack([full, expected]), 8, 4),
        "la_black_in_alpha": (np.dstack([0 * full, expected]), 8, 4),
        "la_in_gray": (np.dstack([expected, full]), 8, 4),
        "rgba_in_alpha": (np.dstack([full, 0 * full, full, expected]), 8, 6),
        "rgba_in_colour": (np.dstack([expected, 0 * full, 0 * full, full]), 8, 6),
        "red": (np.dstack([expected, 0 * full, 0 * full]), 8, 2),
    }
    for name, (rows, depth, colour_type) in encodings.items():
        write_png(tmp_path / f"{name}_4.png", rows, depth, colour_type)
        found = MaskReader(tmp_path / f"{name}_%d.png", SIZE).read(4)
        assert np.array_equal(found, expected), name
    write_png(tmp_path / "soft_4.png", soft, 8, 0)
    assert np.array_equal(MaskReader(tmp_path / "soft_%d.png", SIZE).read(4), expected)  # 200 is its white
    write_png(tmp_path / "clear_4.png", np.dstack([full, 0 * full]), 8, 4)
    assert MaskReader(tmp_path / "clear_%d.png", SIZE).read(4) is None


@pytest.mark.parametrize("kind", ["pattern", "video"])
def test_size_of_masks_is_read_from_the_files(request, kind):
    assert mask_size_px(request.getfixturevalue(kind)) == SIZE


def test_pictures_lie_in_folders_of_any_name(tmp_path):
    """OpenCV's own readers and writers of files end the process over names that are not UTF-8."""
    folder = tmp_path / "a\udcff"
    folder.mkdir()
    write_mask(str(folder / "1.png"), mask(0))
    assert np.array_equal(read_gray(folder / "1.png"), mask(0))
    package = Path(jawusd.__file__).parent
    by_name = re.compile(r"cv2\.(imread|imwrite|VideoC|VideoW)")
    assert [path for path in package.rglob("*.py") if by_name.search(path.read_text())] == []


def test_masks_in_memory_are_read_like_files(pattern: Path) -> None:
    camera = FrameMasks("cam0", 4, np.stack([mask(4), np.zeros_like(mask(4))]))
    upper, lower = open_masks(camera, SIZE)
    with MaskReader(pattern, SIZE) as files:
        assert np.array_equal(upper.read(4), files.read(4))
    assert upper.read(3) is None and upper.read(5) is None and lower.read(4) is None
    assert lower.is_black and not upper.is_black
    prepared, _ = open_masks(camera, SIZE, prepare=lambda image: image[::2])
    assert prepared.read_some(3, 6)[1].shape == (SIZE[1] // 2, SIZE[0])
