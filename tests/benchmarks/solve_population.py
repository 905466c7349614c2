"""Solve shots of many synthetic subjects: python tests/benchmarks/solve_population.py --persons 10.

The rig of each subject is built from a calibration take by three cameras; one annotator draws its masks. Each shot has
other cameras, another motion and another annotator (see `draw_shot`). It is solved with one, two and three cameras; the
single camera is the front camera in a third of the shots, and a side camera in the others. For each number of cameras,
the program prints:

    known       fraction of frames with a sigma of the incisal point below 1 mm
    both        fraction of frames that are known, and in which both arches were found
    error       error of the incisal point in known frames [mm]: mean, median and 90th percentile over shots
    worst       largest error of a known frame [mm]
    silent      fraction of known frames with an error above both 1 mm and 2 sigma
    z2          e^T C^-1 e / 3 for the error e of d: median and mean over shots; 1 if the covariance C is correct
    sigma       sigma of the incisal point [mm]: median over shots of the median over frames
    starts      number of shots in which the start pose was found
    core        processor time per frame and camera, without the start search [s]

With --spoilt, every fourth frame has a wrong mask of one arch in one of the first two cameras: eroded by 1 mm, moved by
3 mm, or that of a distant frame. All figures but `core` then refer to these frames.

With --head fixed, the cameras are head-mounted: the head does not move in the same shots, and is solved as constant.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))
from spoilt_masks import spoil
from subjects.short_capture import ShortConfig, draw_capture, draw_shot, write_capture
from subjects.short_take import SIZES_PX

from jawusd.base.errors import JawusdError, TrackingError
from jawusd.evaluator import JawRig
from jawusd.formats.capture import Capture, load_capture
from jawusd.formats.model import load_model, save_model
from jawusd.formats.performance import Performance, SolveState
from jawusd.geometry import transform_point
from jawusd.pipeline.cameras import load_cameras
from jawusd.pipeline.fit import fit_subject
from jawusd.pipeline.subject import load_meshes, subject_of_capture
from jawusd.pipeline.track import track
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.scan import prepare_scan, teeth_centre
from jawusd.tracking.contour.views import MaskViews
from jawusd.tracking.performance.coordinates import Coordinates, Pose
from jawusd.tracking.performance.results import tracks_of
from jawusd.tracking.performance.shot import Shot, solve_capture, solve_performance

KNOWN_MM = SILENT_MM = 1.0
NEAR = np.r_[[0.01] * 3, [1.0] * 6]  # standard deviations of a start near the truth [rad, mm, mm]


@dataclass
class Outcome:
    """Figures of a shot solved with some of its cameras; none if it was rejected."""

    seed: int
    draw: int
    cameras: int
    refused: str = ""
    frames: int = 0
    known: float = 0.0
    both: float = 0.0
    error_mm: float = float("nan")
    worst_mm: float = float("nan")
    silent: float = 0.0
    z2: float = float("nan")
    sigma_mm: float = float("nan")
    core_s: float = float("nan")


@dataclass(frozen=True)
class Task:
    """The shots of a subject."""

    seed: int
    draws: tuple[int, ...]
    frames: tuple[int, int]  # number of frames of the calibration take, and of each shot
    folder: Path
    near: bool  # whether to start near the truth, without a search
    counts: tuple[int, ...]  # numbers of cameras
    spoilt: bool = False  # whether single masks are wrong
    fixed_head: bool = False  # whether the cameras are head-mounted


def person(task: Task) -> list[Outcome]:
    """Build the rig of a subject, unless a file exists, and solve the shots."""
    cv2.setNumThreads(1)
    home = task.folder / f"person_{task.seed}_{task.frames[0]}"
    model = home / "model.npz"
    drawn = draw_capture(ShortConfig(task.seed, task.frames[0], cameras=3, size_px=SIZES_PX[0]))
    if not model.exists():
        write_capture(home, drawn)
        capture = load_capture(home)
        try:
            save_model(model, fit_subject(subject_of_capture(capture, load_meshes(capture)), track(home, jobs=1)))
        except JawusdError as error:
            return [Outcome(task.seed, -1, 0, f"rig: {error}")]
    loaded = load_model(model)
    jaw, out = JawRig(loaded.arrays, loaded.meta), []
    for draw in task.draws:
        shot = home / f"shot_{draw}_{task.frames[1]}{'_fixed' * task.fixed_head}{'_spoilt' * task.spoilt}"
        if not (shot / ("spoilt.npy" if task.spoilt else "capture.toml")).exists():  # written last
            write_capture(shot, draw_shot(drawn, draw, task.frames[1], fixed_head=task.fixed_head))
            if task.spoilt:
                spoil(shot, 2, np.random.default_rng([task.seed, draw]))
        for count in task.counts:
            out.append(solved(task, draw, shot, jaw, count))
    return out


def solved(task: Task, draw: int, folder: Path, jaw: JawRig, count: int) -> Outcome:
    """Solve a shot with a number of its cameras, and compare the result with the truth."""
    outcome, capture = Outcome(task.seed, draw, count), load_capture(folder)
    first = (task.seed + draw) % 3 if count == 1 else 0
    sources = capture.cameras[first : first + count]
    capture = capture.model_copy(update={"cameras": sources})
    with np.load(folder / "truth" / "truth.npz", allow_pickle=False) as archive:
        truth = {name: archive[name] for name in archive.files}
    try:
        found, outcome.core_s = (near_truth if task.near else searched)(capture, jaw, truth, task.fixed_head)
    except TrackingError as error:
        outcome.refused = str(error)
        return outcome
    scored = np.load(folder / "spoilt.npy") if task.spoilt else np.arange(len(found.frames))
    judge(outcome, found, jaw, truth["T_upper_lower"], scored)
    return outcome


def judge(outcome: Outcome, found: Performance, jaw: JawRig, relative: np.ndarray, scored: np.ndarray) -> None:
    """Write the figures of some frames of a solved shot to its outcome, from true poses of the jaw (F, 4, 4)."""
    gap = transform_point(jaw.pose(found.d), jaw.landmarks[0]) - transform_point(relative, jaw.landmarks[0])
    error, sigma = np.linalg.norm(gap, axis=-1), tracks_of(found, jaw).sigma_mm[:, 0]
    known = sigma < KNOWN_MM
    outcome.frames, outcome.known = len(scored), float(known[scored].mean())
    outcome.both = float((known & (found.state == SolveState.SOLVED))[scored].mean())
    known &= np.isin(np.arange(len(error)), scored)
    if known.any():
        away = (found.d - jaw.encode(relative)[0])[known]
        covariance = (found.covariance[:, 6:, 6:] + found.rig_covariance)[known]
        outcome.error_mm, outcome.worst_mm = float(error[known].mean()), float(error[known].max())
        outcome.silent = float((error > np.maximum(2 * sigma, SILENT_MM))[known].mean())
        outcome.z2 = float(np.einsum("fi,fij,fj->f", away, np.linalg.inv(covariance), away).mean() / 3)
        outcome.sigma_mm = float(np.median(sigma[known]))


def searched(
    capture: Capture, jaw: JawRig, truth: dict[str, np.ndarray], fixed_head: bool
) -> tuple[Performance, float]:
    """Solve as `jawusd solve` does; also return the processor time per frame and camera [s]."""
    meshes, marks = load_meshes(capture), []
    found = solve_capture(
        capture,
        load_cameras(capture),
        {source.name: 0 for source in capture.cameras},
        meshes["upper_teeth"],
        meshes["lower_teeth"],
        jaw,
        fixed_head=fixed_head,
        threads=1,
        progress=lambda done, total: marks.append(time.process_time()),
    )
    return found, (time.process_time() - marks[0]) / len(found.frames) / len(capture.cameras)


def near_truth(
    capture: Capture, jaw: JawRig, truth: dict[str, np.ndarray], fixed_head: bool
) -> tuple[Performance, float]:
    """Solve from a start near the truth, without a search."""
    table, meshes = {camera.name: camera for camera in load_cameras(capture)}, load_meshes(capture)
    scans = tuple(prepare_scan(meshes[f"{row}_teeth"], row) for row in ("upper", "lower"))
    coordinates, begin = Coordinates(jaw, scans), time.process_time()
    true = Pose(truth["T_world_upper"][0], jaw.encode(truth["T_upper_lower"][0])[0])
    start = coordinates.moved(true, np.random.default_rng(len(capture.cameras)).normal(0.0, NEAR))
    names, offsets = tuple(source.name for source in capture.cameras), {source.name: 0 for source in capture.cameras}
    first, config = int(truth["frames"][0]), TrackingConfig()
    centre = teeth_centre(scans, coordinates.arches(start))
    with MaskViews(capture.cameras, table, offsets, centre, config.working_px_per_mm, 1) as views:
        shot = Shot(views, names, capture.frames, first, start, capture.fps, fixed_head=fixed_head)
        found = solve_performance(jaw, scans, shot, config)
    return found, (time.process_time() - begin) / len(found.frames) / len(names)


def report(outcomes: list[Outcome]) -> None:
    """Print the table, and the messages of rejected shots."""
    for o in outcomes:
        if o.refused:
            print(f"person {o.seed} shot {o.draw}, {o.cameras} cameras: {o.refused[:160]}")
    heads = (
        "shots",
        "known",
        "both",
        "error",
        "median",
        "p90",
        "worst",
        "silent",
        "z2",
        "mean",
        "sigma",
        "starts",
        "core",
    )
    print("cameras" + "".join(f"{head:>8}" for head in heads))
    for count in sorted({o.cameras for o in outcomes} - {0}):
        own = [o for o in outcomes if o.cameras == count]
        good = [o for o in own if not o.refused]
        seen = [o for o in good if o.known]
        if not seen:
            print(f"{count:7d}{len(own):8d}     0.0%   (starts: {len(good)})")
            continue
        error, z2 = np.array([o.error_mm for o in seen]), np.array([o.z2 for o in seen])
        weight, known = np.array([o.frames * o.known for o in seen]), np.mean([o.known for o in good])
        silent = np.average([o.silent for o in seen], weights=weight)
        both = np.mean([o.both for o in good])
        cells = [f"{len(own):8d}{100 * known:7.1f}%{100 * both:7.1f}%{error.mean():8.3f}{np.median(error):8.3f}"]
        cells += [f"{np.percentile(error, 90):8.3f}{max(o.worst_mm for o in seen):8.2f}{100 * silent:7.2f}%"]
        cells += [f"{np.median(z2):8.2f}{z2.mean():8.2f}{np.median([o.sigma_mm for o in seen]):8.3f}"]
        cells += [f"{len(good):8d}{np.nanmedian([o.core_s for o in good]):8.3f}"]
        print(f"{count:7d}" + "".join(cells))


def main() -> None:
    """Solve all shots and print the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--persons", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0, help="seed of the first subject; the others follow")
    parser.add_argument("--draws", type=int, default=1, help="number of shots per subject")
    parser.add_argument("--frames", type=int, nargs=2, default=(48, 36), help="of calibration take and shot")
    parser.add_argument("--cameras", type=int, nargs="+", default=(1, 2, 3), help="numbers of cameras to solve with")
    parser.add_argument("--near", action="store_true", help="start near the truth, without a search")
    parser.add_argument("--spoilt", action="store_true", help="spoil single masks; with --cameras 2 3")
    parser.add_argument("--head", choices=("free", "fixed"), default="free", help="fixed: head-mounted cameras")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, help="file to append outcomes to (JSON lines)")
    parser.add_argument("--captures", type=Path, help="folder to keep captures and rigs in, and to reuse them from")
    options = parser.parse_args()
    with contextlib.ExitStack() as stack:
        folder = options.captures or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="jawusd_shots_")))
        rest = (tuple(range(options.draws)), tuple(options.frames), folder, options.near, tuple(options.cameras))
        rest += (options.spoilt, options.head == "fixed")
        outcomes: list[Outcome] = []
        pool = stack.enter_context(ProcessPoolExecutor(options.jobs))
        tasks = [Task(seed, *rest) for seed in range(options.seed, options.seed + options.persons)]
        for done, future in enumerate(as_completed([pool.submit(person, task) for task in tasks]), 1):
            outcomes += future.result()
            print(f"\r{done} of {len(tasks)} persons", end="", file=sys.stderr)
            if options.out:
                with open(options.out, "a") as lines:
                    lines.writelines(json.dumps(asdict(o)) + "\n" for o in future.result())
        print(file=sys.stderr)
    report(sorted(outcomes, key=lambda o: (o.seed, o.draw, o.cameras)))


if __name__ == "__main__":
    main()
