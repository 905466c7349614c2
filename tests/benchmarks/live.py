"""Measure `jawusd live` on files: python tests/benchmarks/live.py RIG CAPTURE [--seconds 30]

The capture's videos are played at their own rate; its truth scores what is told.

    fps        instants told per second of film
    latency    from when the pictures were taken until the line was written, median / 95th percentile [ms]
    dropped    instants left out
    solved     of the instants told
    incisor    distance to the truth of T_upper_lower there in solved instants, mean / 95th percentile / largest [mm]
    sigma      largest standard deviation of d in solved instants, median [mm]
    silent     solved instants off by more than 1 mm and twice that standard deviation
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import jawusd
from jawusd.formats.capture import load_capture
from jawusd.geometry import transform_point
from jawusd.pipeline.live import live


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rig", type=Path)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--truth", type=Path, help="truth.npz, by default that of the capture")
    parser.add_argument("--cameras", type=int, help="number of cameras, by default all")
    options = parser.parse_args()
    capture, jaw = load_capture(options.capture, allow_outside=True), jawusd.load(options.rig)
    with np.load(options.truth or capture.folder / "truth" / "truth.npz", allow_pickle=False) as truth:
        true = dict(zip(truth["frames"].tolist(), truth["T_upper_lower"], strict=True))
    shot = capture.model_copy(update={"cameras": capture.cameras[: options.cameras]})
    told = list(live(options.rig, shot, seconds=options.seconds, allow_outside=True))
    tip, errors, sigmas = jaw.landmarks[0], [], []
    for found in told:
        wanted = true.get(round(found.time_s * capture.fps))
        if found.state == "solved" and wanted is not None:
            errors.append(np.linalg.norm(transform_point(jaw.pose(found.d), tip) - transform_point(wanted, tip)))
            sigmas.append(found.sigma.max())
    times, late = np.array([found.time_s for found in told]), np.array([found.latency_ms for found in told])
    print(f"{'fps':>8}{'latency [ms]':>16}{'dropped':>9}{'solved':>12}{'incisor [mm]':>22}{'sigma':>8}{'silent':>8}")
    fps = (len(told) - 1) / np.ptp(times)
    spread = f"{np.mean(errors):.3f}/{np.percentile(errors, 95):.3f}/{np.max(errors):.3f}"
    latency = f"{np.median(late):.0f}/{np.percentile(late, 95):.0f}"
    dropped = sum(found.dropped for found in told)
    silent = int((np.array(errors) > np.maximum(1.0, 2.0 * np.array(sigmas))).sum())
    counts = f"{dropped:9d}{f'{len(errors)}/{len(told)}':>12}"
    print(f"{fps:8.1f}{latency:>16}{counts}{spread:>22}{np.median(sigmas):8.2f}{silent:8d}")


if __name__ == "__main__":
    main()
