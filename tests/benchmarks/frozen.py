"""Print how often `check` takes clips for frozen ones that are not, and how often it names frozen and doubled pictures.

    python tests/benchmarks/frozen.py
    python tests/benchmarks/frozen.py --held-out 300 --seed 9000

The first command runs the clips on which the thresholds were chosen: 120 pictures, 320 x 180 px, in which a patch
moves over a texture in seven ways, from not at all to turning back every three pictures, with noise of 0, 1 and 3
levels of 255, uncompressed, as H.264 of crf 18 and of crf 30. Faults: 24 and 5 pictures
frozen, one doubled, frozen to the end, every fourth doubled (another rate). Not faults: as it is, the light off for 12
pictures, 3 black pictures.

The second command runs random clips on which nothing was chosen: other textures, sizes, lengths, motions (sums of sines
with pauses), noise, exposure drift, encoder settings, and places and lengths of the faults.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from itertools import product
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))

from damaged_clips import write_gray

from jawusd.media.checks import picture_changes, repeated_runs
from jawusd.media.video import Video

SIZE = (320, 180)
MOTIONS = {
    "talking": lambda k: 6 * np.sin(k / 5) + 2.5 * np.sin(k / 2.3),
    "slow": lambda k: 8 * np.sin(k / 20),
    "at rest, then moving": lambda k: 0.0 if k < 60 else 6 * (1 - np.cos((k - 60) / 6)),
    "still": lambda k: 0.0,
    "starting and stopping": lambda k: 0.0 if k // 30 % 2 == 0 else 6 * np.sin(k % 30 / 3),
    "turning every 3 pictures": lambda k: 5 * np.sin(1.1 * k),
    "random": lambda k: float(np.cumsum(np.random.default_rng(5).normal(0, 0.7, 200))[k]),
}
#: Pictures that are replaced by the one before them.
FAULTS = {
    "24 frozen": range(60, 84),
    "5 frozen": range(60, 65),
    "frozen end": range(90, 120),
    "doubled": range(60, 61),
    "other rate": range(3, 120, 4),
}


def scene(motion, noise: float) -> np.ndarray:
    """Return pictures (120, h, w) uint8."""
    rng = np.random.default_rng(3)
    back, patch = (
        cv2.GaussianBlur(rng.integers(0, 256, s).astype(np.float32), (0, 0), 2) for s in (SIZE[::-1], (60, 80))
    )
    back, patch = 3 * (back - back.mean()) + 110, 4 * (patch - patch.mean()) + 150
    pictures = []
    for k in range(120):
        M = np.array([[1, 0, 120], [0, 1, 60 + motion(k)]], np.float32)
        moved = cv2.warpAffine(patch, M, SIZE, borderValue=-1000)
        shown = np.where(moved > -900, moved, back) + rng.normal(size=back.shape) * noise
        pictures.append(np.clip(shown, 0, 255).astype(np.uint8))
    return np.stack(pictures)


def changed(pictures: np.ndarray, fault: str) -> np.ndarray:
    """Return the pictures with a fault, or with what is none."""
    out = pictures.copy()
    for k in FAULTS.get(fault, ()):
        out[k] = out[k - 1]
    if fault == "light off":
        out[60:72] = out[60:72] // 10
    if fault == "black":
        out[60:63] = 0
    return out


def runs_in(shown: np.ndarray, crf: int | None, folder: Path) -> list[tuple[int, int]]:
    """Return the runs of repeated pictures found in pictures, encoded first if `crf` is a number."""
    frames = (
        shown if crf is None else (f.image for f in Video(write_gray(folder / "a.mp4", shown, crf)).frames(threads=1))
    )
    return repeated_runs(picture_changes(frames))


def random_scene(rng: np.random.Generator) -> np.ndarray:
    """Return the pictures (n, h, w) uint8 of a random scene that repeats no picture on purpose."""
    n, size = int(rng.integers(60, 240)), (int(rng.choice([240, 320, 480])), int(rng.choice([136, 180, 270])))
    back, patch = (
        cv2.GaussianBlur(rng.uniform(0, 256, shape).astype(np.float32), (0, 0), rng.uniform(1, 5))
        for shape in (size[::-1], (size[1] // 3, size[0] // 4))
    )
    back, patch = (rng.uniform(8, 45) * (a - a.mean()) / a.std() + rng.uniform(70, 170) for a in (back, patch))
    k = np.arange(n)
    speed = np.ones(n)
    if rng.random() < 0.4:  # a pause, which a person begins and ends within 3 to 10 pictures
        first = int(rng.integers(0, n - 20))
        speed[first : first + int(rng.integers(10, 60))] = 0.0
        ramp = np.hanning(int(rng.integers(3, 11)) + 2)
        speed = np.convolve(np.pad(speed, len(ramp) // 2, mode="edge"), ramp / ramp.sum(), mode="valid")[:n]
    time = np.cumsum(speed)
    path = sum(rng.uniform(1, 6) * np.sin(time * rng.uniform(0.03, 0.5) + rng.uniform(0, 6)) for _ in range(3))
    drift = 1.0 + rng.uniform(0, 0.04) * np.sin(k * rng.uniform(0.01, 0.2))
    noise = float(rng.choice([0.0, rng.uniform(0.2, 4.0)]))
    pictures = []
    for y, exposure in zip(path, drift, strict=True):
        M = np.array([[1, 0, size[0] * 0.4], [0, 1, size[1] * 0.35 + y]], np.float32)
        moved = cv2.warpAffine(patch, M, size, borderValue=-1000)
        shown = exposure * np.where(moved > -900, moved, back) + rng.normal(size=back.shape) * noise
        pictures.append(np.clip(shown, 0, 255).astype(np.uint8))
    return np.stack(pictures)


def held_out(count: int, seed: int) -> None:
    """Print the figures of random clips, each as it is, dimmed for a while, and with one random freeze."""
    named, clips = Counter[str](), Counter[str]()
    with tempfile.TemporaryDirectory() as scratch:
        for k in range(count):
            rng = np.random.default_rng(seed + k)
            pictures = random_scene(rng)
            n, crf = len(pictures), [None, *range(16, 33)][int(rng.integers(18))]
            length = int(rng.choice([1, 5, 12, 24]))
            first = int(rng.integers(15, n - length - 14))
            frozen, dimmed = pictures.copy(), pictures.copy()
            frozen[first : first + length] = frozen[first - 1]
            dimmed[first : first + length] = dimmed[first : first + length] // int(rng.integers(4, 40))
            for name, shown in (("as it is", pictures), ("light off", dimmed)):
                runs = runs_in(shown, crf, Path(scratch))
                clips[name] += 1
                named[name] += bool(runs)
                if runs:
                    print(f"false: seed {seed + k}, {name}, crf {crf}: {runs[:4]}", flush=True)
            hidden = float(np.abs(pictures[first + length - 1].astype(int) - pictures[first - 1]).mean())
            floor = max(float(np.nanpercentile(picture_changes(pictures), 5)), 0.3)
            key = f"{length:2} frozen, " + ("in motion" if hidden > 3 * floor else "nearly at rest")
            clips[key] += 1
            named[key] += any(a <= first + length and b + 2 >= first for a, b in runs_in(frozen, crf, Path(scratch)))
    for key, total in sorted(clips.items()):
        print(f"{key:28} named in {named[key]:3} of {total:3}")


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--held-out", type=int, metavar="N", help="number of random clips")
    parser.add_argument("--seed", type=int, default=9000)
    options = parser.parse_args()
    if options.held_out:
        return held_out(options.held_out, options.seed)
    named, clips, elsewhere = Counter[str](), Counter[str](), 0
    with tempfile.TemporaryDirectory() as scratch:
        for (motion, place), noise in product(MOTIONS.items(), (0, 1, 3)):
            pictures = scene(place, noise)
            for fault, crf in product([*FAULTS, "as it is", "light off", "black"], (None, 18, 30)):
                shown = changed(pictures, fault)
                runs = runs_in(shown, crf, Path(scratch))
                wanted = FAULTS.get(fault, range(0))
                hit = [run for run in runs if run[0] - 2 <= wanted[-1] and run[1] + 2 >= wanted[0]] if wanted else []
                key = f"{fault:10} {motion if wanted else ''}".strip()
                clips[key] += 1
                named[key] += bool(hit if wanted else runs)
                elsewhere += len(runs) > len(hit)
                if len(runs) > len(hit):
                    print(f"false: {fault}, {motion}, noise {noise}, crf {crf}: {runs[:4]}", flush=True)
    for key, count in clips.items():
        print(f"{key:36} named in {named[key]:2} of {count:2}")
    print(f"pictures named that repeat none: in {elsewhere} of {clips.total()} clips")


if __name__ == "__main__":
    main()
