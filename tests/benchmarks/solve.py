"""Score `jawusd solve` on a capture that comes with its truth: python tests/benchmarks/solve.py CAPTURE [--pixels]

Builds the rig from the first frames (`jawusd track`, `jawusd fit`), then solves the last ones, which the rig never saw:
with all cameras, every pair, every camera alone, every camera alone with its calibrated focal length off by 8 per cent
and estimated (`--focal free`), and every camera alone on a helmet (`--head fixed`; the true motion of the head is taken
out of its pictures). Each solve finds its start by itself, but for helmets, which begin 1.5 mm and a degree off.

    incisor, condyles   distance to the truth of T_upper_lower there, mean / 95th percentile / largest over frames [mm]
    rms d               of the errors of d1, d2, d3 against the encoded truth [mm]
    NEES                mean over frames of e^T C^-1 e / 3 for the error e of d: 1 when sigma is honest
    core                processor time per frame and camera, reading and undistorting masks included [s]
    start               processor time of the start search [s]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from jawusd.evaluator import JawRig
from jawusd.formats.capture import Capture, load_capture
from jawusd.formats.model import JawModel, load_model, save_model
from jawusd.formats.performance import Performance, SolveState
from jawusd.geometry import se3_inverse, transform_point, transform_points
from jawusd.pipeline.cameras import load_cameras
from jawusd.pipeline.fit import fit_subject
from jawusd.pipeline.subject import load_meshes, subject_of_capture
from jawusd.pipeline.videos import VideoOptions, solve_videos
from jawusd.tracking import track_capture
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.contour.views import MaskViews
from jawusd.tracking.performance.coordinates import Coordinates, Pose
from jawusd.tracking.performance.shot import Shot, solve_capture, solve_performance

FOCAL_OFF = 1.08
PX_PER_MM = 7.2


@dataclass(frozen=True, eq=False)
class Bench:
    """Hold what all trials share."""

    capture: Capture
    cameras: list
    offsets: dict
    meshes: dict
    truth: dict
    jaw: JawRig
    frames: tuple[int, int]
    pixels: bool

    def shot(self, names: Sequence[str]) -> Capture:
        """Return the last frames in some cameras, without picks."""
        sources = tuple(source for source in self.capture.cameras if source.name in names)
        return self.capture.model_copy(update={"cameras": sources, "frames": self.frames, "bootstrap": None})

    def true(self, name: str) -> np.ndarray:
        """Return a table of the truth for the last frames."""
        at = np.searchsorted(self.truth["frames"], np.arange(*self.frames))
        return self.truth[name][at]


def rig_of(capture: Capture, cameras: list, offsets: dict, meshes: dict, frames: int, kept: Path | None) -> JawModel:
    """Return the model of the first frames, from a file if there is one."""
    if kept is not None and kept.exists():
        return load_model(kept)
    first = int(capture.frames[0])
    part = capture.model_copy(update={"frames": (first, first + frames)})
    subject = subject_of_capture(capture, meshes)
    scans = [meshes[f"{row}_teeth"] for row in ("upper", "lower")]
    tracks = track_capture(part, cameras, offsets, *scans, subject.landmarks)
    model = fit_subject(subject, tracks)
    if kept is not None:
        save_model(kept, model)
    return model


def solve(bench: Bench, names: Sequence[str], focal: float = 1.0) -> tuple[Performance, float, float]:
    """Solve the last frames; return the performance and the core seconds of the solve and of the start."""
    marks: list[float] = []
    cameras = [replace(c, K=c.K * [[focal], [focal], [1]] + _kept_centre(c.K, focal)) for c in bench.cameras]
    begin = time.process_time()
    if bench.pixels:
        table = {camera.name: camera for camera in cameras if camera.name in names}
        free = VideoOptions(free_focal=focal != 1.0)

        def mark(stage: str, done: int, total: int) -> None:
            if stage == "solve":
                marks.append(time.process_time())

        found = solve_videos(bench.shot(names), table, bench.offsets, bench.meshes, bench.jaw, free, mark)
        return found, time.process_time() - marks[0], marks[0] - begin
    found = solve_capture(
        bench.shot(names),
        cameras,
        bench.offsets,
        bench.meshes["upper_teeth"],
        bench.meshes["lower_teeth"],
        bench.jaw,
        free_focal=focal != 1.0,
        progress=lambda done, total: marks.append(time.process_time()),
    )
    return found, time.process_time() - marks[0], marks[0] - begin


def _kept_centre(K: np.ndarray, focal: float) -> np.ndarray:
    out = np.zeros((3, 3))
    out[:2, 2] = (1 - focal) * K[:2, 2]
    return out


class WornViews:
    """Show what cameras fixed to the head would see."""

    def __init__(self, source: MaskViews, heads: dict[int, np.ndarray], worn: np.ndarray) -> None:
        """Take the true heads by frame, and where the head is before the worn cameras."""
        self._source, self._heads, self._worn = source, heads, worn

    def at(self, frame: int) -> list:
        """Return one picture per camera."""
        T = self._heads[frame] @ se3_inverse(self._worn)
        eye = se3_inverse(T)
        return [replace(v, matrix=v.matrix @ T, eye=transform_point(eye, v.eye)) for v in self._source.at(frame)]


def worn(bench: Bench, names: Sequence[str]) -> tuple[Performance, float, float]:
    """Solve the last frames as if the cameras were on a helmet."""
    scans = tuple(prepare_scan(bench.meshes[f"{row}_teeth"], row) for row in ("upper", "lower"))
    coordinates, rng = Coordinates(bench.jaw, scans), np.random.default_rng(1)
    heads = dict(zip(range(*bench.frames), bench.true("T_world_upper")))
    first = bench.frames[0]
    fixed = coordinates.turned(heads[first], np.r_[0.02, -0.03, 0.015, 1.0, -2.0, 2.0])
    start = Pose(
        coordinates.turned(fixed, np.r_[rng.normal(0, 0.02, 3), rng.normal(0, 1.5, 3)]),
        bench.jaw.encode(bench.true("T_upper_lower")[0])[0] + rng.normal(0, 1.0, 3),
    )
    table = {camera.name: camera for camera in bench.cameras}
    centre = transform_point(heads[first], scans[0].centre)
    begin = time.process_time()
    with MaskViews(bench.shot(names).cameras, table, bench.offsets, centre, PX_PER_MM, 1) as masks:
        views = WornViews(masks, heads, fixed)
        shot = Shot(views, tuple(names), bench.frames, first, start, bench.capture.fps, fixed_head=True)
        return solve_performance(bench.jaw, scans, shot), time.process_time() - begin, 0.0


def row(bench: Bench, label: str, outcome: tuple[Performance, float, float]) -> str:
    """Return a line of the table."""
    found, core_s, start_s = outcome
    jaw, relative = bench.jaw, bench.true("T_upper_lower")
    gap = transform_points(jaw.pose(found.d), jaw.landmarks) - transform_points(relative, jaw.landmarks)
    gap = np.linalg.norm(gap, axis=-1)
    error = found.d - jaw.encode(relative)[0]
    nees = np.einsum("fi,fij,fj->f", error, np.linalg.inv(found.covariance[:, 6:, 6:]), error).mean() / 3
    solved = int((found.state == SolveState.SOLVED).sum())
    rms = " ".join(f"{value:.3f}" for value in np.sqrt((error**2).mean(0)))
    each = core_s / len(found.frames) / len(found.camera_names)
    line = f"{label:<24}{_spread(gap[:, 0]):>21}{_spread(gap[:, 3:].mean(1)):>21}{rms:>20}{nees:7.2f}{each:8.3f}"
    focal = "".join(f"  focal {factor * FOCAL_OFF:.4f}" for factor, _ in found.notes.get("focal", {}).values())
    return f"{line}{start_s:8.1f}{solved:7d}/{len(found.frames)}{focal}"


def _spread(values: np.ndarray) -> str:
    return f"{values.mean():.3f}/{np.percentile(values, 95):.3f}/{values.max():.3f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--first", type=int, default=500, help="frames the rig is made of")
    parser.add_argument("--last", type=int, default=331, help="frames that are solved, from where the truth ends")
    parser.add_argument("--rig", type=Path, help="model.npz of the first frames, written if it does not exist")
    parser.add_argument("--pixels", action="store_true", help="solve from the videos, not from the masks; no helmets")
    parser.add_argument("--only", help="trials whose name holds this: cameras, focal, helmet, cam0")
    options = parser.parse_args()
    capture = load_capture(options.capture)
    cameras, meshes = load_cameras(capture), load_meshes(capture)
    with np.load(capture.folder / "truth" / "truth.npz", allow_pickle=False) as archive:
        truth = {name: archive[name] for name in archive.files}
    offsets = dict(zip(truth["camera_names"].tolist(), truth["offsets"].tolist(), strict=True))
    model = rig_of(capture, cameras, offsets, meshes, options.first, options.rig)
    begin = int(truth["frames"][0]) + options.first
    frames = (begin, min(begin + options.last, int(truth["frames"][-1]) + 1))
    bench = Bench(capture, cameras, offsets, meshes, truth, JawRig(model.arrays, model.meta), frames, options.pixels)
    names = [camera.name for camera in cameras]
    heads = f"{'incisor':>21}{'condyles':>21}{'rms d1 d2 d3':>20}{'NEES':>7}{'core':>8}{'start':>8}{'solved':>11}"
    print(f"{'[mm]':<24}{heads}")
    sets = [part for count in range(len(names), 0, -1) for part in combinations(names, count)]
    trials = [(f"cameras {' '.join(part)}", lambda part=part: solve(bench, part)) for part in sets]
    trials += [(f"focal +8% {name}", lambda name=name: solve(bench, [name], FOCAL_OFF)) for name in names]
    trials += [(f"helmet {name}", lambda name=name: worn(bench, [name])) for name in names]
    for label, run in trials:
        if (options.only or "") in label and not (options.pixels and "helmet" in label):
            print(row(bench, label, run()), flush=True)


if __name__ == "__main__":
    main()
