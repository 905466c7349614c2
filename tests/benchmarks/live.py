"""Measure `jawusd live` on files: python tests/benchmarks/live.py RIG CAPTURE [--seconds 30]

The capture's videos are played at their own rate; its truth scores what is told.

    fps        instants told per second of film
    latency    from when the pictures were taken until the line was written, median / 95th percentile [ms]
    dropped    instants left out
    solved     of the instants told
    incisor    distance to the truth of T_upper_lower there in solved instants, mean / 95th percentile / largest [mm]
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
    options = parser.parse_args()
    capture, jaw = load_capture(options.capture, allow_outside=True), jawusd.load(options.rig)
    with np.load(options.truth or capture.folder / "truth" / "truth.npz", allow_pickle=False) as truth:
        true = dict(zip(truth["frames"].tolist(), truth["T_upper_lower"], strict=True))
    told = list(live(options.rig, options.capture, seconds=options.seconds, allow_outside=True))
    tip, errors = jaw.landmarks[0], []
    for found in told:
        wanted = true.get(round(found.time_s * capture.fps))
        if found.state == "solved" and wanted is not None:
            errors.append(np.linalg.norm(transform_point(jaw.pose(found.d), tip) - transform_point(wanted, tip)))
    times, late = np.array([found.time_s for found in told]), np.array([found.latency_ms for found in told])
    print(f"{'fps':>8}{'latency [ms]':>16}{'dropped':>9}{'solved':>12}{'incisor [mm]':>22}")
    fps = (len(told) - 1) / np.ptp(times)
    spread = f"{np.mean(errors):.3f}/{np.percentile(errors, 95):.3f}/{np.max(errors):.3f}"
    latency = f"{np.median(late):.0f}/{np.percentile(late, 95):.0f}"
    dropped = sum(found.dropped for found in told)
    print(f"{fps:8.1f}{latency:>16}{dropped:9d}{f'{len(errors)}/{len(told)}':>12}{spread:>22}")


if __name__ == "__main__":
    main()
