"""Track degraded copies of a capture: python tests/benchmarks/robustness.py CAPTURE [--kinds ...] [--frames A B].

Each kind of `degrade.py` is written, tracked from the picks and scored against the truth; one table in mm:

    tracked    frames with both poses, and rows of frames that carry a flag: not plainly tracked, or large sigma
    upper ...  distance of tooth vertices from the truth, mean over the vertices: mean, p95, largest over frames
    incisor    distance of a landmark from the truth in the skull frame, final poses: mean, p95
    unflagged  the largest vertex error, raw or final, of a row without a flag, and its frame

"extrinsics" moves the world with the cameras: its absolute errors are those after the best rigid motion of the world
over the take; relative poses are scored as they are.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from degrade import KINDS, ROWS, degrade

from jawusd.formats.capture import load_capture
from jawusd.formats.mesh import tooth_labels
from jawusd.formats.tracks import TRACKED, Tracks, load_tracks, save_tracks
from jawusd.geometry import LANDMARKS, mandible_metric, transform_points
from jawusd.pipeline.cameras import load_cameras
from jawusd.pipeline.subject import load_meshes, subject_of_capture
from jawusd.tracking import track_capture

LARGE_SIGMA_MM = 0.25  # half of what no unflagged frame may miss by
WORST_MM = 0.5


def best_motion(found: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Return the rigid motion (4, 4) that brings points (N, 3) closest to others (Kabsch 1976)."""
    a, b = found.mean(0), exact.mean(0)
    U, _, Vt = np.linalg.svd((exact - b).T @ (found - a))
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, b - R @ a
    return T


class Scorer:
    """Compare tracks of a capture with its truth."""

    def __init__(self, path: Path) -> None:
        """Load truth, crowns and landmarks."""
        self.capture = load_capture(path)
        self.meshes = load_meshes(self.capture)
        scans = [self.meshes[f"{row}_teeth"] for row in ROWS]
        self.crowns = [scan.vertices[tooth_labels(scan) > 0][::20] for scan in scans]
        self.landmarks = subject_of_capture(self.capture, self.meshes).landmarks
        with np.load(self.capture.folder / "truth" / "truth.npz", allow_pickle=False) as archive:
            self.truth = {name: archive[name] for name in archive.files}
        names, offsets = self.truth["camera_names"].tolist(), self.truth["offsets"].tolist()
        self.offsets = dict(zip(names, offsets, strict=True))

    def track(self, folder: Path) -> Tracks:
        """Track a degraded copy."""
        capture = load_capture(folder, allow_outside=True)
        scans = [self.meshes[f"{row}_teeth"] for row in ROWS]
        return track_capture(capture, load_cameras(capture), self.offsets, *scans, self.landmarks)

    def vertex_errors_mm(self, tracks: Tracks, prefix: str, own_world: bool) -> np.ndarray:
        """Return the mean vertex error per frame and row, NaN where lost, shape (F, 2)."""
        index = np.searchsorted(self.truth["frames"], tracks.frames)
        found, exact = [], []
        for row, crown in zip(ROWS, self.crowns):
            found.append(transform_points(getattr(tracks, f"{prefix}T_world_{row}"), crown))
            exact.append(transform_points(self.truth[f"T_world_{row}"][index], crown))
        if own_world:
            good = tracks.tracked()
            flat = [np.concatenate([p[good].reshape(-1, 3) for p in points]) for points in (found, exact)]
            to = best_motion(*flat)
            found = [p @ to[:3, :3].T + to[:3, 3] for p in found]
        return np.stack([np.linalg.norm(a - b, axis=-1).mean(-1) for a, b in zip(found, exact)], axis=1)

    def relative_errors_mm(self, tracks: Tracks) -> np.ndarray:
        """Return the error of the landmarks of tracked frames in the skull frame, shape (F, 5)."""
        good = tracks.tracked()
        exact = self.truth["T_upper_lower"][np.searchsorted(self.truth["frames"], tracks.frames[good])]
        found = tracks.T_upper_lower[good]
        gap = transform_points(found, self.landmarks) - transform_points(exact, self.landmarks)
        return np.linalg.norm(gap, axis=-1)

    def flagged(self, tracks: Tracks) -> np.ndarray:
        """Tell which rows of which frames carry a warning, shape (F, 2)."""
        flags = (tracks.status != TRACKED) | tracks.prior_aided[:, None]
        for r, row in enumerate(ROWS):
            for k in np.flatnonzero(~flags[:, r]):
                points = transform_points(getattr(tracks, f"raw_T_world_{row}")[k], self.crowns[r])
                covariance = getattr(tracks, f"covariance_{row}")[k]
                flags[k, r] = np.sqrt(np.trace(mandible_metric(points) @ covariance)) > LARGE_SIGMA_MM
        return flags

    def line(self, kind: str, tracks: Tracks) -> tuple[str, float, float]:
        """Return a line of the table, the larger mean error of the rows' final poses, and the worst unflagged error."""
        raw, final = (self.vertex_errors_mm(tracks, prefix, kind == "extrinsics") for prefix in ("raw_", ""))
        flags, relative = self.flagged(tracks), self.relative_errors_mm(tracks)
        text = f"{kind:<13}{100 * tracks.tracked().mean():6.1f}{flags[:, 0].sum():5d}{flags[:, 1].sum():5d} "
        for errors in (raw, final):
            for r in (0, 1):
                e = errors[np.isfinite(errors[:, r]), r]
                text += f" |{e.mean():6.3f}{np.percentile(e, 95):6.3f}{e.max():6.2f}"
        for name in ("incisor", "condyle_left", "condyle_right"):
            e = relative[:, LANDMARKS.index(name)]
            text += f" |{e.mean():6.3f}{np.percentile(e, 95):6.3f}"
        plain = np.where(flags, 0.0, np.nan_to_num(np.fmax(raw, final)))
        frame, row = np.unravel_index(plain.argmax(), plain.shape)
        text += f" |{plain.max():6.3f} {tracks.frames[frame]:5d} {ROWS[row]}"
        return text, float(np.nanmean(final, axis=0).max()), float(plain.max())


def written(folder: Path, frames: tuple[int, int]) -> bool:
    """Tell whether a copy of these frames is there already."""
    return (folder / "capture.toml").exists() and load_capture(folder, allow_outside=True).frames == frames


def nuisances(tracks: Tracks) -> str:
    """Return what was found out about cameras and masks."""
    delays = ", ".join(f"{v:+.3f}" for v in tracks.meta["delays_frames"].values())
    bias = ", ".join(f"{v:+.2f}" for v in np.mean(list(tracks.meta["outline_bias_px"].values()), axis=0))
    report = tracks.meta["extrinsics"]
    moves = f"corrected by up to {np.abs(list(report['moves_mm'].values())).max():.2f} mm"
    cameras = moves if report["corrected"] else "left alone"
    return f"{'':<13}delays [frames] {delays}; mask bias [px] {bias}; cameras {cameras}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--frames", type=int, nargs=2, metavar=("A", "B"), help="first frame, one past the last")
    parser.add_argument("--keep", type=Path, help="keep copies and tracks there, use copies that are there")
    parser.add_argument("--scored", action="store_true", help="score the tracks kept there")
    options = parser.parse_args()
    scorer = Scorer(options.capture)
    frames = tuple(options.frames) if options.frames else scorer.capture.frames
    print(f"{scorer.capture.name}, frames {frames[0]} to {frames[1] - 1}")
    heads = [f"{kind} {row}" for kind in ("raw", "final") for row in ROWS]
    print(f"{'':<13}{'':>17} " + "".join(f" |{name:^18}" for name in heads) + f" |{'final relative pose':^40} |")
    print(f"{'[mm]':<13}{'tr. %':>6}{'flagged':>10} " + " |  mean   p95   max" * 4, end=" | incisor      condyle L   ")
    print("  condyle R    | worst unflagged")
    clean = None
    with tempfile.TemporaryDirectory() as scratch:
        for kind in options.kinds:
            folder = (options.keep or Path(scratch)) / kind
            start = time.process_time()
            if not options.scored:
                if not written(folder, frames):
                    degrade(scorer.capture, kind, folder, frames)
                save_tracks(folder / "tracks.npz", scorer.track(folder))
            tracks = load_tracks(folder / "tracks.npz")
            text, mean, worst = scorer.line(kind, tracks)
            clean = mean if kind == "clean" else clean
            missed = ["mean over twice the clean one"] * (clean is not None and mean > 2 * clean)
            missed += [f"unflagged over {WORST_MM} mm"] * (worst > WORST_MM)
            print(text, "; ".join(missed) or "ok", flush=True)
            print(f"{nuisances(tracks)}; {time.process_time() - start:.0f} s of processor", flush=True)
    if "extrinsics" in options.kinds:
        print("extrinsics: vertex errors after the best rigid motion of the world over the take")


if __name__ == "__main__":
    main()
