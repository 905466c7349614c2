"""Points on the skin, found by their texture in one frame and followed through the images of all cameras.

Points are found and matched between cameras in a key frame, in which the pose of the head is known. From frame to frame
they are followed by pyramidal Lucas-Kanade (Bouguet 2001), and every frame is aligned with the key frame again, so that
errors do not accumulate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from jawusd.base.arrays import Array, Indices, Mask
from jawusd.base.errors import CaptureError
from jawusd.capture.skin_patches import Gray, Patches, SkinView, alike, followed, homography, warped
from jawusd.geometry import Camera, se3_inverse, so3_exp, transform_points
from jawusd.media.pixels import ColourPicture

# Maximum number of points per camera, their minimum distance, and minimum number of all points.
_MOST_POINTS, _APART_MM, _LEAST_POINTS = 250, 2.5, 20
_QUALITY = 0.01  # smallest eigenvalue of the gradients around a point, relative to the best point of the image
_REACH_MM = 75.0  # distance from the mouth within which points are searched for
# Half the width of the lips, and their height above the upper and below the lower incisal edge [mm]; the texture of
# lips is not stable.
_LIPS_MM, _LIPS_FRONT_MM = (36.0, 15.0), 6.0
# Minimum correlation of a patch with the key frame for aligning it, and for following it from frame to frame; and
# minimum correlation between two cameras.
_ALIKE, _STILL_ALIKE, _ALIKE_ACROSS = 0.8, 0.5, 0.75
_OFF_PX = 1.5  # maximum distance between a point and the projection of its triangulated position
_MOST_ANGLE = np.deg2rad(60.0)  # maximum angle between the optical axes of two cameras whose points are matched
# Planes by which the skin is approximated where points are matched between cameras: distances in front of the incisal
# point [mm], and turns to the left and upwards.
_DEPTHS_MM, _TURNS = np.arange(16.0, -48.0, -1.0), np.deg2rad([[0, 0], [35, 0], [-35, 0], [0, -35]])
_SHIFT_PX = 4.0  # maximum distance of a point from its position predicted by the best plane
_STEP_PX = 6.0  # maximum distance of a point from its position predicted by its neighbours or the previous frame
_RIDGE_PX2 = 50.0
_AROUND, _OFF_MM = 8, 5.0  # number of neighbours of a point, and maximum difference of its depth from their median


class SkinTracker:
    """Points on the skin, matched between cameras in a key frame.

    Attributes:
        pixels: working pixels of the points in the key frame, NaN where a camera does not see one, shape (C, N, 2).
        points_world: positions in the key frame [mm], shape (N, 3).
    """

    def __init__(
        self, cameras: Sequence[Camera], images: Mapping[str, ColourPicture], T_world_mouth: Array, opening_mm: float
    ) -> None:
        """Find points in the key frame.

        Args:
            images: recorded images of the key frame by camera name.
            T_world_mouth: pose of the anatomical axes (left, up, front) at the incisal point, shape (4, 4).
            opening_mm: height of the upper above the lower incisal point.

        Raises:
            CaptureError: too few points are recognised in two cameras.
        """
        mouth = T_world_mouth[:3, 3]
        angle = np.linspace(0, 2 * np.pi, 33)[:-1]
        height = _LIPS_MM[1] + opening_mm / 2
        lips = np.stack([_LIPS_MM[0] * np.cos(angle), height * np.sin(angle) - opening_mm / 2, 0 * angle], axis=1)
        self._lips = transform_points(T_world_mouth, lips + [0, 0, _LIPS_FRONT_MM])
        self._views = [SkinView.of(camera, mouth) for camera in cameras]
        self._key = [view.picture(images[camera.name]) for view, camera in zip(self._views, cameras)]
        self._names = [camera.name for camera in cameras]
        self._matrices = np.stack([view.camera.projection_matrix() for view in self._views])
        pixels = np.concatenate([self._matched(a, T_world_mouth) for a in range(len(cameras) - 1)], axis=1)
        points, pixels = self.placed(pixels)
        kept = _without_outliers(points, T_world_mouth)
        kept &= _distinct(points, kept)
        self.pixels, self.points_world = pixels[:, kept], points[kept]
        if len(self.points_world) < _LEAST_POINTS:
            raise CaptureError(
                f"{len(self.points_world)} points on the skin around the mouth are recognised in two cameras; at least "
                f"{_LEAST_POINTS} are needed.",
                hint="The skin needs texture that the cameras resolve: freckles, stubble, or painted dots of 1 to 2 "
                "mm. Film from close up, in focus and without glare, with cameras at most 60 degrees apart.",
            )

    def _matched(self, a: int, T_world_mouth: Array) -> Array:
        """Return working pixels (C, n, 2) of points found in camera `a`; NaN in cameras before it, or if not found."""
        view, key = self._views[a], self._key[a]
        height, width = key.shape
        centre = view.camera.project_pinhole(T_world_mouth[:3, 3])
        disc = np.zeros((height, width), np.uint8)
        cv2.circle(disc, np.rint(centre).astype(int).tolist(), round(_REACH_MM * view.px_per_mm), 255, -1)
        lips = np.rint(view.camera.project_pinhole(self._lips)).astype(np.int32)
        cv2.fillConvexPoly(disc, cv2.convexHull(lips), 0)
        apart = _APART_MM * view.px_per_mm
        corners = cv2.goodFeaturesToTrack(key, _MOST_POINTS, _QUALITY, apart, mask=disc, blockSize=view.side_px // 2)
        points = np.zeros((0, 2)) if corners is None else np.asarray(corners[:, 0], np.float64)
        found = np.full((len(self._views), len(points), 2), np.nan)
        found[a] = points
        for b in range(a + 1, len(self._views)):
            axes = [self._views[c].camera.T_cam_world[2, :3] for c in (a, b)]
            if np.arccos(np.clip(axes[0] @ axes[1], -1, 1)) <= _MOST_ANGLE:
                found[b] = self._across(a, b, points, T_world_mouth)
        return found

    def _across(self, a: int, b: int, points: Array, T_world_mouth: Array) -> Array:
        """Return where points (n, 2) of camera `a` are in camera `b` [px], by planes near the skin; NaN if nowhere."""
        view, other = self._views[a], self._views[b]
        whole = np.rint(points).astype(int)
        key, best = Patches(self._key[a], view.side_px), np.full(len(points), _ALIKE_ACROSS)
        planes = [
            homography(view.camera, other.camera, T_world_mouth, so3_exp([0, left, 0]) @ so3_exp([-up, 0, 0])[:, 2], z)
            for left, up in _TURNS
            for z in _DEPTHS_MM
        ]
        plane = np.full(len(points), -1)
        for k, H in enumerate(planes):
            score = key.correlation(warped(self._key[b], H, self._key[a].shape))[whole[:, 1], whole[:, 0]]
            better = score > best
            best[better], plane[better] = score[better], k
        found = np.full(points.shape, np.nan)
        for k in np.unique(plane[plane >= 0]).tolist():
            rows = np.flatnonzero(plane == k)
            second = warped(self._key[b], planes[k], self._key[a].shape)
            moved, ok = followed(self._key[a], second, points[rows], view.side_px, levels=0)
            ok &= np.linalg.norm(moved - points[rows], axis=1) <= _SHIFT_PX
            if ok.any():
                found[rows[ok]] = cv2.perspectiveTransform(moved[ok][:, None], planes[k])[:, 0]
        return found

    def placed(self, pixels: Array) -> tuple[Array, Array]:
        """Triangulate points with working pixels (C, N, 2); return positions (N, 3) [mm], and the consistent pixels.

        Points that fewer than two cameras see consistently are NaN.
        """
        kept = pixels.copy()
        for _ in range(max(len(pixels) - 1, 1)):
            seen = np.isfinite(kept[..., 0])
            points = _triangulated(self._matrices, kept)
            off = np.linalg.norm(_projected(self._matrices, points) - kept, axis=2)
            off = np.where(seen & np.isfinite(points[:, 0]), off, 0.0)
            worst, bad = off.argmax(axis=0), off.max(axis=0) > _OFF_PX
            kept[worst[bad], np.flatnonzero(bad)] = np.nan
        points[bad | (np.isfinite(kept[..., 0]).sum(axis=0) < 2)] = np.nan
        return points, kept

    def follower(self) -> SkinFollower:
        """Return a follower that starts at the key frame."""
        return SkinFollower(self, self._views, self._key, self._names)


class SkinFollower:
    """Follows points from image to image, away from the key frame."""

    def __init__(self, tracker: SkinTracker, views: Sequence[SkinView], key: Sequence[Gray], names: list[str]) -> None:
        self._tracker, self._views, self._key, self._names = tracker, views, key, names
        self._last = list(key)
        self._at = [pixels.copy() for pixels in tracker.pixels]

    def step(self, images: Mapping[str, ColourPicture | None]) -> Array:
        """Return the positions of the points (N, 3) [mm] in the next frame, NaN where they are not found."""
        found = np.full(self._tracker.pixels.shape, np.nan)
        for c, (view, name) in enumerate(zip(self._views, self._names)):
            image = images.get(name)
            if image is not None:
                found[c] = self._one(c, view.picture(image), view.side_px)
        return self._tracker.placed(found)[0]

    def _one(self, c: int, image: Gray, side: int) -> Array:
        """Return the working pixels of the points (N, 2) in a camera's next image, NaN where they are not found."""
        own = np.flatnonzero(np.isfinite(self._tracker.pixels[c, :, 0]))
        start, last = self._tracker.pixels[c][own], self._at[c][own]
        moved, ok = followed(self._last[c], image, last, side)
        again, near = self._anchored(c, image, start, moved, side)
        moved[near] = again[near]
        good = near | (ok & (alike(self._key[c], image, start, moved, side) >= _STILL_ALIKE))
        lost = np.flatnonzero(~good)
        moved[lost] = _from_neighbours(start, moved, good, lost)
        again, found = self._anchored(c, image, start[lost], moved[lost], side)
        moved[lost[found]], good[lost[found]] = again[found], True
        out = np.full(self._tracker.pixels[c].shape, np.nan)
        out[own[good]] = moved[good]
        self._at[c][own], self._last[c] = moved, image
        return out

    def _anchored(self, c: int, image: Gray, start: Array, guess: Array, side: int) -> tuple[Array, Mask]:
        """Align points (N, 2) of the key frame with an image, from a guess (N, 2); return which look alike in both."""
        found, ok = followed(self._key[c], image, start, side, guess, levels=1)
        ok &= np.linalg.norm(found - guess, axis=1) <= _STEP_PX
        return found, ok & (alike(self._key[c], image, start, found, side) >= _ALIKE)


def _projected(matrices: Array, points: Array) -> Array:
    """Return the pixels (C, N, 2) of world points (N, 3) by projection matrices (C, 3, 4)."""
    h = np.einsum("cij,nj->cni", matrices, np.column_stack([points, np.ones(len(points))]))
    return np.asarray(h[..., :2] / h[..., 2:], np.float64)


def _triangulated(matrices: Array, pixels: Array) -> Array:
    """Return points (N, 3) [mm] from pixels (C, N, 2), NaN where fewer than two cameras see one.

    The linear estimate with rows reweighted by depth (Hartley and Sturm 1997, section 4).
    """
    out = np.full((pixels.shape[1], 3), np.nan)
    known = np.isfinite(pixels[..., 0]).sum(axis=0) >= 2
    if not known.any():
        return out
    pixels = pixels[:, known]
    seen = np.isfinite(pixels[..., 0]).T
    rows = np.nan_to_num(np.swapaxes(pixels, 0, 1))[..., None] * matrices[None, :, None, 2] - matrices[None, :, :2]
    weight = np.where(seen, 1.0, 0.0)
    for _ in range(3):
        stacked = (rows * weight[..., None, None]).reshape(len(seen), -1, 4)
        X = np.linalg.svd(stacked, full_matrices=False)[2][:, -1]
        points = X[:, :3] / X[:, 3:]
        depth = np.einsum("cj,nj->nc", matrices[:, 2], np.column_stack([points, np.ones(len(points))]))
        weight = np.where(seen, 1.0 / np.maximum(np.abs(depth), 1e-9), 0.0)
    out[known] = points
    return out


def _from_neighbours(start: Array, moved: Array, good: Mask, lost: Indices) -> Array:
    """Return where `lost` points (L,) are expected if they move like their `good` neighbours (N,), shape (L, 2).

    `start` and `moved` (N, 2) are positions in the key frame and in the image.
    """
    known = np.flatnonzero(good)
    if len(known) < _AROUND:
        return moved[lost]
    out = np.empty((len(lost), 2))
    for k, index in enumerate(lost):
        arms = start[known] - start[index]
        near = np.argsort((arms**2).sum(axis=1))[:_AROUND]
        design = np.column_stack([np.ones(_AROUND), arms[near]])
        # a small penalty on the gradient, which collinear points do not determine
        normal = design.T @ design + np.diag([0.0, _RIDGE_PX2, _RIDGE_PX2])
        steps = (moved - start)[known[near]]
        out[k] = start[index] + np.linalg.solve(normal, design.T @ steps)[0]
    return out


def _without_outliers(points: Array, T_world_mouth: Array) -> Mask:
    """Return which points (N, 3) are within reach of the mouth and not far in front of or behind their neighbours."""
    local = transform_points(se3_inverse(T_world_mouth), points)
    kept = np.isfinite(points).all(axis=1)
    kept &= np.linalg.norm(np.nan_to_num(local), axis=1) <= _REACH_MM
    index = np.flatnonzero(kept)
    for k in index:
        apart = np.linalg.norm(local[index, :2] - local[k, :2], axis=1)
        near = index[np.argsort(apart)[1 : _AROUND + 1]]
        kept[k] = len(near) > 2 and abs(local[k, 2] - np.median(local[near, 2])) <= _OFF_MM
    return kept


def _distinct(points: Array, kept: Mask) -> Mask:
    """Return which points (N, 3) are at least half the minimum distance away from all earlier points that are kept."""
    out = np.zeros(len(points), bool)
    for k in np.flatnonzero(kept):
        out[k] = not (np.linalg.norm(points[out] - points[k], axis=1) < _APART_MM / 2).any()
    return out
