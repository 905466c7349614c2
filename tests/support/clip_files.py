"""Write the same pictures as clips of many kinds, each with ffmpeg's own encoder."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

#: Formats by suffix: encoder, its pixels, the array's, and how many steps white has; None for fractions.
KINDS = {
    "png8": (".png", "png", "rgb24", "rgb24", 255),
    "png16": (".png", "png", "rgb48be", "rgb48le", 65535),
    "tiff16": (".tif", "tiff", "rgb48le", "rgb48le", 65535),
    "dpx10": (".dpx", "dpx", "gbrp10be", "rgb48le", 65535),
    "exr": (".exr", "exr", "gbrpf32le", "gbrpf32le", None),
}


def linear_light(image: np.ndarray) -> np.ndarray:
    """Return the light of an sRGB picture (IEC 61966-2-1), 0 .. 1, float32."""
    v = image / 255.0
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4).astype(np.float32)


def write_picture(path: Path, image: np.ndarray, kind: str) -> Path:
    """Write an RGB picture (h, w, 3) uint8 as one of `KINDS`."""
    _, codec, stored, given, white = KINDS[kind]
    path.parent.mkdir(parents=True, exist_ok=True)
    if white is None:
        array = np.ascontiguousarray(linear_light(image))
    else:
        array = image if white == 255 else image.astype(np.uint16) * 257
    with av.open(str(path), "w", format="image2", options={"update": "1"}) as container:
        stream = container.add_stream(codec, rate=24)
        stream.height, stream.width = image.shape[:2]
        stream.pix_fmt = stored
        stream.options = {"format": "half"} if kind == "exr" else {}
        frame = av.VideoFrame.from_ndarray(array, format=given)
        for packet in [*stream.encode(frame), *stream.encode(None)]:
            container.mux(packet)
    return path


def write_sequence(
    folder: Path, images: np.ndarray, kind: str, first: int = 1001, left_out: tuple[int, ...] = ()
) -> Path:
    """Write pictures (n, h, w, 3) as numbered files but for some numbers, and return their pattern."""
    suffix = KINDS[kind][0]
    for number, image in enumerate(images, first):
        if number not in left_out:
            write_picture(folder / f"take.{number:04d}{suffix}", image, kind)
    return folder / f"take.%04d{suffix}"


def write_prores(path: Path, images: np.ndarray, fps: Fraction, timecode: str = "") -> Path:
    """Write pictures (n, h, w, 3) RGB as ProRes 422 HQ, 10 bits, BT.709."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", options={"write_tmcd": "1"}) as container:
        if timecode:
            container.metadata["timecode"] = timecode
        stream = container.add_stream("prores_ks", rate=fps, options={"profile": "3"})
        stream.height, stream.width = images.shape[1:3]
        stream.pix_fmt = "yuv422p10le"
        stream.codec_context.colorspace = 1
        for k, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame = frame.reformat(format="yuv422p10le", dst_colorspace="itu709")
            frame.pts, frame.time_base = k, 1 / fps
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode(None):
            container.mux(packet)
    return path


def counting_at(path: Path, rate: Fraction, start: int) -> Path:
    """Let the time code track of a QuickTime file count at a rate [frames per second] from a number of frames."""
    with av.open(str(path)) as container:
        at = next(packet.pos for packet in container.demux() if packet.size == 4)
    data = bytearray(path.read_bytes())
    data[at : at + 4] = struct.pack(">I", start)
    entry = data.rindex(b"tmcd", 0, data.rindex(b"stts"))
    struct.pack_into(">2IB", data, entry + 20, rate.numerator, rate.denominator, -(-rate.numerator // rate.denominator))
    path.write_bytes(data)
    return path


def with_exr_header(path: Path, **values: bytes) -> Path:
    """Put attributes into the header of an EXR file: name_type = value, as timeCode_timecode = 8 bytes."""
    data = path.read_bytes()
    added = b""
    for key, value in values.items():
        name, kind = key.split("_")
        added += name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
    # The table of lines after the header holds places in the file, which move.
    at = _end_of_header(data)
    height = _lines(data)
    table = struct.unpack_from(f"<{height}Q", data, at + 1)
    moved = struct.pack(f"<{height}Q", *(place + len(added) for place in table))
    path.write_bytes(data[:at] + added + b"\0" + moved + data[at + 1 + 8 * height :])
    return path


def _attributes(data: bytes):
    at = 8
    while data[at]:
        name, kind, _ = data[at:].split(b"\0", 2)
        at += len(name) + len(kind) + 2
        (size,) = struct.unpack_from("<i", data, at)
        yield name, at + 4, size
        at += 4 + size
    yield b"", at, 0


def _end_of_header(data: bytes) -> int:
    return next(at for name, at, _ in _attributes(data) if not name)


def _lines(data: bytes) -> int:
    """Return how many blocks of lines an EXR file without tiles has."""
    found = {name: data[at : at + size] for name, at, size in _attributes(data)}
    x0, y0, x1, y1 = struct.unpack("<4i", found[b"dataWindow"])
    per_block = {0: 1, 1: 1, 2: 1, 3: 16}[found[b"compression"][0]]
    return -(-(y1 - y0 + 1) // per_block)
