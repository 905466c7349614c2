"""Joint alignment of both arches with photographs: a common bite, and a pose and a lens for each photograph.

The camera model has one focal length, the principal point at the image centre, and one distortion coefficient.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array
from jawusd.geometry import orthonormalise, so3_log, transform_point, transform_points
from jawusd.geometry.camera import intrinsics
from jawusd.photographs.drawing import Crowns, Drawing, Outlines, draw_teeth, features, outlines_of
from jawusd.tracking.contour.equations import motion_about
from jawusd.tracking.contour.scan import Scan
from jawusd.tracking.initialization.occlusion import crown_surface, signed_distances

#: Number of unknowns of a photograph: twist of the upper teeth about their centre [rad, mm], log focal length,
#: distortion. A step in focal length also changes the distance so that the teeth keep their size in the image, which
#: permits large steps.
UNKNOWNS = 8

_SIGMA_MM = 0.15  # standard deviation of the gap or penetration between scanned teeth that are in contact
_SHARE = 0.04  # fraction of the lower crown points on each side that are assumed to be in contact
_REACH_MM = 3.0  # maximum penetration; points that seem deeper lie beyond the base of a crown
# Priors: camera distance, standard deviation of its logarithm, and standard deviation of the distortion [-]. Phones are
# held 80 to 200 mm from the teeth, macro lenses 200 to 400 mm.
_DISTANCE_MM, _LOG_DISTANCE, _DISTORTION = 180.0, 0.5, 0.02
_LOG_FOCAL = 0.05  # standard deviation of the log focal length between photographs from one camera (due to focusing)
_BITE_SIGMA = np.array([0.12] * 3 + [3.0] * 3)  # standard deviations of the bite prior [rad, mm]
# Prior standard deviations of a step [rad, mm, log, -], which damp unknowns that the lines do not determine.
_LARGEST_STEP = np.array([0.1] * 3 + [3.0, 3.0, 30.0] + [0.2, 0.02])
# Standard deviations of drawn lines from tooth edges and from gum lines, and correlation length of these errors.
_LINE_MM, _GUM_LINE_MM, _STRETCH_MM = 0.15, 0.3, 2.0
_GUM_MM = 0.5  # standard deviation of the difference between the gum lines of scan and photograph
_SHARED = 8  # number of shared unknowns: twist of the bite about the lower teeth's centre, gum-line offset per arch


@dataclass(frozen=True, eq=False)
class PhotoPose:
    """Pose and lens of a photograph."""

    T_cam_upper: Array  # upper scan to camera [mm], shape (4, 4)
    focal_px: float  # focal length for the image at its current size
    distortion: float  # k1 in x (1 + k1 r^2), where r is the distance from the image centre over half the image width

    def stepped(self, centre: Array, step: Array) -> PhotoPose:
        """Return the pose after a step (8,) of the unknowns; `centre` is that of the upper teeth, camera frame [mm]."""
        pose = orthonormalise(motion_about(centre, step[:6]) @ self.T_cam_upper)
        pose[2, 3] += centre[2] * np.expm1(step[6])
        return PhotoPose(pose, self.focal_px * float(np.exp(step[6])), self.distortion + float(step[7]))

    def scaled(self, factor: float) -> PhotoPose:
        """Return the pose that applies if the image is scaled by a factor."""
        return replace(self, focal_px=self.focal_px * factor)

    def opencv_k1(self, size_px: tuple[int, int]) -> float:
        """Return the distortion as OpenCV's k1, which applies to normalised image coordinates."""
        return self.distortion * (2.0 * self.focal_px / size_px[0]) ** 2

    def camera_matrix(self, size_px: tuple[int, int]) -> Array:
        """Return the undistorted projection from camera [mm] to homogeneous px, shape (3, 3)."""
        return intrinsics(self.focal_px, self.focal_px, *middle_of(size_px))

    def pixels(self, points: Array, size_px: tuple[int, int]) -> Array:
        """Project points in camera coordinates (N, 3) [mm] to the image [px], shape (N, 2)."""
        flat = self.focal_px * points[:, :2] / points[:, 2:]
        return flat * (1.0 + self.distortion * _radius2(flat, size_px))[:, None] + middle_of(size_px)

    def slopes(
        self, points: Array, directions: Array, size_px: tuple[int, int], distance_mm: float
    ) -> tuple[Array, Array]:
        """Return derivatives of pixels along directions with respect to camera point (N, 3) [px/mm] and lens (N, 2).

        The lens columns are log focal length (with its coupled change of distance) and distortion. `directions` are
        unit vectors, shape (N, 2).
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
    """Return the centre of an image with a given size [px], shape (2,)."""
    return 0.5 * (np.array(size_px, np.float64) - 1.0)


def to_camera(pose: PhotoPose, T_upper_lower: Array, points: Array, arch: NDArray[np.int64]) -> tuple[Array, Array]:
    """Transform scan points (N, 3) of both arches to upper-scan and to camera coordinates [mm], shape (N, 3) each."""
    in_upper = np.where(arch[:, None] == 1, transform_points(T_upper_lower, points), points)
    return in_upper, transform_points(pose.T_cam_upper, in_upper)


def _radius2(flat: Array, size_px: tuple[int, int]) -> Array:
    return np.asarray((flat**2).sum(1) / (0.5 * size_px[0]) ** 2, np.float64)


class Contact:
    """Contact prior: closed teeth touch on the left and on the right."""

    def __init__(self, scans: Sequence[Scan]) -> None:
        self._upper, self._lower = (crown_surface(scan) for scan in scans)
        self._tree = cKDTree(self._upper.points)
        centred = self._lower.points - scans[1].centre
        # The longest axis of an arch runs from left to right unless half of the arch is missing.
        across = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
        self._sides = [across > np.percentile(across, 60), across < np.percentile(across, 40)]

    def equations(self, T_upper_lower: Array, centre: Array) -> tuple[Array, Array, Array]:
        """Return derivatives (N, 6) with respect to a bite twist about `centre`, distances [mm], weights [1/mm^2]."""
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
        """Return the greatest penetration of the crowns, excluding outliers [mm]."""
        away, _ = self._signed(transform_points(T_upper_lower, self._lower.points))
        return max(0.0, -float(np.percentile(away, 0.2)))

    def _signed(self, points: Array) -> tuple[Array, Array]:
        """Return signed distances of points from the upper crowns [mm], negative inside, (N,), and normals (N, 3)."""
        signed, behind, index = signed_distances(points, self._upper, self._tree, _REACH_MM)
        # Near the surface, the distance from the tangent plane is more accurate than the distance from the nearest
        # point.
        return np.where(np.abs(signed) < 1.0, behind, signed), self._upper.normals[index]


@dataclass(frozen=True, eq=False)
class Photo:
    """The lines of one photograph, with any mirroring undone, and the photograph's pose."""

    drawing: Drawing
    pose: PhotoPose

    def drawn(self, drawing: Drawing) -> Photo:
        """Return the photograph with its lines in a drawing of another size."""
        return Photo(drawing, self.pose.scaled(drawing.size_px[0] / self.drawing.size_px[0]))

    def shrunk(self, factor: float) -> Photo:
        """Return the photograph downscaled by a factor."""
        return Photo(self.drawing.shrunk(factor), self.pose.scaled(factor))


@dataclass(frozen=True, eq=False)
class Bite:
    """Poses of photographs, and their common bite."""

    photos: tuple[Photo, ...]
    T_upper_lower: Array  # lower to upper scan [mm], shape (4, 4)
    gum_mm: Array  # offset of drawn gum lines from the edges of the crowns towards the gum, upper and lower, shape (2,)


@dataclass(frozen=True, eq=False)
class Match:
    """Drawn points with their matched outline points."""

    outlines: Outlines  # the matched outline point of each drawn point
    off_px: Array  # signed distance of the outline from the drawn point along the outline's normal, shape (N,)
    apart: Array  # distance in position and direction (see `features`) [px], shape (N,)


def match(seen: Outlines, drawing: Drawing, turn_px: float) -> Match:
    """Match each drawn point to the nearest outline point, in position and direction."""
    drawn, there = (features(one.pixels, one.normals, turn_px) for one in (drawing, seen))
    apart, index = cKDTree(there).query(drawn)
    own = seen.take(index)
    return Match(own, ((own.pixels - drawing.pixels) * own.normals).sum(1), apart)


def seen_outlines(crowns: Sequence[Crowns], photo: Photo, bite: Bite) -> Outlines:
    """Return the expected outlines of all teeth in a photograph."""
    width, height = photo.drawing.size_px
    K = photo.pose.camera_matrix(photo.drawing.size_px)
    T = photo.pose.T_cam_upper
    matrices = [K @ T[:3], K @ (T @ bite.T_upper_lower)[:3]]
    seen = outlines_of(crowns, matrices, *draw_teeth(crowns, matrices, (height, width)))
    _, points = to_camera(photo.pose, bite.T_upper_lower, seen.points, seen.arch)
    towards_gum = seen.gum * bite.gum_mm[seen.arch] * photo.pose.focal_px / points[:, 2]
    return replace(seen, pixels=photo.pose.pixels(points, photo.drawing.size_px) + towards_gum[:, None] * seen.normals)


class Aligner:
    """Gauss-Newton alignment of both arches with photographs, which minimises distances of lines from outlines."""

    def __init__(self, crowns: Sequence[Crowns], usual_bite: Array, contact: Contact | None) -> None:
        """Store both arches, a typical bite as prior, and the contact prior (None omits it)."""
        self._crowns, self._usual, self._contact = crowns, usual_bite, contact

    def aligned(self, bite: Bite, gates_mm: Sequence[float]) -> Bite:
        """Return photographs and bite after one step per gate; a step uses lines with residuals up to its gate [mm]."""
        for gate_mm in gates_mm:
            bite = self._step(bite, gate_mm)
        return bite

    def misfit(self, bite: Bite, gate_mm: float) -> Array:
        """Return the mean squared line distance relative to the gate, capped at 1, per photograph and arch, (P, 2).

        A line counts for the arch of its nearest outline; an arch without lines has misfit 1.
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
        """Return derivatives (N, 16) with respect to own and shared unknowns, residuals [px], weights [1/px^2]."""
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
        # Errors of neighbouring points are correlated, so each correlation length counts as one measurement.
        return J, found.off_px, share / sigma_px**2 / max(1.0, _STRETCH_MM * px_per_mm)

    def _bite_prior(self, T_upper_lower: Array) -> tuple[Array, Array, Array]:
        """Return derivatives, residuals and weights of the bite prior."""
        turn = so3_log(T_upper_lower[:3, :3] @ self._usual[:3, :3].T)
        here, usual = (transform_point(T, self._crowns[1].scan.centre) for T in (T_upper_lower, self._usual))
        return np.eye(6), np.r_[turn, here - usual], _BITE_SIGMA**-2


def _add(H: Array, g: Array, part: NDArray[np.int64], J: Array, residual: Array, weight: Array) -> None:
    """Add residuals to the normal equations; J: derivatives with respect to the unknowns at indices `part`."""
    H[np.ix_(part, part)] += J.T @ (weight[:, None] * J)
    g[part] -= J.T @ (weight * residual)


def _lens_prior(pose: PhotoPose, centre: Array) -> tuple[Array, Array, Array]:
    """Return derivatives, residuals and weights of the priors on camera distance and lens distortion."""
    J = np.zeros((2, UNKNOWNS))
    J[0, 5], J[0, 6], J[1, 7] = 1.0 / centre[2], 1.0, 1.0
    return (
        J,
        np.array([np.log(centre[2] / _DISTANCE_MM), pose.distortion]),
        np.array([_LOG_DISTANCE, _DISTORTION]) ** -2,
    )


def _one_lens(photos: Sequence[Photo]) -> tuple[Array, Array, Array]:
    """Return derivatives, residuals and weights of the prior that keeps all log focal lengths near their mean."""
    logs = np.log([photo.pose.focal_px / photo.drawing.size_px[0] for photo in photos])
    return np.eye(len(logs)) - 1.0 / len(logs), logs - logs.mean(), np.full(len(logs), _LOG_FOCAL**-2)


def _px_per_mm(photo: Photo, crowns: Sequence[Crowns]) -> float:
    return photo.pose.focal_px / float(transform_point(photo.pose.T_cam_upper, crowns[0].scan.centre)[2])
