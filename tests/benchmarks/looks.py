"""Search for the teeth of rendered subjects of many looks: python tests/benchmarks/looks.py --subjects 30 --out DIR

There are neither masks nor picks. The looks vary in the colours of teeth, gum and skin, in exposure, white balance,
contrast and noise, from 720 to 1080 lines. In turn, the cameras are upright, turned by quarter turns, or two side
cameras. What DIR has already is kept. Printed per subject:

    start       frame in which the teeth were found, and the fraction of the visible contour that fits
    off         distance of the incisal point, relative to the upper teeth, from the truth [mm]
    head        distance of the upper incisal point from the truth [mm]

A start is right if both distances are at most 1 mm, or 3 mm with one camera. A take that is rejected is printed with
the message.

With --frames N, N consecutive frames are tracked instead, and compared with the truth as `luck.py` does:

    lost        frames in which an arch was not found
    mean, worst distance of the incisal point, relative to the upper teeth, from the truth over the other frames [mm]
    silent      frames off by more than 1 mm with a sigma of less than 0.5 mm

With --solve, the subjects have rigs, made from the true poses of another take, with noise. Starts are searched as
`jawusd solve` does, with all cameras and with the first one; with --frames, the frames are solved, and judged as
`solve_population.py` does.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))
from lips_take import write_look_capture
from looks import KINDS
from luck import scores
from solve_population import Outcome, judge, report

import jawusd
from jawusd.base.arrays import Array
from jawusd.base.errors import JawusdError
from jawusd.formats.capture import load_capture
from jawusd.formats.model import save_model
from jawusd.geometry import relative_pose, se3_exp, transform_point
from jawusd.pipeline.calibrate import sync_cameras
from jawusd.pipeline.cameras import load_cameras, open_colour_footage
from jawusd.pipeline.fit import fit_subject
from jawusd.pipeline.picture_search import PictureSearch, Start
from jawusd.pipeline.solve import solve
from jawusd.pipeline.state import no_progress
from jawusd.pipeline.subject import load_meshes, subject_of_capture
from jawusd.pipeline.track import track
from jawusd.pipeline.videos import Follower, PreparedTeeth, VideoOptions, VideoShot
from jawusd.synthetic.anatomy import build_anatomy
from jawusd.synthetic.person import Person
from jawusd.synthetic.take import perform
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.region.picture_start import ArchStart

RIGHT_MM, RIGHT_ALONE_MM = 1.0, 3.0
TRAINING = 300  # number of frames from which a rig is made
NOISE = np.r_[[2e-4] * 3, [0.05] * 3]  # of its poses, standard deviation per axis [rad, mm]


def found_start(folder: Path) -> Start[Array]:
    """Return the start of a capture as `jawusd track` finds it.

    Raises:
        JawusdError: no start fits.
    """
    capture = load_capture(folder / "capture.toml")
    offsets = sync_cameras(capture, no_progress)["offsets"]
    cameras, footage = open_colour_footage(capture, offsets, "the search")
    meshes = load_meshes(capture)
    teeth = meshes["upper_teeth"], meshes["lower_teeth"]
    scans = prepare_scan(teeth[0], "upper"), prepare_scan(teeth[1], "lower")
    rows = ArchStart(teeth, scans, capture.anatomy.T_anatomical_skull)
    follower = Follower(footage, cameras, scans, subject_of_capture(capture, meshes))
    search = PictureSearch(footage, cameras, offsets, rows, follower.start_at)
    return follower.start_by(search, range(*footage.range()), no_progress)


def solve_start(folder: Path, seed: int, cameras: int | None) -> Start[Array]:
    """Return the start of a capture as `jawusd solve` finds it with the first cameras; None: with all.

    Raises:
        JawusdError: no start fits.
    """
    model = folder / "model.npz"
    if not model.exists():
        write_rig(model, folder, seed)
    jaw, capture = jawusd.load(model), load_capture(folder / "capture.toml")
    capture = capture.model_copy(update={"cameras": capture.cameras[:cameras]})
    table = {camera.name: camera for camera in load_cameras(capture)}
    teeth = PreparedTeeth(capture, load_meshes(capture), jaw, map)
    offsets = sync_cameras(capture, no_progress)["offsets"]
    shot = VideoShot(capture, table, offsets, teeth, jaw, VideoOptions(jobs=1), no_progress)
    start = shot.begin()
    return replace(start, pose=shot.take.coordinates.arches(start.pose))


def errors_mm(folder: Path, start: Start[Array]) -> tuple[float, float]:
    """Return the distances of the incisal point relative to the upper teeth, and of the upper teeth, from the truth."""
    with np.load(folder / "truth" / "truth.npz") as truth:
        row = int(np.searchsorted(truth["frames"], start.frame))
        exact = np.stack([truth["T_world_upper"][row], truth["T_world_lower"][row]])
        incisor = truth["landmarks"][truth["landmark_names"].tolist().index("incisor")]
    jaws = [transform_point(relative_pose(*poses), incisor) for poses in (start.pose, exact)]
    heads = [transform_point(poses[0], incisor) for poses in (start.pose, exact)]
    return float(np.linalg.norm(jaws[0] - jaws[1])), float(np.linalg.norm(heads[0] - heads[1]))


def search_all(seeds: range, out: Path, with_rigs: bool) -> None:
    """Print the tables of the starts."""
    for cameras in (None, 1) if with_rigs else (None,):
        right = wrong = rejected = 0
        print(f"{'seed':<6}{'kind':<12}{'start':>6}{'fit':>6}{'off':>8}{'head':>8}{'core s':>8}")
        for seed in seeds:
            folder = out / f"look_{seed}"
            if not (folder / "capture.toml").exists():
                write_look_capture(folder, seed, 60, every=5)
            named, began = f"{seed:<6}{KINDS[seed % len(KINDS)]:<12}", time.process_time()
            try:
                start = solve_start(folder, seed, cameras) if with_rigs else found_start(folder)
            except JawusdError as error:
                rejected += 1
                print(f"{named}{time.process_time() - began:.0f} s: {error}", flush=True)
                continue
            jaw_mm, head_mm = errors_mm(folder, start)
            is_right = max(jaw_mm, head_mm) <= (RIGHT_MM if cameras is None else RIGHT_ALONE_MM)
            right, wrong = right + is_right, wrong + (not is_right)
            spent = time.process_time() - began
            print(f"{named}{start.frame:>6}{start.fit:>6.2f}{jaw_mm:>8.3f}{head_mm:>8.3f}{spent:>8.0f}", flush=True)
        print(f"starts with {cameras or 'all'} cameras: right {right}, wrong {wrong}, rejected {rejected}")


def track_all(seeds: range, out: Path, frames: int) -> None:
    """Print the table of tracked takes."""
    print(f"{'seed':<6}{'kind':<12}{'lost':>6}{'mean':>8}{'worst':>8}{'silent':>8}{'core s':>8}  findings")
    for seed in seeds:
        folder = take_of(out, seed, frames)
        named, began = f"{seed:<6}{KINDS[seed % len(KINDS)]:<12}", time.process_time()
        capture = load_capture(folder / "capture.toml")
        try:
            tracks = track(capture)
        except JawusdError as error:
            print(f"{named}{time.process_time() - began:.0f} s: {error}", flush=True)
            continue
        row, spent = scores(capture, tracks, tracks.frames, range(0)), time.process_time() - began
        numbers = f"{len(row['lost']):>6}{row['mean_mm']:>8.3f}{row['worst_mm']:>8.3f}{row['silent']:>8}{spent:>8.0f}"
        print(f"{named}{numbers}  {', '.join(row['findings'])}", flush=True)


def take_of(out: Path, seed: int, frames: int) -> Path:
    """Return the folder of consecutive frames of a look, rendered if it does not exist."""
    folder = out / f"look_{seed}_{frames}"
    if not (folder / "capture.toml").exists():
        write_look_capture(folder, seed, frames, every=1)
    return folder


def write_rig(path: Path, folder: Path, seed: int) -> None:
    """Write the model of a subject, from noisy poses of another take than that in the folder."""
    person, rng = Person(seed), np.random.default_rng([seed, 0x216])
    take = perform(person, build_anatomy(person).occlusion, TRAINING, (0,), seed + 1000)
    T = take.T_skull_mandible[take.tracked[0] : take.tracked[1]]
    noisy = se3_exp(NOISE * rng.normal(size=(len(T), 6))) @ T
    capture = load_capture(folder / "capture.toml")
    save_model(path, fit_subject(subject_of_capture(capture, load_meshes(capture)), (np.arange(len(T)), noisy)))


def solve_all(seeds: range, out: Path, frames: int) -> None:
    """Print the table of solved shots."""
    outcomes = []
    for seed in seeds:
        folder = take_of(out, seed, frames)
        model = folder / "model.npz"
        if not model.exists():
            write_rig(model, folder, seed)
        jaw, capture = jawusd.load(model), load_capture(folder / "capture.toml")
        with np.load(folder / "truth" / "truth.npz") as truth:
            relative = truth["T_upper_lower"]
        for count in (len(capture.cameras), 1):
            outcome, began = Outcome(seed, 0, count), time.process_time()
            outcomes.append(outcome)
            try:
                found = solve(model, capture.model_copy(update={"cameras": capture.cameras[:count]}))
            except JawusdError as error:
                outcome.refused = str(error)
            else:
                outcome.core_s = (time.process_time() - began) / frames / count
                judge(outcome, found, jaw, relative, np.arange(frames))
            print(outcome, flush=True)
    report(outcomes)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0, help="of the first subject")
    parser.add_argument("--frames", type=int, default=0, help="number of frames that are tracked")
    parser.add_argument("--solve", action="store_true", help="solve these frames with a rig instead")
    parser.add_argument("--out", type=Path, required=True, help="folder of the takes")
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.subjects)
    if options.solve and options.frames:
        solve_all(seeds, options.out, options.frames)
    elif options.frames:
        track_all(seeds, options.out, options.frames)
    else:
        search_all(seeds, options.out, options.solve)


if __name__ == "__main__":
    main()
