"""How long the viewer's server takes to show a frame of a capture: decode, draw the teeth, encode.

    python tests/benchmarks/footage.py CAPTURE TRACKS

TRACKS is the folder of a build of that capture, or tracks. Times are the processor's, and the clock's beside them.
"""

import sys
import time
from pathlib import Path

import numpy as np
from viser._scene_api import _encode_image_binary

from jawusd.pipeline.view_capture import viewed_capture

STEPS = 16


def measured(action, arguments):
    """Return processor and clock times of calls [ms], shape (n, 2)."""
    found = []
    for argument in arguments:
        processor, clock = time.process_time(), time.perf_counter()
        action(argument)
        found.append((time.process_time() - processor, time.perf_counter() - clock))
    return 1000 * np.array(found)


def main(capture, tracks):
    """Print the table."""
    viewed = viewed_capture(capture, Path(tracks), lambda *_: None)
    name = next(iter(viewed.sizes_px))
    first, last = viewed.frames
    middle = (first + last) // 2

    def show(frame, look="outlines"):
        image = viewed.picture(name, frame, viewed.tracked_poses(frame), look)
        _encode_image_binary(image, "jpeg", jpeg_quality=88)

    def show_all(frame):
        image = viewed.wall(frame, viewed.tracked_poses(frame), "outlines")
        _encode_image_binary(image, "jpeg", jpeg_quality=88)

    show(middle)
    show_all(middle)
    rng = np.random.default_rng(0)
    rows = {
        "next frame": range(middle + 1, middle + 1 + STEPS),
        "frame before": range(middle + STEPS, middle, -1),
        "frame before, not seen yet": range(middle - 1, middle - 1 - STEPS, -1),
        "jump": rng.integers(first, last, STEPS).tolist(),
    }
    print(f"{viewed.source.name}, {name}, {viewed.sizes_px[name]} px  [ms]   median  p95  max | clock median  p95  max")
    measures = [(title, show, frames) for title, frames in rows.items()]
    last_read = rows["next frame"][-1]
    measures.append((f"next frame, all {len(viewed.sizes_px)} cameras", show_all, range(last_read, last_read + STEPS)))
    show_all(last_read - 1)
    for title, action, frames in measures:
        ms = measured(action, frames)
        numbers = [f(ms[:, k]) for k in (0, 1) for f in (np.median, lambda v: np.percentile(v, 95), np.max)]
        print(f"{title:28s}" + "".join(f"{number:8.1f}" for number in numbers))


if __name__ == "__main__":
    main(*sys.argv[1:])
