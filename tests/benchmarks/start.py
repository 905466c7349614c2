"""Score how tracking starts: python tests/benchmarks/start.py CAPTURE [--clicks 50] [--skip 0] [--frames 10]

For captures that come with their truth (truth/truth.npz), which serves to score, and to make clicks where a person
would see the vertex.

clicks: random frames, four random visible crown vertices per row, clicked in two cameras with a normal error of the
    given size along each axis; the poses found from them and aligned with the masks are compared with the truth.
search: evenly spread frames, no clicks; the poses found are compared with the truth.

The figures are the mean distances of crown vertices from the truth [mm].
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from jawusd.base.errors import TrackingError
from jawusd.formats.capture import Bootstrap, load_capture
from jawusd.geometry import transform_point, transform_points
from jawusd.meshes.raster import draw_depth_labels, project
from jawusd.pipeline.calibrate import sync_cameras
from jawusd.pipeline.cameras import load_cameras
from jawusd.pipeline.subject import load_meshes
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import View, masked_sources
from jawusd.tracking.initialization.bootstrap import pose_from_picks
from jawusd.tracking.initialization.first_frame import first_record
from jawusd.tracking.initialization.footage import Footage
from jawusd.tracking.initialization.scan_checks import check_occlusion
from jawusd.tracking.initialization.start import find_start
from jawusd.tracking.initialization.start_search import StartSearch

ROWS = ("upper", "lower")
CLICK_LIMIT_MM, SEARCH_LIMIT_MM = 0.2, 0.3


class Bench:
    """Hold a capture with its truth and a solver for it."""

    def __init__(self, folder: Path) -> None:
        """Load everything."""
        self.capture = capture = load_capture(folder, allow_outside=True)
        with np.load(capture.folder / "truth" / "truth.npz", allow_pickle=False) as archive:
            self.frames = archive["frames"]
            self.truth = np.stack([archive[f"T_world_{row}"] for row in ROWS], axis=1)
        self.cameras = {camera.name: camera for camera in load_cameras(capture)}
        offsets = sync_cameras(capture, lambda *_: None)["offsets"]
        sources = masked_sources(capture.cameras, self.cameras, offsets)
        self.footage = Footage(sources, self.cameras, offsets, capture.frames)
        meshes = load_meshes(capture)
        self.meshes = (meshes["upper_teeth"], meshes["lower_teeth"])
        scans = tuple(prepare_scan(mesh, row) for mesh, row in zip(self.meshes, ROWS, strict=True))
        self.solver = ContourSolver(scans, TrackingConfig())

    def errors_mm(self, poses: np.ndarray, frame: int) -> np.ndarray:
        """Return the mean distance of the crowns from the truth, shape (2,)."""
        truth = self.truth[np.flatnonzero(self.frames == frame)[0]]
        gaps = [
            transform_points(poses[r], scan.probes) - transform_points(truth[r], scan.probes)
            for r, scan in enumerate(self.solver.scans)
        ]
        return np.array([np.linalg.norm(gap, axis=1).mean() for gap in gaps])

    def aligned(self, poses: np.ndarray, frame: int) -> np.ndarray:
        """Return the poses as tracking would begin with them; raises TrackingError where it would not."""
        with self.footage.views(poses[0, :3, 3], self.solver.config.working_px_per_mm) as masks:
            return first_record(self.solver, poses, masks.at(frame), frame).solution.poses


def seen(bench: Bench, truth: np.ndarray, view: View) -> list[np.ndarray]:
    """Return which vertices of both scan files lie open to a camera and inside their row's mask, shape (V,) each."""
    height, width = view.masks.shape[1:]
    depth, no_labels = np.zeros((height, width), np.float32), np.zeros((0, 0), np.uint8)
    drawn = []
    for mesh, pose in zip(bench.meshes, truth, strict=True):
        points = np.empty((len(mesh.vertices), 3), np.float32)
        project(mesh.vertices.astype(np.float32), (view.matrix @ pose).astype(np.float32), points)
        draw_depth_labels(points, mesh.faces, 0, 0, False, depth, no_labels, 1)
        drawn.append(points)
    out = []
    for points, mask in zip(drawn, view.masks, strict=True):
        x, y = np.rint(points[:, :2]).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        x, y = np.where(inside, x, 0), np.where(inside, y, 0)
        nearest = 1.0 / np.maximum(depth[y, x], 1e-9)
        out.append(inside & (points[:, 2] < nearest + 0.3) & (mask[y, x] > 127))
    return out


def clicks(bench: Bench, frame: int, noise_px: float, rng: np.random.Generator) -> Bootstrap | None:
    """Return four picks per row with careless clicks; None where a row shows fewer vertices to two cameras."""
    truth = bench.truth[np.flatnonzero(bench.frames == frame)[0]]
    with bench.footage.views(truth[0, :3, 3], bench.solver.config.working_px_per_mm) as masks:
        visible = [seen(bench, truth, view) for view in masks.at(frame)]
    cameras = [bench.cameras[source.name] for source in bench.footage.sources]
    picks = {}
    for r, row in enumerate(ROWS):
        table = np.stack([v[r] for v in visible])
        vertices = np.flatnonzero(table.sum(0) >= 2)
        if len(vertices) < 50:
            return None
        picks[row] = []
        for vertex in rng.choice(vertices, 4, replace=False):
            point = transform_point(truth[r], bench.meshes[r].vertices[vertex])
            views = []
            for c in rng.permutation(np.flatnonzero(table[:, vertex]))[:2]:
                x, y = cameras[c].project(point) + noise_px * rng.normal(size=2)
                views.append({"camera": cameras[c].name, "x": float(x), "y": float(y)})
            picks[row].append({"vertex": int(vertex), "views": views})
    return Bootstrap(frame=frame, **picks)


def score_clicks(bench: Bench, trials: range, noise_px: float) -> None:
    """Print the outcome of starts from careless clicks."""
    rng = np.random.default_rng(5)
    print(f"clicks with {noise_px:g} px error per axis, four per row\nframe    from clicks       aligned         [mm]")
    good = drawn = 0
    while drawn < trials.stop:
        frame = int(rng.choice(bench.frames))
        bootstrap = clicks(bench, frame, noise_px, rng)
        if bootstrap is None:
            continue
        drawn += 1
        if drawn <= trials.start:
            continue
        capture = bench.capture.model_copy(update={"bootstrap": bootstrap})
        try:
            poses = [
                pose_from_picks(getattr(bootstrap, row), mesh.vertices, bench.cameras, row)[0]
                for row, mesh in zip(ROWS, bench.meshes, strict=True)
            ]
            first = bench.errors_mm(np.stack(poses), frame)
            start = find_start(capture, bench.cameras, bench.footage.offsets, bench.meshes, bench.solver)
            end = bench.errors_mm(bench.aligned(start.poses, frame), frame)
        except TrackingError as error:
            print(f"{frame:5}  {error}", flush=True)
            continue
        good += int(end.max() <= CLICK_LIMIT_MM)
        line = f"{frame:5} {first[0]:8.2f}{first[1]:7.2f} {end[0]:8.3f}{end[1]:7.3f}  {start.notes['by']}"
        if end.max() > CLICK_LIMIT_MM:
            same = bench.errors_mm(bench.aligned(bench.truth[np.flatnonzero(bench.frames == frame)[0]], frame), frame)
            line += f", {same[0]:.3f} {same[1]:.3f} when started from the truth"
        print(line, flush=True)
    print(f"{good} of {len(trials)} within {CLICK_LIMIT_MM} mm of the truth for both rows")


def score_search(bench: Bench, count: int, threads: int) -> None:
    """Print the outcome of starts without clicks."""
    print(f"no clicks, {threads} threads\nframe    upper  lower [mm]   worth    fit   CPU [s]")
    good = 0
    frames = bench.frames[np.linspace(0, len(bench.frames) - 1, count).round().astype(int)]
    with ThreadPoolExecutor(threads) as pool:
        T_anatomical_scan, _ = check_occlusion(bench.solver.scans, None)
        search = StartSearch(bench.meshes, bench.solver, T_anatomical_scan, pool.map)
        for frame in frames.tolist():
            begin = time.process_time()
            try:
                found = search.at(bench.footage, frame)
                spent = time.process_time() - begin
                error = bench.errors_mm(found.poses, frame)
                print(
                    f"{frame:5} {error[0]:8.3f}{error[1]:7.3f} {found.objective_px:8.0f} {found.fit:6.2f} {spent:9.1f}",
                    end="",
                    flush=True,
                )
                bench.aligned(found.poses, frame)
            except TrackingError as refusal:
                print(f"  refused: frame {frame}: {refusal.message}", flush=True)
                continue
            good += int(error.max() <= SEARCH_LIMIT_MM)
            print(flush=True)
    print(f"{good} of {count} accepted and within {SEARCH_LIMIT_MM} mm for both rows")


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--clicks", type=int, default=50, help="trials, 0 for none")
    parser.add_argument("--skip", type=int, default=0, help="trials drawn but not run, to run all in parts")
    parser.add_argument("--noise-px", type=float, default=5.0, help="standard deviation of clicks along each axis")
    parser.add_argument("--frames", type=int, default=10, help="frames searched, 0 for none")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    bench = Bench(options.capture)
    if options.clicks:
        score_clicks(bench, range(options.skip, options.skip + options.clicks), options.noise_px)
    if options.frames:
        score_search(bench, options.frames, options.threads)


if __name__ == "__main__":
    main()
