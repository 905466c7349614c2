"""Track captures from videos and picks alone and score them: python tests/benchmarks/pictures.py CAPTURE [CAPTURE ...].

Masks of the captures are not used; their truth only scores. Printed are, per capture,

    core s      processor seconds per frame of all cameras, decoding included
    tracked     frames with both arches
    incisor     distance of the final lower incisal point relative to the upper teeth: mean, median, largest [mm]
    condyles    the same of both condyles, mean [mm]
    weighed     both means again, of the poses that `build` weighs with the model fitted to them
    over 1 mm   frames whose incisal point is so far off, and how many of these say so by a sigma above 0.5 mm
    NEES        normalised squared error of the raw relative poses over 6: 1 when sigmas are honest
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from jawusd.formats.capture import Capture, load_capture
from jawusd.formats.tracks import Tracks
from jawusd.geometry import se3_inverse, se3_log, transform_points
from jawusd.pipeline.calibrate import sync_cameras
from jawusd.pipeline.fit import fit_subject
from jawusd.pipeline.subject import load_meshes, subject_of_capture
from jawusd.pipeline.track import first_pass, model_pass

_WRONG_MM, _SAYS_SO_MM = 1.0, 0.5


def unmasked(capture: Capture) -> Capture:
    """Return the capture without masks."""
    cameras = tuple(camera.model_copy(update={"masks": None}) for camera in capture.cameras)
    return capture.model_copy(update={"cameras": cameras})


def score(tracks: Tracks, truth: dict[str, np.ndarray]) -> str:
    """Return the figures of a line of the table."""
    rows = np.searchsorted(truth["frames"], tracks.frames)
    both = np.isfinite(tracks.T_upper_lower).all((1, 2)) & (
        truth["frames"][np.minimum(rows, len(truth["frames"]) - 1)] == tracks.frames
    )
    exact, landmarks = truth["T_upper_lower"][rows[both]], truth["landmarks"]
    away = transform_points(tracks.T_upper_lower[both], landmarks) - transform_points(exact, landmarks)
    off = np.linalg.norm(away, axis=-1)
    wrong = off[:, 0] > _WRONG_MM
    said = wrong & (tracks.sigma_mm[both, 0] > _SAYS_SO_MM)
    twist = se3_log(exact @ se3_inverse(tracks.raw_T_upper_lower[both]))
    nees = np.einsum("fi,fij,fj->f", twist, np.linalg.inv(tracks.covariance_relative[both]), twist) / 6
    return (
        f"{both.sum():>5}/{len(both):<5}{off[:, 0].mean():>7.3f}{np.median(off[:, 0]):>7.3f}{off[:, 0].max():>7.2f}"
        f"{off[:, -2:].mean():>9.3f}{wrong.sum():>7} ({said.sum()}){nees.mean():>7.2f}"
    )


def weighed(capture: Capture, tracks: Tracks, truth: dict[str, np.ndarray]) -> str:
    """Return the figures of poses weighed with the model fitted to them."""
    subject = subject_of_capture(capture, load_meshes(capture))
    model = fit_subject(replace(subject, meshes={}), tracks)  # without contacts, which do not move poses
    poses = model_pass(capture, {}, tracks, model, 1, lambda *_: None).T_upper_lower
    both = np.isfinite(poses).all((1, 2)) & np.isin(tracks.frames, truth["frames"])
    exact = truth["T_upper_lower"][np.searchsorted(truth["frames"], tracks.frames[both])]
    away = transform_points(poses[both], truth["landmarks"]) - transform_points(exact, truth["landmarks"])
    off = np.linalg.norm(away, axis=-1).mean(0)
    return f"{off[0]:>8.3f}{off[-2:].mean():>7.3f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, nargs="+")
    options = parser.parse_args()
    numbers = f"{'condyles':>9}{'over 1 mm':>11}{'NEES':>7}{'weighed':>11}"
    print(f"{'':<16}{'core s':>7}{'tracked':>11}{'incisor':>7}{'':>14}{numbers}")
    for path in options.captures:
        capture = unmasked(load_capture(path, allow_outside=True))
        offsets = sync_cameras(capture, lambda *_: None)["offsets"]
        start = time.process_time()
        tracks = first_pass(capture, offsets, 1, lambda *_: None)
        seconds = (time.process_time() - start) / len(tracks.frames)
        with np.load(path / "truth" / "truth.npz", allow_pickle=False) as archive:
            truth = {name: archive[name] for name in archive.files}
        print(f"{capture.name:<16}{seconds:>7.3f}{score(tracks, truth)}{weighed(capture, tracks, truth)}", flush=True)
        for found in tracks.meta.get("findings", []):
            print(f"    {found['severity']}: {found['message']}")


if __name__ == "__main__":
    main()
