"""Score sync against the truth of a synthetic capture: python tests/benchmarks/sync.py CAPTURE.

Prints the offset found per camera on the videos as they are, on copies re-encoded to a variable rate (every fifth
picture left out at random, time stamps jittered by 4 ms), and on copies that ask for a quarter turn.
"""

from __future__ import annotations

import argparse
import tempfile
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from jawusd.base.errors import SyncError
from jawusd.capture.sync import align_videos
from jawusd.formats.capture import load_capture
from jawusd.media.video import Video

SIZE = (480, 270)
TICK = Fraction(1, 90000)


def copy(source: Path, target: Path, *, variable: bool, rotation_deg: int, seed: int) -> None:
    """Re-encode a video at a quarter of its size, with a variable rate or a turn."""
    rng = np.random.default_rng(seed)
    video = Video(source)
    with av.open(str(target), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(video.fps).limit_denominator(1001))
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        stream.codec_context.time_base = stream.time_base = TICK
        stream.options = {"preset": "ultrafast"}
        if rotation_deg:
            stream.set_display_rotation(rotation_deg)
        for picture in video.frames(threads=1):
            if variable and picture.index and rng.uniform() < 0.2:
                continue
            jitter = rng.uniform(-0.004, 0.004) if variable and picture.index else 0.0
            small = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture.image[::4, ::4]), format="gray")
            small.pts, small.time_base = round((picture.time_s + jitter) / TICK), TICK
            container.mux(stream.encode(small))
        container.mux(stream.encode(None))


def line(name: str, videos: dict[str, Path], reference: str, truth: dict[str, int]) -> str:
    """Return a line of the table."""
    try:
        found = align_videos(videos, reference)
    except SyncError as error:
        return f"{name:<20}{error}"
    cells = "".join(
        f"{offset.frames:>8d} {offset.exact_frames:>+8.2f}{' ' if offset.frames == truth[camera] else '!'}"
        for camera, offset in found.cameras.items()
    )
    return f"{name:<20}{cells}  {found.method}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    capture = load_capture(parser.parse_args().capture)
    with np.load(capture.folder / "truth" / "truth.npz", allow_pickle=False) as archive:
        truth = dict(zip(archive["camera_names"].tolist(), archive["offsets"].tolist()))
    videos = {camera.name: camera.video for camera in capture.cameras if camera.video is not None}
    print(f"{'[frames]':<20}" + "".join(f"{f'{name} is {truth[name]}':>18}" for name in videos))
    print(line("as recorded", videos, capture.reference, truth), flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for kind, variable, turn in (("variable rate", True, 0), ("quarter turn", False, 90)):
            copies = {name: Path(folder) / f"{kind} {name}.mp4" for name in videos}
            for seed, (name, path) in enumerate(copies.items()):
                copy(videos[name], path, variable=variable, rotation_deg=turn if seed else 0, seed=seed)
            print(line(kind, copies, capture.reference, truth), flush=True)


if __name__ == "__main__":
    main()
