"""Align both rows of teeth with the lines of photographs: one bite, a pose and a lens for each photograph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.geometry import orthonormalise, so3_log, transform_point
from jawusd.photographs.contact import Contact
from jawusd.photographs.crowns import Crowns, Outlines, draw_teeth, outlines_of
from jawusd.photographs.drawing import Drawing, features, nearest
from jawusd.photographs.lens import UNKNOWNS, PhotoPose, to_camera
from jawusd.tracking.contour.equations import motion_about

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
