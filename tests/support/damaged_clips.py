"""Write clips that are the same bytes every time, and damage them in known places."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

SIZE = (160, 96)
#: By codec: encoder, pixels, suffix, options. One thread: with more, x264 and x265 write other bytes every time.
CODECS = {
    "h264": ("libx264", "yuv420p", ".mp4", {"crf": "18", "g": "12", "bf": "2", "threads": "1"}),
    "hevc": ("libx265", "yuv420p", ".mp4", {"x265-params": "pools=none:frame-threads=1:keyint=12:log-level=0"}),
    "prores": ("prores_ks", "yuv422p10le", ".mov", {"profile": "3"}),
    "ffv1": ("ffv1", "yuv420p", ".mkv", {"level": "3", "g": "1"}),
}


def moving_picture(k: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Return a picture (h, w, 3) uint8 of blurred noise that moves, with a little noise of its own."""
    texture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (240, 520)).astype(np.float32), (0, 0), 1.5)
    shown = texture[10 + k % 40 :, 2 * k % 200 :][: size[1], : size[0]]
    noisy = 4 * (shown - 127) + 120 + np.random.default_rng(k).normal(size=shown.shape)
    gray = np.clip(noisy, 0, 255).astype(np.uint8)
    return np.dstack([gray, gray[::-1], np.roll(gray, 40, 1)])


def write_clip(folder: Path, codec: str, count: int = 36, size: tuple[int, int] = SIZE, **options: str) -> Path:
    """Write a clip of moving pictures with one of `CODECS`."""
    encoder, pixels, suffix, usual = CODECS[codec]
    path = folder / f"{codec}{suffix}"
    with av.open(str(path), "w") as container:
        stream = container.add_stream(encoder, rate=24)
        stream.width, stream.height, stream.pix_fmt = *size, pixels
        stream.options, stream.thread_count = usual | options, 1
        for k in range(count):
            frame = av.VideoFrame.from_ndarray(moving_picture(k, size), format="rgb24").reformat(format=pixels)
            frame.pts, frame.time_base = k, Fraction(1, 24)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def packets(path: Path) -> list[tuple[int, int]]:
    """Return place and size of each picture's data in the file [bytes], in the order of decoding."""
    data, found, at = path.read_bytes(), [], 0
    with av.open(str(path)) as container:
        for packet in container.demux(video=0):
            if packet.size:
                at = data.index(bytes(packet), at)
                found.append((at, packet.size))
    return found


def with_zeros(data: bytes, at: int, length: int = 16) -> bytes:
    """Return a copy with zeroed bytes."""
    return data[:at] + bytes(length) + data[at + length :]


def single_damages(data: bytes, places: int, kind: str) -> Iterator[bytes]:
    """Yield copies damaged in one of so many places, evenly over the file: a `bit` flipped, or 16 bytes `zeroed`."""
    bits = np.random.default_rng(1).integers(0, 8, places)
    for at, bit in zip(np.linspace(0, len(data) - 17, places).astype(int), bits):
        flipped = bytes([data[at] ^ 1 << int(bit)])
        yield data[:at] + flipped + data[at + 1 :] if kind == "bit" else with_zeros(data, at)


def write_gray(path: Path, pictures: np.ndarray, crf: int = 18, fps: int = 24) -> Path:
    """Write gray pictures (n, h, w) uint8 as H.264, by one thread."""
    with av.open(str(path), "w") as container:
        options = {"crf": str(crf), "preset": "veryfast", "threads": "1"}
        stream = container.add_stream("libx264", rate=fps, options=options)
        stream.height, stream.width = pictures.shape[1:]
        stream.pix_fmt = "yuv420p"
        for picture in pictures:
            frame = av.VideoFrame.from_ndarray(picture, format="gray")
            container.mux(stream.encode(frame.reformat(format="yuv420p")))
        container.mux(stream.encode(None))
    return path
