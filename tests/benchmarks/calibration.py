"""Score a calibration from boards against the true one: python tests/benchmarks/calibration.py CAPTURE [--file TOML].

The capture's own calibration file is taken as the truth and never read by the calibration. Points fill the mouth: the
teeth of both scans at every tenth pose of the truth. They are projected by the true cameras and triangulated with the
found ones; distances between them are compared.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from jawusd.cameras.calibration import load_calibration, save_calibration
from jawusd.capture.calibrate import calibrate_capture
from jawusd.formats.capture import load_capture
from jawusd.geometry import rigid_fit, transform_point, transform_points, triangulate
from jawusd.meshes.meshio import load_mesh

POINTS = 400


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--file", type=Path, help="score this calibration instead of making one")
    parser.add_argument("--keep", type=Path, help="write the calibration here")
    options = parser.parse_args()
    capture = load_capture(options.capture)
    scans = {jaw: load_mesh(getattr(capture.scans, f"{jaw}_teeth")).vertices for jaw in ("upper", "lower")}
    if options.file is None:
        blind = capture.model_copy(update={"calibration": None})
        cameras, report = calibrate_capture(blind, scans, lambda done, total: None)
        for name, figures in report["cameras"].items():
            print(f"{name}: rms {figures['rms_px']:.3f} px in {figures['views']} views")
        shape = report["board_shape"]
        listed = ", ".join(f"{name} {shape[name]:.4f}" for name in ("mean", "p95", "max"))
        print(f"on the boards near the mouth: {listed} mm")
        print(f"expected from the corners' scatter: mean {report['expected_shape_mm']:.4f} mm")
        with tempfile.TemporaryDirectory() as folder:
            path = options.keep or Path(folder) / "calibration.toml"
            save_calibration(path, cameras)
            cameras = load_calibration(path)
    else:
        cameras = load_calibration(options.file)
    truth = load_calibration(capture.calibration)
    with np.load(capture.folder / "truth" / "truth.npz", allow_pickle=False) as archive:
        poses = {jaw: archive[f"T_world_{jaw}"][::10] for jaw in ("upper", "lower")}
    rng = np.random.default_rng(0)
    points = []
    for jaw, vertices in scans.items():
        for T in poses[jaw][rng.integers(len(poses[jaw]), size=POINTS // 2)]:
            points.append(transform_point(T, vertices[rng.integers(len(vertices))]))
    exact = np.array(points)
    pixels = [found.undistort_pixels(camera.project(exact)) for found, camera in zip(cameras, truth, strict=True)]
    projections = [camera.projection_matrix() for camera in cameras]
    seen = np.array([triangulate(projections, views) for views in np.stack(pixels, axis=1)])
    i, j = np.triu_indices(len(exact), 1)
    lengths = [np.linalg.norm(cloud[i] - cloud[j], axis=1) for cloud in (seen, exact)]
    error = np.abs(lengths[0] - lengths[1])
    print(
        f"distances in the mouth: mean {error.mean():.4f}, p95 {np.percentile(error, 95):.4f}, max {error.max():.4f} mm"
    )
    shape_error = np.linalg.norm(transform_points(rigid_fit(seen, exact), seen) - exact, axis=1)
    print(f"points after a rigid fit: mean {shape_error.mean():.4f}, max {shape_error.max():.4f} mm")


if __name__ == "__main__":
    main()
