"""Time the tracker: python tests/benchmarks/tracking_time.py [CAPTURE.toml]

Without a capture: a made-up mouth of 8000 crown triangles in three views of 640 x 400. With one that has synchronised
cameras (`sync.offsets`) or a truth folder with offsets: its first 60 frames. One table to stdout, milliseconds of
processor time per frame: reading masks, one alignment of both rows, and a whole frame with everything; then wall time
with one and two threads.
"""

from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

import sys  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from dataclasses import dataclass  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
import small_take  # noqa: E402

from jawusd.cameras.calibration import load_calibration  # noqa: E402
from jawusd.formats.capture import Capture, load_capture  # noqa: E402
from jawusd.formats.mesh import Mesh  # noqa: E402
from jawusd.geometry import Camera, transform_point  # noqa: E402
from jawusd.meshes.meshio import load_mesh  # noqa: E402
from jawusd.tracking import TrackingConfig, track_capture  # noqa: E402
from jawusd.tracking.contour.scan import prepare_scan  # noqa: E402
from jawusd.tracking.contour.solver import ContourSolver  # noqa: E402
from jawusd.tracking.contour.views import MaskViews  # noqa: E402

FRAMES = 60


@dataclass
class Take:
    """Hold what the tracker is given."""

    capture: Capture
    cameras: list[Camera]
    offsets: dict[str, int]
    upper: Mesh
    lower: Mesh


def given(path: str) -> Take:
    """Return a capture's first frames; offsets from the capture or from a truth file next to it."""
    capture = load_capture(path)
    offsets = capture.sync.offsets
    if offsets is None:
        with np.load(capture.folder / "truth" / "truth.npz", allow_pickle=False) as truth:
            offsets = {str(n): int(o) for n, o in zip(truth["camera_names"], truth["offsets"])}
    first = capture.bootstrap.frame
    capture = capture.model_copy(update={"frames": (first, first + FRAMES)})
    scans = [load_mesh(p) for p in (capture.scans.upper_teeth, capture.scans.lower_teeth)]
    return Take(capture, load_calibration(capture.calibration), offsets, *scans)


def made_up(folder: Path) -> Take:
    """Return the take the tests use, longer."""
    capture = small_take.make_capture(small_take.write_masks(folder / "take", FRAMES), FRAMES)
    return Take(capture, small_take.CAMERAS, small_take.OFFSETS, *small_take.MESHES)


def report(take: Take) -> None:
    """Measure and print."""
    config = TrackingConfig()
    arguments = (take.capture, take.cameras, take.offsets, take.upper, take.lower, small_take.LANDMARKS)
    clock = time.process_time()
    scans = (prepare_scan(take.upper, "upper"), prepare_scan(take.lower, "lower"))
    print(f"scan preparation          {1e3 * (time.process_time() - clock):8.1f} ms once")
    rows = {}
    for threads in (1, 2):
        track_capture(*arguments, threads=threads)  # compiled and warm
        wall, clock = time.perf_counter(), time.process_time()
        tracks = track_capture(*arguments, threads=threads)
        rows[threads] = (time.perf_counter() - wall, time.process_time() - clock)
    poses = np.stack([tracks.raw_T_world_upper, tracks.raw_T_world_lower], 1)
    centre = np.mean([transform_point(poses[0, r], scans[r].centre) for r in (0, 1)], axis=0)
    table = {c.name: c for c in take.cameras}
    solver, gates = ContourSolver(scans, config), config.gates_from(0.0)
    with MaskViews(take.capture.cameras, table, take.offsets, centre, config.working_px_per_mm) as masks:
        clock = time.process_time()
        views = [v for _, v in masks.walk(*take.capture.frames)]
        reading = time.process_time() - clock
    clock = time.process_time()
    for k in range(2, len(views)):
        solver.solve(poses[k - 1] @ np.linalg.inv(poses[k - 2]) @ poses[k - 1], views[k], gates)
    solving = time.process_time() - clock
    per = 1e3 / len(views)
    print(f"reading masks             {reading * per:8.1f} ms/frame")
    print(f"one alignment, one thread {solving * 1e3 / (len(views) - 2):8.1f} ms/frame")
    for threads, (wall, clock) in rows.items():
        print(
            f"everything, {threads} thread(s)   {clock * per:8.1f} ms/frame of processor, {wall * per:.1f} of wall time"
        )


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        report(given(sys.argv[1]) if len(sys.argv) > 1 else made_up(Path(folder)))
