"""Write a degraded copy of a capture: python tests/benchmarks/degrade.py CAPTURE KIND -o DIR [--frames A B].

What a kind leaves alone is named where it lies; what it changes is written as PNG files. The truth goes along for
scoring. The picks' frame keeps its masks: whoever sets picks sees whether that frame is segmented. Kinds:

    clean         nothing changed
    wrong_masks   5 % of the masks grossly wrong: of a frame far away, 40 px off, with a blob, or of the other row
    camera_gap    no masks of the last camera over 100 frames
    dilated       all masks 1 px too wide at full resolution
    late          the last camera late by a quarter of a frame
    extrinsics    every camera turned by 0.1 degrees and moved by 0.2 mm, at random
    distortion    radial distortion k1 = -0.15, in the pictures and in the calibration
    upper_hidden  no masks of the upper teeth over 10 frames
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from jawusd.cameras.calibration import load_calibration, save_calibration
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.capture import Capture, load_capture
from jawusd.geometry import Camera, make_transform, se3_exp, se3_inverse, se3_log, so3_exp, transform_points
from jawusd.media.masks import MaskReader
from jawusd.meshes.meshio import load_mesh

ROWS = ("upper", "lower")
WRONG_SHARE, WRONG_SHIFT_PX = 0.05, 40
GAP_FRAMES, HIDDEN_FRAMES = 100, 10
LATE_FRAMES = 0.25
TURN_RAD, MOVE_MM = np.radians(0.1), 0.2
K1 = -0.15
_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_BILEVEL, 1)
_AROUND_PX = 80  # pixels farther from the teeth than that stay black whatever is done

#: Returns the mask of a row (0, 1) in a camera (index) at a frame of the reference camera, or None.
Source = Callable[[int, int, int], np.ndarray | None]


class Masks:
    """Read the masks of a capture at frames of the reference camera."""

    def __init__(self, capture: Capture, cameras: list[Camera], offsets: list[int]) -> None:
        """Open the readers."""
        self._offsets = offsets
        self._readers = [
            [MaskReader(path, camera.size_px) for path in (source.masks.upper, source.masks.lower)]
            for source, camera in zip(capture.cameras, cameras, strict=True)
        ]

    def __call__(self, camera: int, row: int, frame: int) -> np.ndarray | None:
        """Return a mask, None where there is none."""
        return self._readers[camera][row].read(frame - self._offsets[camera])

    def close(self) -> None:
        """End the threads that decode ahead."""
        for pair in self._readers:
            for reader in pair:
                reader.close()


def degrade(capture: Capture, kind: str, folder: Path, frames: tuple[int, int] | None = None, seed: int = 0) -> Path:
    """Write a degraded copy.

    Args:
        capture: as loaded; comes with truth/truth.npz.
        kind: one of `KINDS`.
        folder: where to; made if absent.
        frames: first frame and one past the last, by default the capture's.
        seed: of everything random.

    Returns:
        The folder; load it with `allow_outside`.
    """
    if kind not in KINDS:
        raise SystemExit(f"kind {kind} is unknown, there are {', '.join(KINDS)}")
    frames = frames or capture.frames
    folder.mkdir(parents=True, exist_ok=True)
    cameras = {camera.name: camera for camera in load_calibration(capture.calibration)}
    cameras = [cameras[source.name] for source in capture.cameras]
    with np.load(capture.folder / "truth" / "truth.npz", allow_pickle=False) as archive:
        truth = {name: archive[name] for name in archive.files}
    offsets = dict(zip(truth["camera_names"].tolist(), truth["offsets"].tolist(), strict=True))
    offsets = [offsets[camera.name] for camera in cameras]
    masks = Masks(capture, cameras, offsets)
    rng = np.random.default_rng(seed)
    try:
        changed, cameras_then = KINDS[kind](capture, cameras, truth, frames, masks, rng)
        for (c, row), source in changed.items():
            _write_masks(folder, cameras[c].name, ROWS[row], source, range(*frames), offsets[c], c, row)
    finally:
        masks.close()
    save_calibration(folder / "calibration.toml", cameras_then)
    link = folder / "truth"
    if not link.exists():
        link.symlink_to(capture.folder / "truth", target_is_directory=True)
    names = {(cameras[c].name, ROWS[row]) for c, row in changed}
    write_text_atomic(folder / "capture.toml", _toml(capture, frames, names, dict(zip(cameras, cameras_then))))
    return folder


def _write_masks(folder, camera: str, name: str, source: Source, frames: range, offset: int, c: int, row: int) -> None:
    out = folder / "masks" / camera / name
    out.mkdir(parents=True, exist_ok=True)
    for old in out.iterdir():
        old.unlink()
    for frame in frames:
        mask = source(c, row, frame)
        if mask is not None:
            cv2.imwrite(str(out / f"{frame - offset:06d}.png"), mask, _PNG)


def _toml(capture: Capture, frames, changed: set, cameras: dict[Camera, Camera]) -> str:
    """Return the description of the copy; picks move with the lens distortion."""
    scans = {name: getattr(capture.scans, name) for name in type(capture.scans).model_fields}
    lines = [
        'format = "jawusd-capture/1"',
        f'name = "{capture.name}"',
        f"fps = {capture.fps}",
        'calibration = "calibration.toml"',
        f"frames = [{frames[0]}, {frames[1]}]",
        "[scans]",
        *(f'{name} = "{path}"' for name, path in scans.items() if path is not None),
    ]
    for source in capture.cameras:
        lines += ["[[camera]]", f'name = "{source.name}"']
        for row in ROWS:
            pattern = f"masks/{source.name}/{row}/%06d.png"
            path = pattern if (source.name, row) in changed else getattr(source.masks, row)
            lines.append(f'masks.{row} = "{path}"')
    table = {before.name: (before, after) for before, after in cameras.items()}
    lines += ["[bootstrap]", f"frame = {capture.bootstrap.frame}"]
    for row in ROWS:
        for pick in getattr(capture.bootstrap, row):
            views = []
            for view in pick.views:
                before, after = table[view.camera]
                x, y = after.distort_pixels(before.undistort_pixels([view.x, view.y]))
                views.append(f'{{ camera = "{view.camera}", x = {x:.4f}, y = {y:.4f} }}')
            lines += [f"[[bootstrap.{row}]]", f"vertex = {pick.vertex}", f"views = [{', '.join(views)}]"]
    return "\n".join([*lines, ""])


def _everywhere(cameras, source: Source) -> dict:
    return {(c, row): source for c in range(len(cameras)) for row in (0, 1)}


def _clean(capture, cameras, truth, frames, masks, rng):
    return {}, cameras


def _wrong_masks(capture, cameras, truth, frames, masks, rng):
    away = max(1, (frames[1] - frames[0]) // 3)
    chosen = {}
    for key in _everywhere(cameras, masks):
        for frame in np.flatnonzero(rng.random(frames[1] - frames[0]) < WRONG_SHARE) + frames[0]:
            chosen[(*key, int(frame))] = (rng.integers(4), *rng.uniform(0, 2 * np.pi, 2))
    far = Masks(capture, cameras, masks._offsets)  # frames far away, without disturbing the reading ahead

    def source(c, row, frame):
        mask = masks(c, row, frame)
        if mask is None or (c, row, frame) not in chosen or frame == capture.bootstrap.frame:
            return mask
        how, angle, turn = chosen[c, row, frame]
        if how == 0:
            return far(c, row, frames[0] + (frame - frames[0] + away) % (frames[1] - frames[0]))
        if how == 1:
            shift = np.float64([[1, 0, WRONG_SHIFT_PX * np.cos(angle)], [0, 1, WRONG_SHIFT_PX * np.sin(angle)]])
            return cv2.warpAffine(mask, shift, mask.shape[::-1], flags=cv2.INTER_NEAREST)
        if how == 2:
            y, x = np.argwhere(mask)[int(turn / (2 * np.pi) * np.count_nonzero(mask))]
            return cv2.circle(mask.copy(), (int(x), int(y)), 120, 255, -1)
        return far(c, 1 - row, frame)

    return _everywhere(cameras, source), cameras


def _camera_gap(capture, cameras, truth, frames, masks, rng):
    gap = _middle(frames, GAP_FRAMES)
    last = len(cameras) - 1
    source = lambda c, row, frame: None if frame in gap else masks(c, row, frame)  # noqa: E731
    return {(last, row): source for row in (0, 1)}, cameras


def _dilated(capture, cameras, truth, frames, masks, rng):
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))

    def source(c, row, frame):
        mask = masks(c, row, frame)
        return None if mask is None else cv2.dilate(mask, disc)

    return _everywhere(cameras, source), cameras


def _late(capture, cameras, truth, frames, masks, rng):
    """Show what lies between two frames: both masks carried there with the teeth, their signed distances mixed."""
    last = len(cameras) - 1
    ahead = Masks(capture, cameras, masks._offsets)
    index = {int(frame): k for k, frame in enumerate(truth["frames"])}
    scans = [load_mesh(p).vertices[::40] for p in (capture.scans.upper_teeth, capture.scans.lower_teeth)]

    def source(c, row, frame):
        now, then = masks(c, row, frame), ahead(c, row, frame + 1)
        if now is None or then is None or frame + 1 not in index:
            return now
        a, b = (truth[f"T_world_{ROWS[row]}"][index[f]] for f in (frame, frame + 1))
        between = se3_exp(LATE_FRAMES * se3_log(b @ se3_inverse(a))) @ a
        part = _surroundings(np.maximum(now, then))
        corner = [part[1].start, part[0].start]
        there = cameras[c].project(transform_points(between, scans[row])) - corner
        mixed = 0.0
        for mask, pose, weight in ((now, a, 1 - LATE_FRAMES), (then, b, LATE_FRAMES)):
            here = cameras[c].project(transform_points(pose, scans[row])) - corner
            carry = np.linalg.lstsq(np.column_stack([here, np.ones(len(here))]), there, rcond=None)[0].T
            signed = _signed_px(mask[part])
            mixed = mixed + weight * cv2.warpAffine(signed, carry, signed.shape[::-1], borderValue=-1e3)
        out = np.zeros_like(now)
        out[part] = (mixed > 0) * np.uint8(255)
        return out

    return {(last, row): source for row in (0, 1)}, cameras


def _signed_px(mask: np.ndarray) -> np.ndarray:
    """Return the distance to the outline, positive inside [px]."""
    inside = (mask > 127).astype(np.uint8)
    deep, far = (cv2.distanceTransform(m, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for m in (inside, 1 - inside))
    return np.where(inside > 0, deep - 0.5, 0.5 - far)


def _surroundings(mask: np.ndarray) -> tuple[slice, slice]:
    """Return the part of a picture that holds the mask and what is near it."""
    ends = [np.flatnonzero(mask.any(axis))[[0, -1]] for axis in (1, 0)]
    return tuple(slice(max(0, a - _AROUND_PX), b + 1 + _AROUND_PX) for a, b in ends)


def _extrinsics(capture, cameras, truth, frames, masks, rng):
    moved = []
    for camera in cameras:
        axis, way = rng.normal(size=(2, 3))
        turn = so3_exp(TURN_RAD * axis / np.linalg.norm(axis))
        change = make_transform(turn, MOVE_MM * way / np.linalg.norm(way))
        moved.append(replace(camera, T_cam_world=change @ camera.T_cam_world))
    return {}, moved


def _distortion(capture, cameras, truth, frames, masks, rng):
    lenses, maps = [], []
    for camera in cameras:
        lens = replace(camera, distortion=np.r_[K1, np.pad(camera.distortion, (0, 5))[1:5]])
        grid = np.stack(np.meshgrid(*map(np.arange, camera.size_px)), -1).astype(np.float64)
        lenses.append(lens)
        maps.append(camera.distort_pixels(lens.undistort_pixels(grid)).astype(np.float32))

    def source(c, row, frame):
        mask = masks(c, row, frame)
        if mask is None:
            return None
        out = np.zeros_like(mask)
        part = _surroundings(mask)
        out[part] = (cv2.remap(mask, maps[c][part], None, cv2.INTER_LINEAR) > 127) * np.uint8(255)
        return out

    return _everywhere(cameras, source), lenses


def _upper_hidden(capture, cameras, truth, frames, masks, rng):
    hidden = _middle(frames, HIDDEN_FRAMES)
    source = lambda c, row, frame: None if frame in hidden else masks(c, row, frame)  # noqa: E731
    return {(c, 0): source for c in range(len(cameras))}, cameras


def _middle(frames: tuple[int, int], count: int) -> range:
    first = (frames[0] + frames[1] - count) // 2
    return range(first, first + count)


KINDS: dict[str, Callable] = {
    "clean": _clean,
    "wrong_masks": _wrong_masks,
    "camera_gap": _camera_gap,
    "dilated": _dilated,
    "late": _late,
    "extrinsics": _extrinsics,
    "distortion": _distortion,
    "upper_hidden": _upper_hidden,
}


def main() -> None:
    """Write the copy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("kind", choices=list(KINDS))
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, nargs=2, metavar=("A", "B"), help="first frame, one past the last")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    frames = tuple(options.frames) if options.frames else None
    print(os.path.abspath(degrade(load_capture(options.capture), options.kind, options.out, frames, options.seed)))


if __name__ == "__main__":
    main()
