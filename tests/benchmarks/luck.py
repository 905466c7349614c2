"""Track a capture many times with inputs changed by nothing that matters, and compare the runs with the truth.

    python tests/benchmarks/luck.py CAPTURE [--runs 10] [--seed 0] [--footage] [--without-picks]
        [--cameras cam0,cam2] [--turn cam0=1,cam2=2] [--noise 16,36]

CAPTURE has truth/truth.npz; with --footage its masks are ignored, with --without-picks its picks. --cameras leaves out
all others; --turn turns images by counter-clockwise quarter turns, as if these cameras had been mounted so; --noise
replaces images and masks of these frames, the last one excluded, by noise, and does not count them as lost. Every run
is a process of its own. The first is the capture as it is; the others change one thing each, in turn:

    1e-9, 1e-3, 0.1, 0.3 px   picks moved by normal noise of that size
    grey                      a grey level of noise, -1, 0 or 1, in the videos (masks stay)
    order                     cameras in reverse order
    reversed                  videos and masks played backwards (masks must be videos)
    first                     the first frame left out, or the last one if picks are on the first one
    thread                    one thread instead of three
    generic                   compiled for a processor without vector units

Per run: frames lost; distance of the incisal point from the truth over the others, mean and worst [mm]; frames off by
more than 1 mm whose stated standard deviation is under 0.5 mm; findings. Then mean, worst and spread of the runs.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))
from turned_cameras import turned

from jawusd.cameras.calibration import save_calibration
from jawusd.formats.capture import Bootstrap, Capture, load_capture
from jawusd.formats.tracks import LOST, Tracks
from jawusd.geometry import transform_point
from jawusd.pipeline.calibrate import sync_cameras
from jawusd.pipeline.cameras import load_cameras
from jawusd.pipeline.subject import load_meshes, subject_of_capture
from jawusd.pipeline.track import track

KINDS = ("1e-9 px", "1e-3 px", "0.1 px", "0.3 px", "grey", "order", "reversed", "first", "thread", "generic")
WRONG_MM, SURE_MM = 1.0, 0.5
ROWS = ("upper", "lower")


def moved_picks(picks: Bootstrap, sigma_px: float, rng: np.random.Generator) -> Bootstrap:
    """Return picks with noise."""

    def moved(view):
        x, y = rng.normal((view.x, view.y), sigma_px)
        return view.model_copy(update={"x": float(x), "y": float(y)})

    def row(given):
        return tuple(pick.model_copy(update={"views": tuple(map(moved, pick.views))}) for pick in given)

    return picks.model_copy(update={"upper": row(picks.upper), "lower": row(picks.lower)})


def rewritten(
    source: Path,
    target: Path,
    reverse: bool = False,
    rng: np.random.Generator | None = None,
    turns: int = 0,
    hidden: range = range(0),
) -> int:
    """Write a video without loss: backwards, with a grey level of noise, turned, or with noise instead of some frames.

    Returns:
        the number of frames.
    """
    with av.open(str(source)) as opened:
        stream = opened.streams.video[0]
        pictures = list(opened.decode(stream))
        rate = Fraction(stream.average_rate)
    layout = "gray" if pictures[0].format.name.startswith("gray") else "yuv420p"
    with av.open(str(target), "w") as made:
        out = made.add_stream("ffv1", rate=rate)
        size = (pictures[0].width, pictures[0].height)[:: -1 if turns % 2 else 1]
        out.width, out.height, out.pix_fmt = *size, layout
        for index, picture in enumerate(reversed(pictures) if reverse else pictures):
            values = picture.to_ndarray(format=layout)
            if index in hidden:
                values = np.random.default_rng(index).integers(0, 256, values.shape, dtype=np.uint8)
                if layout == "gray":  # masks are black and white
                    values = np.where(values > 127, 255, 0).astype(np.uint8)
            if rng is not None:
                luma = values[: picture.height].astype(np.int16)
                luma += rng.integers(-1, 2, luma.shape, dtype=np.int16)
                values[: picture.height] = np.clip(luma, 0, 255)
            if turns:
                values = np.ascontiguousarray(np.rot90(picture.to_ndarray(format="rgb24"), turns))
                frame = av.VideoFrame.from_ndarray(values, "rgb24").reformat(format=layout)
            else:
                frame = av.VideoFrame.from_ndarray(values, layout)
            frame.colorspace, frame.color_range = picture.colorspace, picture.color_range
            made.mux(out.encode(frame))
        made.mux(out.encode(None))
    return len(pictures)


def mounted(capture: Capture, names: Sequence[str], turns: Mapping[str, int], folder: Path) -> Capture:
    """Return a capture with only some cameras, some of them turned by quarter turns; masks and picks are dropped."""
    reference = capture.sync.reference or capture.cameras[0].name
    offsets = sync_cameras(capture, lambda *_: None)["offsets"]
    cameras, placed = [], []
    known = {camera.name: camera for camera in load_cameras(capture)}
    for camera in capture.cameras:
        if camera.name in names or camera.name == reference:
            video, calibrated = camera.video, known[camera.name]
            if turns.get(camera.name):
                video = folder / f"{camera.name}_turned.mkv"
                rewritten(camera.video, video, turns=turns[camera.name])
                for _ in range(turns[camera.name]):
                    calibrated = turned(calibrated)
            elif camera.name not in names:
                video = None
            cameras.append(camera.model_copy(update={"video": video, "masks": None}))
            placed.append(calibrated)
    path = folder / "turned.toml"
    save_calibration(path, placed)
    sync = capture.sync.model_copy(update={"method": "offsets", "offsets": offsets, "reference": reference})
    changed = {"cameras": tuple(cameras), "sync": sync, "calibration": path, "bootstrap": None}
    return capture.model_copy(update=changed)


def interrupted(capture: Capture, frames: range, folder: Path) -> Capture:
    """Return a capture whose videos and masks show noise on some frames."""
    offsets, cameras = sync_cameras(capture, lambda *_: None)["offsets"], []
    for camera in capture.cameras:
        shift, changed = offsets[camera.name], {}
        hidden = range(frames.start - shift, frames.stop - shift)
        if camera.video:
            changed["video"] = folder / f"{camera.name}_noise.mkv"
            rewritten(camera.video, changed["video"], hidden=hidden)
        if camera.masks:
            noisy = {row: noisy_masks(getattr(camera.masks, row), hidden, folder, camera.name + row) for row in ROWS}
            changed["masks"] = camera.masks.model_copy(update=noisy)
        cameras.append(camera.model_copy(update=changed))
    sync = capture.sync.model_copy(
        update={"method": "offsets", "offsets": offsets, "reference": capture.sync.reference or capture.cameras[0].name}
    )
    return capture.model_copy(update={"cameras": tuple(cameras), "sync": sync})


def noisy_masks(masks: Path, hidden: range, folder: Path, name: str) -> Path:
    """Write masks with noise instead of some frames: a video, or files with numbers; return their path."""
    if "%" not in masks.name:
        rewritten(masks, folder / f"{name}.mkv", hidden=hidden)
        return folder / f"{name}.mkv"
    target = folder / name / masks.name
    target.parent.mkdir()
    for path in masks.parent.glob(f"*{masks.suffix}"):
        (target.parent / path.name).symlink_to(path)
    for index in hidden:
        place = target.parent / (masks.name % index)
        if place.exists():
            shape = cv2.imread(str(place), cv2.IMREAD_UNCHANGED).shape[:2]
            place.unlink()
            cv2.imwrite(str(place), np.random.default_rng(index).integers(0, 2, shape, dtype=np.uint8) * 255)
    return target


def backwards(capture: Capture, folder: Path) -> Capture:
    """Return a capture played backwards: frame k of a clip of n frames becomes frame n - 1 - k."""
    offsets, cameras, counts = sync_cameras(capture, lambda *_: None)["offsets"], [], {}
    for camera in capture.cameras:
        clips = {"video": camera.video} if camera.video else {}
        clips |= {"upper": camera.masks.upper, "lower": camera.masks.lower} if camera.masks else {}
        files = {name: folder / f"{camera.name}_{name}.mkv" for name in clips}
        for name, path in clips.items():
            counts[camera.name] = rewritten(path, files[name], True, None)
        masks = camera.masks and camera.masks.model_copy(update={k: files[k] for k in ROWS})
        cameras.append(camera.model_copy(update={"video": files.get("video"), "masks": masks}))
    reference = capture.sync.reference or capture.cameras[0].name
    last = counts[reference] - 1
    turned = {name: last + 1 - counts[name] - offset for name, offset in offsets.items()}
    sync = capture.sync.model_copy(update={"method": "offsets", "offsets": turned, "reference": reference})
    frames = capture.frames and (last + 1 - capture.frames[1], last + 1 - capture.frames[0])
    rest = capture.motion.rest_frame
    motion = capture.motion.model_copy(update={"rest_frame": None if rest is None else last - rest})
    picks = capture.bootstrap and capture.bootstrap.model_copy(update={"frame": last - capture.bootstrap.frame})
    changed = {"cameras": tuple(cameras), "sync": sync, "frames": frames, "motion": motion, "bootstrap": picks}
    return capture.model_copy(update=changed)


def changed(capture: Capture, kind: str, folder: Path, rng: np.random.Generator) -> Capture:
    """Return a capture with one thing changed."""
    if kind.endswith("px") and capture.bootstrap:
        picks = moved_picks(capture.bootstrap, float(kind[:-2]), rng)
        return capture.model_copy(update={"bootstrap": picks})
    if kind == "grey":
        cameras = []
        for camera in capture.cameras:
            if camera.video is not None:
                rewritten(camera.video, folder / f"{camera.name}.mkv", False, rng)
                camera = camera.model_copy(update={"video": folder / f"{camera.name}.mkv"})
            cameras.append(camera)
        return capture.model_copy(update={"cameras": tuple(cameras)})
    if kind == "order":
        reference = capture.sync.reference or capture.cameras[0].name
        sync = capture.sync.model_copy(update={"reference": reference})
        return capture.model_copy(update={"cameras": capture.cameras[::-1], "sync": sync})
    if kind == "first" and capture.frames:
        first, stop = capture.frames
        picked = capture.bootstrap is not None and capture.bootstrap.frame == first
        return capture.model_copy(update={"frames": (first, stop - 1) if picked else (first + 1, stop)})
    return backwards(capture, folder) if kind == "reversed" else capture


def scores(capture: Capture, tracks: Tracks, frames: np.ndarray, hidden: range) -> dict[str, object]:
    """Return what a run gives, against the truth at these frames of the capture, of which some were hidden."""
    with np.load(capture.folder / "truth" / "truth.npz") as truth:
        exact = truth["T_upper_lower"][np.searchsorted(truth["frames"], frames)]
    incisor = subject_of_capture(capture, load_meshes(capture)).landmarks[0]
    gap = transform_point(tracks.raw_T_upper_lower, incisor) - transform_point(exact, incisor)
    known = (tracks.status != LOST).all(axis=1)
    off_mm = np.linalg.norm(gap, axis=-1)[known]
    sure = tracks.sigma_mm[known, 0] < SURE_MM
    return {
        "frames": len(frames),
        "lost": [frame for frame in frames[~known].tolist() if frame not in hidden],
        "mean_mm": float(off_mm.mean()),
        "worst_mm": float(off_mm.max()),
        "silent": int(((off_mm > WRONG_MM) & sure).sum()),
        "start": tracks.meta.get("start", {}),
        "findings": sorted({str(found["kind"]) for found in tracks.meta.get("findings", [])}),
    }


def one_run(options: argparse.Namespace) -> dict[str, object]:
    """Track a capture with one thing changed."""
    capture, kind = load_capture(options.capture, allow_outside=True), options.one
    if options.footage:
        bare = tuple(camera.model_copy(update={"masks": None}) for camera in capture.cameras)
        capture = capture.model_copy(update={"cameras": bare})
    if options.without_picks:
        capture = capture.model_copy(update={"bootstrap": None})
    with tempfile.TemporaryDirectory() as folder:
        if options.cameras or options.turn:
            names = options.cameras.split(",") if options.cameras else [camera.name for camera in capture.cameras]
            turns = {
                name: int(count) for name, count in (each.split("=") for each in filter(None, options.turn.split(",")))
            }
            capture = mounted(capture, names, turns, Path(folder))
        hidden = range(*map(int, options.noise.split(","))) if options.noise else range(0)
        capture = interrupted(capture, hidden, Path(folder)) if hidden else capture
        given = changed(capture, kind, Path(folder), np.random.default_rng(options.seed))
        tracks = track(given, jobs=1 if kind == "thread" else 3)
    frames = tracks.frames
    if kind == "reversed":
        first, stop = given.frames or (int(frames[0]), int(frames[-1]) + 1)
        original = capture.frames or (first, stop)
        frames = original[0] + stop - 1 - frames
    return scores(capture, tracks, frames, hidden)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--footage", action="store_true", help="ignore masks")
    parser.add_argument("--without-picks", action="store_true", help="ignore picks")
    parser.add_argument(
        "--cameras", default="", help="names of the cameras used, by default all; ignores masks and picks"
    )
    parser.add_argument("--turn", default="", help="name=quarter turns, ...; ignores masks and picks")
    parser.add_argument("--noise", default="", help="first frame of noise, and the first one after it")
    parser.add_argument("--one", help=argparse.SUPPRESS)  # of the processes that this starts
    options = parser.parse_args()
    if options.one is not None:
        print(json.dumps(one_run(options)))
        return
    print(f"{'run':<10}{'lost':>6}{'mean':>9}{'worst':>9}{'silent':>8}  findings")
    found = []
    for run in range(options.runs):
        kind = "as it is" if run == 0 else KINDS[(run - 1) % len(KINDS)]
        line = [sys.executable, __file__, str(options.capture), "--one", kind, "--seed", str(options.seed + run)]
        line += ["--cameras", options.cameras, "--turn", options.turn, "--noise", options.noise]
        line += ["--without-picks"] if options.without_picks else []
        generic = {"NUMBA_CPU_NAME": "generic"} if kind == "generic" else {}
        line += ["--footage"] if options.footage else []
        done = subprocess.run(line, capture_output=True, text=True, check=False, env={**os.environ, **generic})
        if done.returncode:
            print(f"{kind:<10} {done.stderr.strip().splitlines()[-1][:140]}", flush=True)
            continue
        row = json.loads(done.stdout.splitlines()[-1])
        found.append(row)
        numbers = f"{len(row['lost']):>6}{row['mean_mm']:>9.3f}{row['worst_mm']:>9.3f}{row['silent']:>8}"
        print(f"{kind:<10}{numbers}  {', '.join(row['findings'])}", flush=True)
    if found:
        lost, mean = (
            np.array(each) for each in zip(*((len(row["lost"]), row["mean_mm"]) for row in found), strict=True)
        )
        worst, silent = max(row["worst_mm"] for row in found), max(row["silent"] for row in found)
        print(f"mean      {lost.mean():>6.1f}{mean.mean():>9.3f}")
        print(f"worst     {lost.max():>6}{mean.max():>9.3f}{worst:>9.3f}{silent:>8}  of {len(found)} runs")
        print(f"spread          {np.ptp(mean):>9.3f}")


if __name__ == "__main__":
    main()
