"""Segment a capture from videos and picks alone and score it: python tests/benchmarks/segmentation.py CAPTURE.

The capture's own masks and truth only score. Prints, per camera and row, the median and the 5th percentile of the
overlap (intersection over union) with the given masks; processor seconds per frame and camera; the tracking error of
the lower incisal point relative to the upper teeth, while segmenting and from the finished masks; and how many of the
worst masks are among those named to be looked at.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from jawusd.formats.capture import Capture, load_capture
from jawusd.geometry import LANDMARKS, se3_inverse, transform_point
from jawusd.media.masks import MaskReader
from jawusd.media.video import Video
from jawusd.pipeline.calibrate import sync_cameras
from jawusd.pipeline.segment import SegmentOptions, segment_teeth
from jawusd.pipeline.segment_record import with_masks, write_summary
from jawusd.pipeline.subject import load_meshes, subject_of_capture
from jawusd.pipeline.track import first_pass


def hidden(capture: Capture, frames: int | None) -> Capture:
    """Return the capture without masks, of the first frames only if a number is given."""
    cameras = tuple(camera.model_copy(update={"masks": None}) for camera in capture.cameras)
    first, stop = capture.frames
    stop = stop if frames is None else min(stop, first + frames)
    return capture.model_copy(update={"cameras": cameras, "frames": (first, stop)})


def overlaps(capture: Capture, entries: dict, folder: Path) -> dict[tuple[str, str], dict[int, float]]:
    """Return intersection over union with the given masks by camera and row, by frame."""
    made = with_masks(capture, folder)
    out = {}
    for given, found in zip(capture.cameras, made.cameras):
        size = Video(given.video).size_px
        for row in ("upper", "lower"):
            pair = [MaskReader(getattr(camera.masks, row), size) for camera in (given, found)]
            values = out[given.name, row] = {}
            for frame in sorted(entries):
                own = entries[frame]["cameras"].get(given.name, {}).get("frame")
                if own is None:
                    continue
                a, b = (reader.read(own) for reader in pair)
                if a is not None:
                    b = np.zeros_like(a) if b is None else b
                    values[frame] = ((a > 127) & (b > 127)).sum() / ((a > 127) | (b > 127)).sum()
            for reader in pair:
                reader.close()
    return out


def incisor_error(truth: dict, landmark: np.ndarray, frames: np.ndarray, T_upper_lower: np.ndarray) -> np.ndarray:
    """Return the distance [mm] between the tracked and the true lower incisal point, NaN where not tracked."""
    exact = truth["T_upper_lower"][np.searchsorted(truth["frames"], frames)]
    return np.linalg.norm(transform_point(T_upper_lower, landmark) - transform_point(exact, landmark), axis=-1)


def report(name: str, error: np.ndarray) -> None:
    """Print a line of the tracking table."""
    seen = error[np.isfinite(error)]
    figures = (seen.mean(), np.percentile(seen, 95), seen.max()) if len(seen) else (np.nan,) * 3
    print(f"{name:<34}{len(seen):>5} of {len(error)} frames" + "".join(f"{value:9.3f}" for value in figures))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--frames", type=int, help="only so many frames from the first one")
    parser.add_argument("--keys", type=Path, help="folder with masks for some frames")
    parser.add_argument("--out", type=Path, help="folder of the masks; what is finished there is kept")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--no-track", action="store_true", help="leave out tracking from the finished masks")
    options = parser.parse_args()
    given = load_capture(options.capture)
    capture = hidden(given, options.frames)
    with np.load(given.folder / "truth" / "truth.npz", allow_pickle=False) as archive:
        truth = {name: archive[name] for name in archive.files}

    def quiet(stage: str, done: int, total: int) -> None:
        pass

    folder = options.out or Path(tempfile.mkdtemp())
    offsets = sync_cameras(capture, quiet)["offsets"]
    before = time.process_time()
    entries = segment_teeth(capture, offsets, folder, SegmentOptions(options.keys, True, options.jobs), quiet)
    seconds = time.process_time() - before
    summary = write_summary(capture, entries, folder)
    print(f"{capture.name}: {len(entries)} frames")
    print(f"{seconds / sum(len(e['cameras']) for e in entries.values()):.2f} processor seconds per frame and camera")
    found = overlaps(given, entries, folder)
    for (camera, row), values in found.items():
        shares = np.array(list(values.values()))
        print(
            f"{camera} {row:<6} overlap: median {np.median(shares):.3f}  5th percentile {np.percentile(shares, 5):.3f}"
        )
    for row in ("upper", "lower"):
        shares = [share for key, values in found.items() if key[1] == row for share in values.values()]
        print(f"all  {row:<6} overlap: median {np.median(shares):.3f}")
    landmark = subject_of_capture(capture, load_meshes(capture)).landmarks[LANDMARKS.index("incisor")]
    frames = np.array(sorted(entries))
    poses = np.array([entries[frame]["poses"] for frame in frames])
    print(f"{'incisal point [mm]':<34}{'':<15}" + "".join(f"{name:>9}" for name in ("mean", "p95", "max")))
    report("while segmenting", incisor_error(truth, landmark, frames, se3_inverse(poses[:, 0]) @ poses[:, 1]))
    if not options.no_track:
        tracks = first_pass(with_masks(capture, folder), offsets, options.jobs, quiet)
        report("from the masks, raw", incisor_error(truth, landmark, tracks.frames, tracks.raw_T_upper_lower))
        report("from the masks, final", incisor_error(truth, landmark, tracks.frames, tracks.T_upper_lower))
    worth = {}
    for (camera, _), values in found.items():
        for frame, share in values.items():
            worth[frame, camera] = min(share, worth.get((frame, camera), 1.0))
    worst = set(sorted(worth, key=worth.get)[: max(1, len(worth) // 20)])
    flagged = {(row["frame"], row["camera"]) for row in summary["look_at"]}
    print(f"{len(flagged)} of {len(worth)} masks flagged, {len(worst & flagged)} of the {len(worst)} worst among them")


if __name__ == "__main__":
    main()
