"""Search for the teeth of rendered subjects of many looks: python tests/benchmarks/looks.py --subjects 30 --out DIR

There are neither masks nor picks. The looks vary in the colours of teeth, gum and skin, in exposure, white balance,
contrast and noise, from 720 to 1080 lines. In turn, the cameras are upright, turned by quarter turns, or two side
cameras. What DIR has already is kept. Printed per subject:

    start       frame in which the teeth were found, and the fraction of the visible contour that fits
    off         distance of the incisal point, relative to the upper teeth, from the truth [mm]
    head        distance of the upper incisal point from the truth [mm]

A start is right if both distances are at most 1 mm. A take that is rejected is printed with the message.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))
from lips_take import write_look_capture
from looks import KINDS

from jawusd.base.errors import JawusdError
from jawusd.formats.capture import load_capture
from jawusd.geometry import relative_pose, transform_point
from jawusd.pipeline.calibrate import sync_cameras
from jawusd.pipeline.cameras import open_colour_footage
from jawusd.pipeline.picture_search import PictureSearch, Start
from jawusd.pipeline.state import no_progress
from jawusd.pipeline.subject import load_meshes, subject_of_capture
from jawusd.pipeline.track_videos import Follower
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.region.picture_start import ArchStart

RIGHT_MM = 1.0


def found_start(folder: Path) -> Start:
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


def errors_mm(folder: Path, start: Start) -> tuple[float, float]:
    """Return the distances of the incisal point relative to the upper teeth, and of the upper teeth, from the truth."""
    with np.load(folder / "truth" / "truth.npz") as truth:
        row = int(np.searchsorted(truth["frames"], start.frame))
        exact = np.stack([truth["T_world_upper"][row], truth["T_world_lower"][row]])
        incisor = truth["landmarks"][truth["landmark_names"].tolist().index("incisor")]
    jaws = [transform_point(relative_pose(*poses), incisor) for poses in (start.pose, exact)]
    heads = [transform_point(poses[0], incisor) for poses in (start.pose, exact)]
    return float(np.linalg.norm(jaws[0] - jaws[1])), float(np.linalg.norm(heads[0] - heads[1]))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0, help="of the first subject")
    parser.add_argument("--out", type=Path, required=True, help="folder of the takes")
    options = parser.parse_args()
    print(f"{'seed':<6}{'kind':<12}{'start':>6}{'fit':>6}{'off':>8}{'head':>8}{'core s':>8}")
    right = wrong = rejected = 0
    for seed in range(options.seed, options.seed + options.subjects):
        folder = options.out / f"look_{seed}"
        if not (folder / "capture.toml").exists():
            write_look_capture(folder, seed)
        named, began = f"{seed:<6}{KINDS[seed % len(KINDS)]:<12}", time.process_time()
        try:
            start = found_start(folder)
        except JawusdError as error:
            rejected += 1
            print(f"{named}{time.process_time() - began:.0f} s: {error}", flush=True)
            continue
        jaw_mm, head_mm = errors_mm(folder, start)
        is_right = max(jaw_mm, head_mm) <= RIGHT_MM
        right, wrong = right + is_right, wrong + (not is_right)
        spent = time.process_time() - began
        print(f"{named}{start.frame:>6}{start.fit:>6.2f}{jaw_mm:>8.3f}{head_mm:>8.3f}{spent:>8.0f}", flush=True)
    print(f"starts right {right}, wrong {wrong}, rejected {rejected}")


if __name__ == "__main__":
    main()
