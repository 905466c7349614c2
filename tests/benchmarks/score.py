"""Score tracks against the truth of a synthetic capture: python tests/benchmarks/score.py out/tracks.npz CAPTURE.

Prints a table of distances in mm: teeth vertices in the world, landmarks of the relative pose in the skull frame, and
NEES / 6 of the relative pose, which is 1 when the reported covariance is honest.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from jawusd.formats.capture import load_capture
from jawusd.formats.mesh import tooth_labels
from jawusd.formats.tracks import load_tracks
from jawusd.geometry import LANDMARKS, se3_inverse, se3_log, transform_points
from jawusd.meshes.meshio import load_mesh
from jawusd.pipeline.subject import load_meshes, subject_of_capture


def row(name: str, distance_mm: np.ndarray) -> str:
    """Return a line of the table: mean, median, 95th percentile and largest of distances (F,)."""
    values = (distance_mm.mean(), np.median(distance_mm), np.percentile(distance_mm, 95), distance_mm.max())
    return f"{name:<34}" + "".join(f"{value:9.3f}" for value in values)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tracks", type=Path)
    parser.add_argument("capture", type=Path)
    options = parser.parse_args()
    capture, tracks = load_capture(options.capture), load_tracks(options.tracks)
    with np.load(capture.folder / "truth" / "truth.npz", allow_pickle=False) as archive:
        truth = {name: archive[name] for name in archive.files}
    rows = np.searchsorted(truth["frames"], tracks.frames)
    known = tracks.tracked() & (truth["frames"][np.minimum(rows, len(truth["frames"]) - 1)] == tracks.frames)
    rows = rows[known]
    print(f"{capture.name}: {known.sum()} of {len(truth['frames'])} frames tracked")
    print(f"{'[mm]':<34}" + "".join(f"{name:>9}" for name in ("mean", "median", "p95", "max")))
    for name, scan in (("upper", capture.scans.upper_teeth), ("lower", capture.scans.lower_teeth)):
        mesh = load_mesh(scan)
        crown = mesh.vertices[tooth_labels(mesh) > 0][::5]
        found, exact = getattr(tracks, f"T_world_{name}")[known], truth[f"T_world_{name}"][rows]
        gap = transform_points(found, crown) - transform_points(exact, crown)
        print(row(f"{name} teeth, mean over vertices", np.linalg.norm(gap, axis=-1).mean(-1)))
    landmarks = subject_of_capture(capture, load_meshes(capture)).landmarks
    exact = truth["T_upper_lower"][rows]
    for kind in ("raw_", ""):
        found = getattr(tracks, f"{kind}T_upper_lower")[known]
        gap = np.linalg.norm(transform_points(found, landmarks) - transform_points(exact, landmarks), axis=-1)
        for index, name in enumerate(LANDMARKS):
            print(row(f"relative, {'raw' if kind else 'final'}, {name}", gap[:, index]))
    twist = se3_log(exact @ se3_inverse(tracks.raw_T_upper_lower[known]))
    nees = np.einsum("fi,fij,fj->f", twist, np.linalg.inv(tracks.covariance_relative[known]), twist)
    print(f"NEES / 6 of the relative pose: mean {nees.mean() / 6:.2f}, median {np.median(nees) / 6:.2f}")


if __name__ == "__main__":
    main()
