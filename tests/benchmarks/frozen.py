"""Print how often `check` takes clips for frozen ones that are not, and how often it names frozen and doubled pictures.

    python tests/benchmarks/frozen.py

Clips of 120 pictures, 320 x 180 px: a patch moves over a texture in seven ways, from not at all to turning back every
three pictures, with noise of 0, 1 and 3 levels of 255, uncompressed, as H.264 of crf 18 and of crf 30. Faults: 24 and
5 pictures frozen, one doubled, frozen to the end, every fourth doubled (another rate). Not faults: as it is, the light
off for 12 pictures, 3 black pictures.
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from itertools import product
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))

from damaged_clips import write_gray

from jawusd.media.clip_checks import picture_changes, repeated_runs
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


def main() -> None:
    """Run."""
    named, clips, elsewhere = Counter[str](), Counter[str](), 0
    with tempfile.TemporaryDirectory() as scratch:
        for (motion, place), noise in product(MOTIONS.items(), (0, 1, 3)):
            pictures = scene(place, noise)
            for fault, crf in product([*FAULTS, "as it is", "light off", "black"], (None, 18, 30)):
                shown = changed(pictures, fault)
                clip = (
                    shown if crf is None else Video(write_gray(Path(scratch) / "a.mp4", shown, crf)).frames(threads=1)
                )
                runs = repeated_runs(picture_changes(one if crf is None else one.image for one in clip))
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
