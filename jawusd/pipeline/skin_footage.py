"""The jaw of a shot by points on the skin in its own footage, learned where the teeth are visible."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import FittingError
from jawusd.capture.skin_points import SkinTracker
from jawusd.evaluator import JawRig
from jawusd.evaluator.skin import Skin, SkinJaw
from jawusd.fitting.face import in_head
from jawusd.fitting.skin import fit_skin
from jawusd.formats.capture import Capture
from jawusd.geometry import Camera, se3_inverse, transform_point
from jawusd.media.pixels import ColourPicture
from jawusd.pipeline.cameras import load_cameras, open_videos
from jawusd.pipeline.state import Progress
from jawusd.segmentation.picture import ColourFootage

_SIGMA_MM = 0.15  # standard deviation of d of the first pass


class SkinOfFootage:
    """The jaw of the frames of a shot by its footage; a function object for the solver.

    Attributes:
        skin: the map from the points to d; None until it is learned.
    """

    def __init__(
        self,
        rig: JawRig,
        cameras: Mapping[str, Camera],
        footage: ColourFootage,
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> None:
        """Prepare; `cameras` are those of the footage, by name, and `progress` gets the frames done and their number.

        Raises:
            FittingError: there is only one camera.
        """
        if len(cameras) < 2:
            raise FittingError(
                "skin in the footage needs two or more cameras that see it.",
                hint="Film with a second camera, or follow the face in another program (--face).",
            )
        self._rig, self._cameras, self._footage, self._progress = rig, dict(cameras), footage, progress
        self.skin: Skin | None = None

    def __call__(self, frames: Array, d: Array, seen: Mask, heads: Array) -> SkinJaw:
        """Return the jaw of the skin in some frames; see `tracking.performance.skin.SkinOf`.

        Raises:
            CaptureError: an image cannot be decoded.
            FittingError: too few points on the skin can be followed, or the jaw cannot be learned from them.
        """
        X = in_head(self.followed(frames.astype(int).tolist(), d, seen, heads), heads, seen)
        # Without skin, these frames are interpolated, so that a chin rigid with the bone is no alternative.
        self.skin = fit_skin(self._rig, X, d, seen, _SIGMA_MM, head_error=(0.0, 0.0), chin_as_good=True)
        found = self.skin(X)
        # Closed lips always differ from the parted ones of the training frames, but the covariance holds for them.
        return found._replace(familiar=np.asarray(np.isfinite(found.d).all(axis=1)))

    def summary(self) -> dict[str, object]:
        """Return the number of points, of frames with visible teeth, and the held-out errors; empty before learning."""
        skin = self.skin
        if skin is None:
            return {}
        return {"points": skin.columns // 3, "frames": skin.meta["frames"], "errors_mm": skin.errors_mm}

    def followed(self, frames: list[int], d: Array, seen: Mask, heads: Array) -> Array:
        """Return the points on the skin in the world [mm], shape (F, N, 3), NaN where they are not found.

        Args:
            frames: consecutive frame numbers of the shot.
            d, seen, heads: see `__call__`.
        """
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
            images = self._footage.at(frames[key])
            shown = {name: image for name, image in images.items() if image is not None}
            if set(shown) >= set(self._cameras):
                return key, shown
        raise FittingError("no frame that shows the teeth has an image of every camera.")


def skin_of_footage(
    capture: Capture, jaw: JawRig, offsets: Mapping[str, int], free_focal: bool, progress: Progress
) -> SkinOfFootage:
    """Return the jaw by skin in the videos of a shot; `offsets` are the frame offsets by camera.

    Raises:
        CaptureError: no camera has a video, or one cannot be decoded.
        CalibrationError: see `load_cameras`.
        FittingError: fewer than two cameras have videos, or focal lengths are unknown.
    """
    if free_focal:
        raise FittingError(
            "skin in the footage needs known focal lengths.", hint="Calibrate the cameras, or leave out --skin footage."
        )
    videos = open_videos(capture)
    cameras = {camera.name: camera for camera in load_cameras(capture) if camera.name in videos}
    return SkinOfFootage(jaw, cameras, ColourFootage(videos, offsets), partial(progress, "skin"))
