"""Spoil the footage of captures with known truth, track it, and print what is said of each take.

    python tests/benchmarks/spoilt_footage.py CAPTURE... [--kinds KIND...] [--out DIR]

Captures without masks, each with truth/truth.npz. A take whose incisal point is a millimetre off in the median frame
must be rejected, be reported as unreliable, or carry honest sigmas. Kinds:

    clean        nothing changed
    dark         a fifth of the light
    noise        sensor noise of 25 of 255
    grey         no colours
    blur         Gaussian, 1/160 of the width
    small        a third of the resolution, enlarged again
    flicker      light that goes up and down by half from frame to frame
    focal        focal lengths 15 % too long in the calibration
    other_lower  the lower scan of the next capture
"""

import argparse
import shutil
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from jawusd.base.errors import JawusdError
from jawusd.cameras.calibration import load_calibration, save_calibration
from jawusd.formats.capture import load_capture
from jawusd.geometry import transform_point
from jawusd.pipeline.subject import load_meshes, subject_of_capture
from jawusd.pipeline.track import track

DARK, NOISE, FLICKER, FOCAL = 0.2, 25.0, 0.5, 1.15


def spoilt_picture(kind, picture, k, rng):
    """Return frame k of a video, RGB (H, W, 3), spoilt."""
    width = picture.shape[1]
    if kind == "dark":
        return (DARK * picture).astype(np.uint8)
    if kind == "noise":
        return np.clip(picture + NOISE * rng.standard_normal(picture.shape), 0, 255).astype(np.uint8)
    if kind == "grey":
        return np.repeat(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
    if kind == "blur":
        return cv2.GaussianBlur(picture, (0, 0), width / 160)
    if kind == "small":
        few = cv2.resize(picture, None, fx=1 / 3, fy=1 / 3, interpolation=cv2.INTER_AREA)
        return cv2.resize(few, picture.shape[1::-1], interpolation=cv2.INTER_CUBIC)
    if kind == "flicker":
        return np.clip((1 + FLICKER * (-1) ** k) * picture, 0, 255).astype(np.uint8)
    return picture


def rewrite_video(path, kind, rng):
    """Write a video anew, spoilt, with the same times."""
    made = path.with_name(f"spoilt{path.suffix}")
    with av.open(str(path)) as source, av.open(str(made), "w") as target:
        stream = source.streams.video[0]
        out = target.add_stream("libx264", rate=Fraction(stream.average_rate), options={"crf": "14"})
        out.width, out.height, out.pix_fmt = stream.width, stream.height, "yuv420p"
        out.thread_count = 1
        for k, frame in enumerate(source.decode(stream)):
            new = av.VideoFrame.from_ndarray(spoilt_picture(kind, frame.to_ndarray(format="rgb24"), k, rng), "rgb24")
            new.pts, new.time_base = frame.pts, frame.time_base
            target.mux(out.encode(new))
        target.mux(out.encode(None))
    made.replace(path)


def spoil(folder, kind, other):
    """Spoil a copy of a capture; `other` is the capture whose lower scan `other_lower` takes."""
    capture = load_capture(folder)
    if kind == "focal":
        path = folder / "calibration.toml"
        focal = np.diag([FOCAL, FOCAL, 1.0])
        save_calibration(path, [replace(one, K=one.K @ focal) for one in load_calibration(path)])
    elif kind == "other_lower":
        shutil.copy(load_capture(other).scans.lower_teeth, capture.scans.lower_teeth)
    elif kind != "clean":
        rng = np.random.default_rng(0)
        for source in capture.cameras:
            rewrite_video(Path(source.video), kind, rng)


def outcome(folder):
    """Return what tracking says of a take, beside the truth."""
    capture = load_capture(folder)
    try:
        tracks = track(capture, jobs=1)
    except JawusdError as error:
        return f"refused: {str(error)[:90]}"
    truth = np.load(folder / "truth" / "truth.npz")
    true = truth["T_upper_lower"][np.searchsorted(truth["frames"], tracks.frames)]
    points = subject_of_capture(capture, load_meshes(capture)).landmarks
    off = np.stack(
        [
            np.linalg.norm(transform_point(tracks.raw_T_upper_lower, p) - transform_point(true, p), axis=-1)
            for p in points
        ],
        axis=1,
    )
    off, sigma = off[tracks.tracked()], tracks.sigma_mm[tracks.tracked()]
    said = [f["kind"] for f in tracks.meta.get("findings", []) if f["severity"] != "notice"]
    silent = int(((off[:, 0] > 1.0) & (sigma[:, 0] < off[:, 0] / 3)).sum())
    return (
        f"{len(off):4d}/{len(tracks.frames)} incisal {np.median(off[:, 0]):.2f} ({off[:, 0].max():.2f}) "
        f"condyles {np.median(off[:, 3:]):.2f} sigma {np.median(sigma[:, 0]):.2f} / {np.median(sigma[:, 3:]):.2f} "
        f"silent {silent} said: {', '.join(said) or 'nothing'}"
    )


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = ["clean", "dark", "noise", "grey", "blur", "small", "flicker", "focal", "other_lower"]
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--kinds", nargs="+", default=kinds, choices=kinds)
    parser.add_argument("--out", type=Path, required=True, help="folder for the spoilt copies")
    args = parser.parse_args()
    for k, source in enumerate(args.captures):
        for kind in args.kinds:
            folder = args.out / f"{source.name}_{kind}"
            if not folder.exists():
                shutil.copytree(source, folder)
                for path in folder.rglob("*"):
                    path.chmod(0o755 if path.is_dir() else 0o644)
                spoil(folder, kind, args.captures[(k + 1) % len(args.captures)])
            print(f"{source.name:12s} {kind:12s} {outcome(folder)}", flush=True)


if __name__ == "__main__":
    main()
