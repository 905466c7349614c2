"""Jaw motion of a shot from facial skin: face data, aligned with the shot's clock, or points in its own footage."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from functools import partial
from math import ceil, floor

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import AnyPath, FittingError
from jawusd.capture.skin_points import SkinTracker
from jawusd.evaluator import JawRig
from jawusd.evaluator.skin import SkinJaw
from jawusd.fitting.face import columns_at
from jawusd.fitting.shot_skin import ShotJaw, in_head, jaw_of_points
from jawusd.fitting.skin import clock_offset
from jawusd.formats.capture import Capture
from jawusd.geometry import Camera, se3_inverse, transform_point
from jawusd.media.pixels import ColourPicture
from jawusd.pipeline.cameras import open_colour_footage
from jawusd.pipeline.skin import SIGMA_MM, SkinOptions, load_own_skin, read_shot_face
from jawusd.pipeline.state import Progress
from jawusd.segmentation.picture import ColourFootage

# Minimum number of frames with visible teeth for comparison with the skin; standard deviation that is added to that of
# d from skin [mm], since d of the first pass is not exact either; and maximum mean squared difference of d over the
# resulting variance. See docs/explanation/constants.md.
_COMPARED, _FIRST_PASS_MM, _MOST_APART = 20, 0.5, 4.0


class SkinOfShot:
    """Jaw parameters of a shot, estimated from facial skin; a function object for the solver.

    `offset_s` are the seconds from frame 0 of the shot to frame 0 of the face data, None until it is estimated;
    `unfamiliar` are the frames of the last call in which the face is unlike those from which the map was learned.
    """

    def __init__(self, rig: JawRig, options: SkinOptions, fps: float) -> None:
        """Read the map and the face data; `fps` is the frame rate of the shot [1/s].

        Raises like `load_own_skin` and `read_shot_face`.
        """
        self._skin = load_own_skin(rig, options.skin)
        self._fps, self._face = fps, options.face
        self._face_s, self._columns = read_shot_face(self._skin, options)
        self.offset_s, self.unfamiliar = options.offset_s, np.zeros(0, np.int64)

    def frames(self) -> range:
        """Return the frames of the shot that the face data cover; raises FittingError if their offset is unknown."""
        first, last = (self._face_s[[0, -1]] + self._known_offset()) * self._fps
        return range(max(ceil(first), 0), max(floor(last) + 1, 0))

    def __call__(self, frames: Array, d: Array, seen: Mask, heads: Array | None = None) -> SkinJaw:
        """Return the jaw parameters estimated from skin in some frames; see `tracking.performance.skin.SkinOf`.

        Raises FittingError if the clocks cannot be aligned, no face is familiar, or skin and teeth disagree.
        """
        times = frames / self._fps
        if self.offset_s is None and seen.any():
            self.offset_s = clock_offset(self._face_s, self._skin(self._columns).d, times[seen], d[seen])
        found = self._skin(columns_at(self._face_s + self._known_offset(), self._columns, times))
        if not found.familiar.any():
            raise FittingError(
                f"{os.fspath(self._face)}: in none of the {len(frames)} frames does the face resemble the data from "
                "which the map was learned.",
                hint="Check the units of face and map (--length-unit), the rigid body of the head (--rigid) and the "
                "offset of the clocks (--offset).",
            )
        self.unfamiliar = frames[np.isfinite(found.d).all(axis=1) & ~found.familiar].astype(np.int64)
        rows = seen & found.familiar
        if rows.sum() >= _COMPARED:
            check_agreement(self._face, SkinJaw(found.d[rows], found.covariance[rows], rows[rows]), d[rows])
        return found

    def _known_offset(self) -> float:
        if self.offset_s is None:
            raise FittingError(
                "the offset between face and shot is unknown: it can only be estimated if teeth are visible.",
                hint="Give the seconds from frame 0 of the shot to frame 0 of the face with --offset.",
            )
        return self.offset_s


def check_agreement(face: AnyPath, found: SkinJaw, d: Array) -> None:
    """Check that d from skin agrees with d (F, 3) [mm] from visible teeth, in frames with a familiar face.

    Raises FittingError if the two differ by much more than their expected error.
    """
    away = found.d - d
    variance = np.einsum("fii->fi", found.covariance) + _FIRST_PASS_MM**2
    apart = float((away**2 / variance).mean())
    if apart > _MOST_APART:
        raise FittingError(
            f"{os.fspath(face)}: in {len(d)} frames with visible teeth, d from the skin differs "
            f"from d from the teeth by {np.sqrt((away**2).mean()):.1f} mm (root mean square), "
            f"{np.sqrt(apart):.1f} times the expected error; at most {np.sqrt(_MOST_APART):g} times is accepted.",
            hint="Check that the face data belong to this shot, and that the map was learned with this rig and the "
            "same points; check the offset of the clocks (--offset).",
        )


class SkinOfFootage:
    """Jaw parameters of a shot, estimated from points on the skin in its footage; a function object for the solver.

    `learned` is the jaw of the last call, None before, and `points` the number of points that it was learned from.
    """

    def __init__(
        self,
        rig: JawRig,
        cameras: Mapping[str, Camera],
        footage: ColourFootage,
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> None:
        """Store the cameras of the footage by name; raises FittingError if there is only one."""
        if len(cameras) < 2:
            raise FittingError(
                "skin in the footage needs two or more cameras that see it.",
                hint="Film with a second camera, or follow the face in another program (--face).",
            )
        self._rig, self._cameras, self._footage, self._progress = rig, dict(cameras), footage, progress
        self.learned: ShotJaw | None = None
        self.points = 0

    def __call__(self, frames: Array, d: Array, seen: Mask, heads: Array) -> SkinJaw:
        """Return the jaw parameters estimated from skin in some frames; see `tracking.performance.skin.SkinOf`.

        Raises CaptureError, and FittingError if too few points can be followed, or the jaw cannot be learned from them.
        """
        X = in_head(self.followed(frames.astype(int).tolist(), d, seen, heads), heads, seen)
        self.learned, self.points = jaw_of_points(self._rig, X, d, seen, SIGMA_MM), X.shape[1]
        return self.learned.jaw

    def summary(self) -> dict[str, object]:
        """Return the number of points, of frames with visible teeth, and the held-out errors; empty before learning."""
        if self.learned is None:
            return {}
        return {"points": self.points, "frames": self.learned.frames, "errors_mm": self.learned.errors_mm}

    def followed(self, frames: list[int], d: Array, seen: Mask, heads: Array) -> Array:
        """Return the points on the skin in the world [mm], shape (F, N, 3), NaN where not found; see `__call__`."""
        key, images = self._key(frames, d, seen)
        mouth = heads[key] @ se3_inverse(self._rig.T_anatomical_skull)
        incisor = self._rig.landmarks[0]
        low = transform_point(self._rig.T_anatomical_skull @ self._rig.pose(d[key]), incisor)
        tracker = SkinTracker(tuple(self._cameras.values()), images, mouth, max(float(-low[1]), 0.0))
        points = np.full((len(frames), len(tracker.points_world), 3), np.nan)
        points[key] = tracker.points_world
        done = 1
        for way in (range(key + 1, len(frames)), range(key - 1, -1, -1)):
            follower = tracker.follower()
            numbers = range(frames[0] + way.start, frames[0] + way.stop, way.step)
            for row, (_, pictures) in zip(way, self._footage.walk(numbers)):
                points[row] = follower.step(pictures)
                done += 1
                self._progress(done, len(frames))
        return points

    def _key(self, frames: list[int], d: Array, seen: Mask) -> tuple[int, dict[str, ColourPicture]]:
        """Return the index of the frame with visible teeth that is most like the others, and its images."""
        if not seen.any():
            raise FittingError("no frame shows the teeth, from which the motion of the skin could be learned.")
        away = np.linalg.norm(d - np.median(d[seen], axis=0), axis=1)
        for key in np.argsort(np.where(seen, away, np.inf))[: int(seen.sum())].tolist():
            shown = {name: image for name, image in self._footage.at(frames[key]).items() if image is not None}
            if set(shown) >= set(self._cameras):
                return key, shown
        raise FittingError("no frame that shows the teeth has an image of every camera.")


def skin_of_footage(
    capture: Capture, jaw: JawRig, offsets: Mapping[str, int], free_focal: bool, progress: Progress
) -> SkinOfFootage:
    """Return the estimator that uses skin in the videos of a shot; raises like `open_footage`.

    Raises FittingError if fewer than two cameras have videos, or if focal lengths are unknown.
    """
    if free_focal:
        raise FittingError(
            "skin in the footage needs known focal lengths.", hint="Calibrate the cameras, or leave out --skin footage."
        )
    return SkinOfFootage(jaw, *open_colour_footage(capture, offsets), partial(progress, "skin"))
