"""The camera of a photograph that nobody calibrated: one focal length, the middle of the picture, one distortion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array
from jawusd.geometry import orthonormalise, so3_log, transform_point, transform_points
from jawusd.photographs.crowns import Crowns, Outlines, draw_teeth, outlines_of
from jawusd.photographs.drawing import Drawing, features, nearest
from jawusd.tracking.contour.equations import motion_about
from jawusd.tracking.contour.scan import Scan
from jawusd.tracking.initialization.occlusion import crown_surface

#: Unknowns of a photograph: twist of the upper teeth about their centre [rad, mm], log focal length, distortion. With
#: the focal length the distance changes so that the teeth stay as large: large steps of it are then harmless.
UNKNOWNS = 8

# How far apart or into one another the nearest parts of two scanned rows are when the teeth are together [mm].
_SIGMA_MM = 0.15
_SHARE = 0.04  # of the lower crowns on a side: what touches there
_REACH_MM = 3.0  # farther inside, a point is past the base of a crown
# What is known beforehand, with standard deviations: telephones are held 80 to 200 mm from the teeth, macro lenses 200
# to 400 [log]; distortion [-].
_DISTANCE_MM, _LOG_DISTANCE, _DISTORTION = 180.0, 0.5, 0.02
# One camera takes all photographs; what focusing does to its focal length [log].
_LOG_FOCAL = 0.05
# How far a usual bite is off [rad, mm]; about the centre of the lower teeth.
_BITE_SIGMA = np.array([0.12] * 3 + [3.0] * 3)
# Standard deviation of a step [rad, mm, log, -]: damps directions that lines do not show.
_LARGEST_STEP = np.array([0.1] * 3 + [3.0, 3.0, 30.0] + [0.2, 0.02])
# By how much a drawn line is off, where teeth end and along the gum, and a stretch of it that is off alike.
_LINE_MM, _GUM_LINE_MM, _STRETCH_MM = 0.15, 0.3, 2.0
_GUM_MM = 0.5  # how far scans' crowns reach less far than crowns in pictures, or farther
_SHARED = 8  # unknowns of all photographs: twist of the bite about the centre of the lower teeth, gum lines


@dataclass(frozen=True, eq=False)
class PhotoPose:
    """Hold where a photograph was taken and with what lens."""

    T_cam_upper: Array  # shape (4, 4)
    focal_px: float  # at the size of the picture
    distortion: float  # k1 of x (1 + k1 r^2), r the distance from the middle over half the width of the picture

    def stepped(self, centre: Array, step: Array) -> PhotoPose:
        """Return the pose after a step (8,) of the unknowns; `centre` is that of the upper teeth, camera [mm]."""
        pose = orthonormalise(motion_about(centre, step[:6]) @ self.T_cam_upper)
        pose[2, 3] += centre[2] * np.expm1(step[6])
        return PhotoPose(pose, self.focal_px * float(np.exp(step[6])), self.distortion + float(step[7]))

    def scaled(self, factor: float) -> PhotoPose:
        """Return the pose for the picture shrunk by a factor."""
        return replace(self, focal_px=self.focal_px * factor)

    def opencv_k1(self, size_px: tuple[int, int]) -> float:
        """Return the distortion as OpenCV's k1, of directions instead of half widths."""
        return self.distortion * (2.0 * self.focal_px / size_px[0]) ** 2

    def camera_matrix(self, size_px: tuple[int, int]) -> Array:
        """Return the projection without distortion from camera [mm] to homogeneous px, shape (3, 3)."""
        u, v = middle_of(size_px)
        return np.array([[self.focal_px, 0.0, u], [0.0, self.focal_px, v], [0.0, 0.0, 1.0]])

    def pixels(self, points: Array, size_px: tuple[int, int]) -> Array:
        """Return where points in camera coordinates (N, 3) [mm] are seen [px], shape (N, 2)."""
        flat = self.focal_px * points[:, :2] / points[:, 2:]
        return flat * (1.0 + self.distortion * _radius2(flat, size_px))[:, None] + middle_of(size_px)

    def slopes(
        self, points: Array, directions: Array, size_px: tuple[int, int], distance_mm: float
    ) -> tuple[Array, Array]:
        """Return the derivative along image directions by the camera point (N, 3) [px/mm] and by the lens (N, 2).

        The lens columns are log focal length, with the distance of the teeth, and distortion. `directions` are unit
        vectors, shape (N, 2).
        """
        flat = self.focal_px * points[:, :2] / points[:, 2:]
        r2 = _radius2(flat, size_px)
        along = (directions * flat).sum(1)
        # d(distorted)/d(flat) is symmetric: (1 + k r2) I + 2 k flat flat^T / half^2
        bent = directions * (1.0 + self.distortion * r2)[:, None]
        bent += flat * (2.0 * self.distortion * along / (0.5 * size_px[0]) ** 2)[:, None]
        by_point = np.column_stack([bent * self.focal_px, -(bent * flat).sum(1)]) / points[:, 2:]
        by_focal = (bent * flat).sum(1) + by_point[:, 2] * distance_mm
        return by_point, np.column_stack([by_focal, along * r2])


def middle_of(size_px: tuple[int, int]) -> Array:
    """Return the middle of a picture [px], shape (2,)."""
    return 0.5 * (np.array(size_px, np.float64) - 1.0)


def to_camera(pose: PhotoPose, T_upper_lower: Array, points: Array, arch: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return scan points (N, 3) of both arches in upper scan and in camera coordinates [mm], shape (N, 3) each."""
    in_upper = np.where(arch[:, None] == 1, transform_points(T_upper_lower, points), points)
    return in_upper, transform_points(pose.T_cam_upper, in_upper)


def _radius2(flat: Array, size_px: tuple[int, int]) -> Array:
    return np.asarray((flat**2).sum(1) / (0.5 * size_px[0]) ** 2, np.float64)


class Contact:
    """Draw both rows together until they touch on the left and on the right."""

    def __init__(self, scans: Sequence[Scan]) -> None:
        """Prepare the surfaces of the upper and the lower crowns."""
        self._upper, self._lower = (crown_surface(scan) for scan in scans)
        self._tree = cKDTree(self._upper.points)
        centred = self._lower.points - scans[1].centre
        # The longest axis of a row runs from left to right, unless half of it is missing: then either half is a side.
        across = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
        self._sides = [across > np.percentile(across, 60), across < np.percentile(across, 40)]

    def equations(self, T_upper_lower: Array, centre: Array) -> tuple[Array, Array, Array]:
        """Return slopes (N, 6) by a twist of the bite about `centre`, distances [mm] and weights [1/mm^2]."""
        points = transform_points(T_upper_lower, self._lower.points)
        away, normals = self._signed(points)
        slopes, residuals, weights = [], [], []
        for side in self._sides:
            own = np.flatnonzero(side)
            touching = own[np.argsort(away[own])[: max(1, int(_SHARE * len(own)))]]
            slopes.append(np.hstack([np.cross(points[touching] - centre, normals[touching]), normals[touching]]))
            residuals.append(away[touching])
            weights.append(np.full(len(touching), _SIGMA_MM**-2 / len(touching)))
        return np.vstack(slopes), np.concatenate(residuals), np.concatenate(weights)

    def depth_mm(self, T_upper_lower: Array) -> float:
        """Return how deep crowns run into one another where they do so most, but for a speck [mm]."""
        away, _ = self._signed(transform_points(T_upper_lower, self._lower.points))
        return max(0.0, -float(np.percentile(away, 0.2)))

    def _signed(self, points: Array) -> tuple[Array, Array]:
        """Return distances from the upper crowns, negative inside [mm], shape (N,), and the normals there (N, 3)."""
        distance, index = self._tree.query(points)
        normals = self._upper.normals[index]
        off = points - self._upper.points[index]
        behind = np.einsum("ij,ij->i", off, normals)
        inside = (behind < -0.7 * distance) & (distance < _REACH_MM) & ~self._upper.border[index]
        # Close by, the plane is a better surface than its nearest piece.
        away = np.where(distance < 1.0, behind, np.where(inside, -distance, distance))
        return away, normals


@dataclass(frozen=True, eq=False)
class Photo:
    """Hold the lines of one photograph, as if it had not been taken over a mirror, and its pose."""

    drawing: Drawing
    pose: PhotoPose

    def shrunk(self, factor: float) -> Photo:
        """Return the photograph smaller by a factor."""
        return Photo(self.drawing.shrunk(factor), self.pose.scaled(factor))


@dataclass(frozen=True, eq=False)
class Bite:
    """Hold poses of photographs and the bite they share."""

    photos: tuple[Photo, ...]
    T_upper_lower: Array  # shape (4, 4)
    gum_mm: Array  # by how much gum lines are drawn nearer to the gum than crowns reach, upper and lower, shape (2,)


@dataclass(frozen=True, eq=False)
class Match:
    """Hold drawn points with the outline each one is nearest to.

    Attributes:
        outlines: of the teeth, a row per drawn point.
        off_px: signed distance of the outline from the drawn point along its normal, shape (N,).
        apart: distance in place and direction, see `features` [px], shape (N,).
    """

    outlines: Outlines
    off_px: Array
    apart: Array


def match(seen: Outlines, drawing: Drawing, turn_px: float) -> Match:
    """Return for each drawn point the nearest outline of like direction."""
    drawn, there = (features(one.pixels, one.normals, turn_px) for one in (drawing, seen))
    apart, index = nearest(drawn, there)
    own = seen.take(index)
    return Match(own, ((own.pixels - drawing.pixels) * own.normals).sum(1), apart)


def seen_outlines(crowns: Sequence[Crowns], photo: Photo, bite: Bite) -> Outlines:
    """Return the outlines of all teeth as somebody would draw them in a photograph."""
    width, height = photo.drawing.size_px
    K = photo.pose.camera_matrix(photo.drawing.size_px)
    T = photo.pose.T_cam_upper
    matrices = [K @ T[:3], K @ (T @ bite.T_upper_lower)[:3]]
    seen = outlines_of(crowns, matrices, *draw_teeth(crowns, matrices, (height, width)))
    _, points = to_camera(photo.pose, bite.T_upper_lower, seen.points, seen.arch)
    towards_gum = seen.gum * bite.gum_mm[seen.arch] * photo.pose.focal_px / points[:, 2]
    return replace(seen, pixels=photo.pose.pixels(points, photo.drawing.size_px) + towards_gum[:, None] * seen.normals)


class Aligner:
    """Align rows of teeth with photographs by Gauss-Newton on the distances of outlines."""

    def __init__(self, crowns: Sequence[Crowns], usual_bite: Array, contact: Contact | None) -> None:
        """Take both rows, the bite that rows usually have, and their contact if they are to touch."""
        self._crowns, self._usual, self._contact = crowns, usual_bite, contact

    def aligned(self, bite: Bite, gates_mm: Sequence[float]) -> Bite:
        """Return photographs and bite after a step for every gate [mm] beyond which lines do not count."""
        for gate_mm in gates_mm:
            bite = self._step(bite, gate_mm)
        return bite

    def misfit(self, bite: Bite, gate_mm: float) -> Array:
        """Return the mean squared distance of lines over that of the gate, at most 1, by photograph and row, (P, 2).

        Lines count for the row whose outline is nearest; 1 where a row has none.
        """
        out = np.ones((len(bite.photos), 2))
        for k, photo in enumerate(bite.photos):
            gate_px = gate_mm * _px_per_mm(photo, self._crowns)
            found = match(seen_outlines(self._crowns, photo, bite), photo.drawing, 0.5 * gate_px)
            off = np.minimum((found.apart / gate_px) ** 2, 1.0)
            for r in np.unique(found.outlines.arch):
                out[k, r] = off[found.outlines.arch == r].mean()
        return out

    def _step(self, bite: Bite, gate_mm: float) -> Bite:
        count = len(bite.photos)
        size = UNKNOWNS * count + _SHARED
        H, g = np.zeros((size, size)), np.zeros(size)
        shared = np.arange(UNKNOWNS * count, size)
        centre_lower = transform_point(bite.T_upper_lower, self._crowns[1].scan.centre)
        centres = [transform_point(photo.pose.T_cam_upper, self._crowns[0].scan.centre) for photo in bite.photos]
        for k, photo in enumerate(bite.photos):
            own = np.arange(UNKNOWNS * k, UNKNOWNS * (k + 1))
            part = np.r_[own, shared]
            J, residual, weight = self._equations(photo, bite, centres[k], centre_lower, gate_mm)
            _add(H, g, part, J, residual, weight)
            _add(H, g, own, *_lens_prior(photo.pose, centres[k]))
        _add(H, g, UNKNOWNS * np.arange(count) + 6, *_one_lens(bite.photos))
        _add(H, g, shared[:6], *self._bite_prior(bite.T_upper_lower))
        _add(H, g, shared[6:], np.eye(2), bite.gum_mm, np.full(2, _GUM_MM**-2))
        if self._contact is not None:
            _add(H, g, shared[:6], *self._contact.equations(bite.T_upper_lower, centre_lower))
        H[np.diag_indices(size)] += np.r_[np.tile(_LARGEST_STEP, count), _LARGEST_STEP[:6], 1.0, 1.0] ** -2.0
        step = np.asarray(np.linalg.solve(H, g), np.float64)
        photos = tuple(
            replace(photo, pose=photo.pose.stepped(centres[k], step[UNKNOWNS * k : UNKNOWNS * (k + 1)]))
            for k, photo in enumerate(bite.photos)
        )
        T_upper_lower = orthonormalise(motion_about(centre_lower, step[shared[:6]]) @ bite.T_upper_lower)
        return Bite(photos, T_upper_lower, bite.gum_mm + step[shared[6:]])

    def _equations(
        self, photo: Photo, bite: Bite, centre: Array, centre_lower: Array, gate_mm: float
    ) -> tuple[Array, Array, Array]:
        """Return slopes (N, 16) by the photograph's and the shared unknowns, residuals [px] and weights [1/px^2]."""
        px_per_mm = _px_per_mm(photo, self._crowns)
        seen = seen_outlines(self._crowns, photo, bite)
        found = match(seen, photo.drawing, 0.5 * gate_mm * px_per_mm)
        own = found.outlines
        in_upper, points = to_camera(photo.pose, bite.T_upper_lower, own.points, own.arch)
        by_point, by_lens = photo.pose.slopes(points, own.normals, photo.drawing.size_px, centre[2])
        in_bite = by_point @ photo.pose.T_cam_upper[:3, :3] * (own.arch == 1)[:, None]
        by_gum = (own.gum * photo.pose.focal_px / points[:, 2])[:, None] * np.eye(2)[own.arch]
        turns = np.cross(points - centre, by_point), np.cross(in_upper - centre_lower, in_bite)
        J = np.hstack([turns[0], by_point, by_lens, turns[1], in_bite, by_gum])
        share = np.clip(1.0 - (found.apart / (gate_mm * px_per_mm)) ** 2, 0.0, None) ** 2
        sigma_px = px_per_mm * (_LINE_MM + (_GUM_LINE_MM - _LINE_MM) * own.gum)
        # Neighbouring points of a line are off alike, so a stretch of it counts once.
        return J, found.off_px, share / sigma_px**2 / max(1.0, _STRETCH_MM * px_per_mm)

    def _bite_prior(self, T_upper_lower: Array) -> tuple[Array, Array, Array]:
        """Return slopes, differences and weights of what is known of bites."""
        turn = so3_log(T_upper_lower[:3, :3] @ self._usual[:3, :3].T)
        here, usual = (transform_point(T, self._crowns[1].scan.centre) for T in (T_upper_lower, self._usual))
        return np.eye(6), np.r_[turn, here - usual], _BITE_SIGMA**-2


def _add(H: Array, g: Array, part: NDArray[np.int64], J: Array, residual: Array, weight: Array) -> None:
    """Add residuals with slopes by some of the unknowns to the normal equations."""
    H[np.ix_(part, part)] += J.T @ (weight[:, None] * J)
    g[part] -= J.T @ (weight * residual)


def _lens_prior(pose: PhotoPose, centre: Array) -> tuple[Array, Array, Array]:
    """Return slopes, differences and weights of what is known of distance and distortion."""
    J = np.zeros((2, UNKNOWNS))
    J[0, 5], J[0, 6], J[1, 7] = 1.0 / centre[2], 1.0, 1.0
    return (
        J,
        np.array([np.log(centre[2] / _DISTANCE_MM), pose.distortion]),
        np.array([_LOG_DISTANCE, _DISTORTION]) ** -2,
    )


def _one_lens(photos: Sequence[Photo]) -> tuple[Array, Array, Array]:
    """Return slopes, differences and weights by the log focal lengths: all are about their mean."""
    logs = np.log([photo.pose.focal_px / photo.drawing.size_px[0] for photo in photos])
    return np.eye(len(logs)) - 1.0 / len(logs), logs - logs.mean(), np.full(len(logs), _LOG_FOCAL**-2)


def _px_per_mm(photo: Photo, crowns: Sequence[Crowns]) -> float:
    return photo.pose.focal_px / float(transform_point(photo.pose.T_cam_upper, crowns[0].scan.centre)[2])
