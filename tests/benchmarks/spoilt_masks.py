"""Spoil single masks of a capture folder: one arch in one camera, in some frames."""

from pathlib import Path

import cv2
import numpy as np
from subjects.annotator import write_mask

KINDS = ("eroded", "moved", "exchanged")
EVERY = 4  # every fourth frame is spoilt
ERODED_MM, MOVED_MM = 1.0, 3.0


def spoil(folder: Path, cameras: int, rng: np.random.Generator) -> None:
    """Spoil masks of the first cameras in place, with the kinds in turn.

    The numbers of the spoilt frames, counted from the first one, are written to `spoilt.npy`.
    """
    with np.load(folder / "truth" / "truth.npz", allow_pickle=False) as truth:
        names, K, first = truth["camera_names"].tolist(), truth["K"], int(truth["frames"][0])
        away = [R @ truth["T_world_upper"][0, :3, 3] + t for R, t in zip(truth["R"], truth["t"], strict=True)]
        count = len(truth["frames"])
    spoilt = np.arange(EVERY - 1, count, EVERY)
    read = lambda path: cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.exists() else None  # noqa: E731
    drawn = {}
    for k, frame in enumerate(spoilt):
        camera, row = int(rng.integers(cameras)), rng.choice(("upper", "lower"))
        paths = [
            folder / "masks" / names[camera] / row / f"{first + n:06d}.png"
            for n in (frame, (frame + count // 2) % count)
        ]
        mask, other = map(read, paths)
        if mask is not None and other is not None:
            px_per_mm = K[camera, 0, 0] / away[camera][2]
            drawn[paths[0]] = changed(mask, other, KINDS[k % len(KINDS)], px_per_mm, rng)
    for path, mask in drawn.items():
        write_mask(str(path), mask)
    np.save(folder / "spoilt.npy", spoilt)


def changed(mask: np.ndarray, other: np.ndarray, kind: str, px_per_mm: float, rng: np.random.Generator) -> np.ndarray:
    """Return a mask (h, w) after a change; `other` is that of a distant frame."""
    if kind == "eroded":
        deep = cv2.distanceTransform((mask > 127).astype(np.uint8), cv2.DIST_L2, 5)
        return np.where(deep > ERODED_MM * px_per_mm, 255, 0).astype(np.uint8)
    if kind == "exchanged":
        return other
    angle = rng.uniform(0.0, 2 * np.pi)
    shift = MOVED_MM * px_per_mm * np.array([[np.cos(angle)], [np.sin(angle)]])
    return cv2.warpAffine(mask, np.hstack([np.eye(2), shift]), mask.shape[::-1], flags=cv2.INTER_NEAREST)
