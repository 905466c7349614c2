"""Compare tracks with the Cramer-Rao bound of the masks: python tests/benchmarks/cramer_rao.py TRACKS CAPTURE

For a capture with truth (truth/truth.npz). At the true pose of every step-th frame the scans' visible contours are
matched with the mask edges. The distances found are the outline's own error: their standard deviation sigma, and the
length l over which they move together, sigma^2 l = tr(H^-1 S) / 6 with the scatter S of picture tiles, averaged over
the frames. The contour holds one independent measurement per l pixels, so no unbiased tracker of single frames does
better than sigma^2 l H^-1 (with every matched edge of full weight). Distances are rms over frames [mm]; the raw tracks
are compared, because smoothing sees more than one frame.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from jawusd.formats.capture import load_capture
from jawusd.formats.tracks import load_tracks
from jawusd.geometry import LANDMARKS, mandible_metric, relative_pose, transform_point, transform_points
from jawusd.pipeline.cameras import load_cameras
from jawusd.pipeline.subject import load_meshes, subject_of_capture
from jawusd.tracking import TrackingConfig
from jawusd.tracking.contour.quality import landmark_sigmas, relative_covariance, residual_px, twist_covariance
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import MaskViews

ROWS = ("upper", "lower")
# Moments of the Tukey weight w of a unit normal residual x at c = 4.685, by the normal's moments: the solver's normal
# matrix holds E[w], its scatter E[w^2 x^2]; the bound is that of edges in full.
CC = 4.685**2
MEAN_W = 1 - 2 / CC + 3 / CC**2
MEAN_WWXX = 1 - 12 / CC + 90 / CC**2 - 420 / CC**3 + 945 / CC**4
TILE_PX = 60  # side of the tiles within which errors may move together


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tracks", type=Path)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--step", type=int, default=8, help="use every so many frames")
    options = parser.parse_args()
    capture, tracks = load_capture(options.capture), load_tracks(options.tracks)
    meshes, cameras, config = load_meshes(capture), load_cameras(capture), TrackingConfig(tile_px=TILE_PX)
    with np.load(capture.folder / "truth" / "truth.npz", allow_pickle=False) as archive:
        truth = {name: archive[name] for name in archive.files}
    offsets = dict(zip(truth["camera_names"].tolist(), truth["offsets"].tolist(), strict=True))
    landmarks = subject_of_capture(capture, meshes).landmarks
    scans = [prepare_scan(meshes[f"{row}_teeth"], row) for row in ROWS]
    exact = np.stack([truth[f"T_world_{row}"] for row in ROWS], axis=1)
    at = {int(frame): k for k, frame in enumerate(truth["frames"])}
    chosen = [k for k, frame in enumerate(tracks.frames) if int(frame) in at][:: options.step]
    solver, solutions = ContourSolver(scans, config), []
    centre = np.mean([transform_point(exact[0, r], scans[r].centre) for r in (0, 1)], axis=0)
    table = {camera.name: camera for camera in cameras}
    with MaskViews(capture.cameras, table, offsets, centre, config.working_px_per_mm) as masks:
        for k in chosen:
            frame = int(tracks.frames[k])
            solutions.append(solver.solve(exact[at[frame]], masks.at(frame), ()))
    poses = exact[[at[int(tracks.frames[k])] for k in chosen]]
    sigma = np.array([residual_px(s) for s in solutions])
    noise = np.nanmean([outline_noise_px3(s) for s in solutions], axis=0)
    spread = np.sqrt(np.nanmean(sigma**2, axis=0))
    print(f"{capture.name}, {len(chosen)} frames; of the upper and lower masks: outline error {spread.round(2)} px,")
    print(f"moving together over {(noise / spread**2).round(1)} px of contour")
    bound = np.stack([[MEAN_W * twist_covariance(s, r, 1.0, noise[r]) for r in (0, 1)] for s in solutions])
    found = np.stack([tracks.raw_T_world_upper[chosen], tracks.raw_T_world_lower[chosen]], axis=1)
    print(f"{'rms [mm]':<34}{'bound':>9}{'tracks':>9}{'ratio':>9}")
    for r, row in enumerate(ROWS):
        crowns = scans[r].probes
        least = [np.trace(mandible_metric(transform_points(p, crowns)) @ c) for p, c in zip(poses[:, r], bound[:, r])]
        gap = transform_points(found[:, r], crowns) - transform_points(poses[:, r], crowns)
        line(f"{row} teeth, crowns", np.array(least), (gap**2).sum(-1).mean(-1))
    relative = relative_pose(poses[:, 0], poses[:, 1])
    least = landmark_sigmas(relative, relative_covariance(poses[:, 0], bound[:, 0], bound[:, 1]), landmarks) ** 2
    measured = relative_pose(found[:, 0], found[:, 1])
    for k, name in enumerate(LANDMARKS):
        gap = transform_point(measured, landmarks[k]) - transform_point(relative, landmarks[k])
        line(f"relative pose, {name}", least[:, k], (gap**2).sum(-1))


def outline_noise_px3(solution: object) -> np.ndarray:
    """Return sigma^2 l of both rows as tiles of the picture show it, shape (2,); NaN where the masks say too little."""
    out = np.full(2, np.nan)
    for r in (0, 1):
        H = solution.outline.precision[r].sum(0)
        if np.linalg.matrix_rank(H, hermitian=True) == 6:
            out[r] = np.trace(np.linalg.solve(H, solution.scatters[r])) / 6 * MEAN_W / MEAN_WWXX
    return out


def line(name: str, least: np.ndarray, found: np.ndarray) -> None:
    """Print root means of squared distances, and their ratio."""
    usable = np.isfinite(least) & np.isfinite(found)
    a, b = np.sqrt(least[usable].mean()), np.sqrt(found[usable].mean())
    print(f"{name:<34}{a:9.3f}{b:9.3f}{b / a:9.2f}")


if __name__ == "__main__":
    main()
