"""Damage clips in single places and print which share of the damage reading them finds.

    python tests/benchmarks/clip_damage.py [--places 500] [--codecs h264 hevc prores ffv1] [--threads 1 8]

The clips are made by one encoder thread: 36 pictures of 160 x 96 px, key frames every 12 in H.264 and HEVC, ProRes HQ,
FFV1 with checksums. Each place, evenly over the file, is damaged alone: one bit flipped, or 16 bytes zeroed. "found":
opening or reading the clip raises an error, or a frame has no picture; "no effect": all pictures and times are as
before; "missed": other pictures, and no error. The share is that of what has an effect.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))

from damaged_clips import CODECS, single_damages, write_clip

from jawusd.base.errors import CaptureError
from jawusd.media.video import Video


def read(path: Path, threads: int) -> list[tuple[float, str]] | None:
    """Return time and hash of every picture; None if there is an error, or a frame without a picture."""
    try:
        video = Video(path)
        frames = video.frames(colour="rgb", threads=threads)
        pictures = [(round(frame.time_s, 6), hashlib.md5(frame.image).hexdigest()) for frame in frames]
    except CaptureError:
        return None
    return None if video.timeline.missing else pictures


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--places", type=int, default=500)
    parser.add_argument("--codecs", nargs="*", default=list(CODECS), choices=list(CODECS))
    parser.add_argument("--threads", type=int, nargs="*", default=[1, 8])
    given = parser.parse_args()
    print(f"{'codec':7} {'damage':7} {'threads':>7} {'found':>6} {'missed':>7} {'no effect':>10} {'share':>7}")
    with tempfile.TemporaryDirectory() as scratch:
        for codec in given.codecs:
            path = write_clip(Path(scratch), codec)
            data, whole = path.read_bytes(), read(path, 1)
            for kind in ("bit", "zeroed"):
                for threads in given.threads:
                    counts = Counter[str]()
                    for damaged in single_damages(data, given.places, kind):
                        path.write_bytes(damaged)
                        seen = read(path, threads)
                        counts["found" if seen is None else "no effect" if seen == whole else "missed"] += 1
                    found, missed, none = (counts[key] for key in ("found", "missed", "no effect"))
                    share = found / max(found + missed, 1)
                    print(f"{codec:7} {kind:7} {threads:7} {found:6} {missed:7} {none:10} {share:7.1%}", flush=True)


if __name__ == "__main__":
    main()
