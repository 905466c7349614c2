"""How lips that close over the teeth are survived, from footage and picks alone, over persons of the synthetic studio.

    python tests/benchmarks/lips.py --persons 10 --out FOLDER

Takes of a hundred frames in which the lips close three times are rendered and tracked by their colours, as `jawusd
track` does without masks, and with --masks also through masks that `jawusd segment` makes; what lies in FOLDER already
is kept. Prints per take and in all:

    again       frames from the first one in which the teeth are in sight again to the first one found within 0.5 mm;
                in sight are both rows where two cameras see a sixth of their crowns. A row that is lost is not found
    silent      frames whose lower incisal point against the upper teeth is more than 1 mm off, though neither row is
                lost or marked, and though the sigma of that point is below 0.5 mm
    NEES        of the lower against the upper row in frames where the teeth are in sight, over its 6 degrees of freedom
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))

from lips_take import write_lips_capture

from jawusd.formats.capture import load_capture
from jawusd.formats.tracks import TRACKED, load_tracks, save_tracks
from jawusd.geometry import LANDMARKS, se3_inverse, se3_log, transform_point
from jawusd.pipeline.calibrate import sync_cameras
from jawusd.pipeline.segment import SegmentOptions, segment_teeth
from jawusd.pipeline.segment_record import RECORD, with_masks, write_summary
from jawusd.pipeline.track import track
from jawusd.tracking.contour.quality import landmark_sigmas

FOUND_MM, GROSS_MM, SOON = 0.5, 1.0, 5
IN_SIGHT, CAMERAS = 1 / 6, 2
INCISOR = LANDMARKS.index("incisor")


@dataclass
class Figures:
    """Collect what is printed, over takes."""

    again: list[float] = field(default_factory=list)  # frames, one per closing; infinite if not before the next one
    errors: list[float] = field(default_factory=list)  # of frames with the teeth in sight [mm]
    squares: list[float] = field(default_factory=list)  # Mahalanobis distances of the same frames
    lost: int = 0
    flagged: int = 0
    silent: int = 0
    gross: int = 0
    frames: int = 0

    def add(self, truth, frames, poses, covariance, status):
        """Take in a take; return a line about it.

        Args:
            poses: T_upper_lower, NaN where a row is lost, shape (F, 4, 4).
            covariance: of its left twist, shape (F, 6, 6).
            status: of both rows, shape (F, 2).
        """
        rows = np.searchsorted(truth["frames"], frames)
        exact, landmarks = truth["T_upper_lower"][rows], truth["landmarks"]
        off = transform_point(poses, landmarks[INCISOR]) - transform_point(exact, landmarks[INCISOR])
        error = np.linalg.norm(off, axis=-1)
        sigma = landmark_sigmas(poses, covariance, landmarks)[:, INCISOR]
        shown = ((truth["in_sight"][rows] > IN_SIGHT).sum(2) >= CAMERAS).all(1)
        plain = (status == TRACKED).all(1) & (sigma <= GROSS_MM / 2)
        silent = plain & (error > GROSS_MM)
        found = error <= FOUND_MM
        again = self._again(truth, frames, shown, found)
        usual = shown & np.isfinite(error)
        twist = se3_log(exact[usual] @ se3_inverse(poses[usual]))
        squares = np.einsum("ni,ni->n", twist, np.linalg.solve(covariance[usual], twist[..., None])[..., 0]) / 6
        self.again += again
        self.errors += error[usual].tolist()
        self.squares += squares.tolist()
        self.lost += int((~np.isfinite(error) & shown).sum())
        self.flagged += int((np.isfinite(error) & ~plain & shown).sum())
        self.silent += int(silent.sum())
        self.gross += int((error > GROSS_MM).sum())
        self.frames += len(frames)
        named = ", ".join(f"{frame} ({value:.1f})" for frame, value in zip(frames[silent], error[silent]))
        return f"again {again}  mean {np.nanmean(error[usual]):.3f}  NEES {np.mean(squares):.2f}  silent [{named}]"

    @staticmethod
    def _again(truth, frames, shown, found):
        """Return for each closing how many frames after their reappearing the teeth are found."""
        out = []
        ends = [*truth["closings"][1:, 0], frames[-1] + 1]
        for (first, last), stop in zip(truth["closings"], ends):
            hidden = np.flatnonzero((frames >= first) & (frames <= last) & ~shown)
            if not len(hidden):
                continue
            back = np.flatnonzero((frames > frames[hidden[-1]]) & (frames < stop) & shown)
            if len(back):
                hits = np.flatnonzero(found[back])
                out.append(float(hits[0]) if len(hits) else float("inf"))
        return out

    def line(self):
        """Return what there is to say of all takes."""
        again, errors = np.array(self.again), np.array(self.errors)
        return (
            f"again within {SOON} frames {np.mean(again <= SOON):.1%} of {len(again)} (at most {again.max():g}), "
            f"silent {self.silent}, worse than {GROSS_MM:g} mm {self.gross} of {self.frames}, in sight: lost "
            f"{self.lost}, flagged {self.flagged}, mean {errors.mean():.3f}, p95 {np.percentile(errors, 95):.3f}, "
            f"largest {errors.max():.2f} mm, NEES {np.mean(self.squares):.2f}"
        )


def quiet(stage, done, total):
    """Say nothing of progress."""


def masks_tracked(capture, folder):
    """Return the tracks of a capture by masks that `segment` makes."""
    offsets, masks = sync_cameras(capture, quiet)["offsets"], folder / "masks"
    entries = segment_teeth(capture, offsets, masks, SegmentOptions(None, (masks / RECORD).exists(), 1), quiet)
    write_summary(capture, entries, masks)
    return track(with_masks(capture, masks), jobs=1)


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--persons", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1, help="of the first person")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 360), help="of the pictures [px]")
    parser.add_argument("--out", type=Path, help="folder of the captures; what is finished there is kept")
    parser.add_argument("--masks", action="store_true", help="also make masks, and track through them")
    options = parser.parse_args()
    out = options.out or Path(tempfile.mkdtemp())
    ways = {"colours": lambda capture, folder: track(capture, jobs=1)}
    if options.masks:
        ways["masks"] = masks_tracked
    totals = {name: Figures() for name in ways}
    for seed in range(options.seed, options.seed + options.persons):
        folder = out / f"person_{seed}"
        if not (folder / "capture.toml").exists():
            write_lips_capture(folder, seed, options.frames, tuple(options.size))
        capture = load_capture(folder / "capture.toml")
        with np.load(folder / "truth" / "truth.npz") as archive:
            truth = {name: archive[name] for name in archive.files}
        for name, way in ways.items():
            path = folder / f"{name}.npz"
            if not path.exists():
                save_tracks(path, way(capture, folder))
            made = load_tracks(path)
            shown = (made.frames, made.T_upper_lower, made.covariance_relative, made.status)
            print(seed, name, totals[name].add(truth, *shown), flush=True)
    for name, figures in totals.items():
        if figures.frames:
            print(name, figures.line())


if __name__ == "__main__":
    main()
