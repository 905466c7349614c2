"""Find initial poses of photographs: search views exhaustively, correlating outlines with the drawn lines."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import distance_transform_edt

from jawusd.base.arrays import Array
from jawusd.geometry import anatomical_frame, make_transform, se3_inverse, so3_exp
from jawusd.geometry.camera import intrinsics
from jawusd.photographs.drawing import Crowns, Drawing, draw_teeth, outlines_of, split_teeth
from jawusd.photographs.solve import Aligner, Bite, Contact, Photo, PhotoPose, middle_of
from jawusd.tracking.contour.scan import Scan, thinned

_PX_PER_MM = 2.5
_DISTANCE_MM = 200.0  # typical distance from camera to teeth in dental photographs
# Position of the front teeth's edges relative to the centre of rotation of the views.
_FRONT_MM = np.array([0.0, 0.0, 15.0])
_YAW = np.radians(np.arange(-75, 76, 15.0))
_PITCH = np.radians(np.arange(-20, 21, 10.0))
_ROLL = np.radians([-10.0, 0.0, 10.0])
# Candidate widths of the field of view at the teeth [mm].
_WIDTHS_MM = 38.0 * 1.1 ** np.arange(9)
_ROWS_APART_MM = 10.0
_SECTORS = 4  # number of direction bins; a line matches only outlines in the same bin
_NEAR_PX = 2.0  # distance from an outline at which a drawn line has half weight
# Typical bite: overjet and overbite of the front teeth [mm].
_OVERJET_MM, _OVERBITE_MM = 2.5, 2.0

_WIDTH_PX = 360  # image width at which candidates are aligned
_FACES = 6000  # number of crown faces per arch, sufficient at this image width
# Number of candidates and of finalists, separately for mirrored and for unmirrored views.
_CANDIDATES, _FINALISTS = 20, 4
# Gates of the alignment steps [mm], with the given bite and with shifted bites; they decrease from step to step.
_WIDE_GATES, _SLID_GATES = (4.0, 4.0, 3.5, 3.5, 3.0, 3.0, 2.5, 2.5), (3.0, 3.0, 2.5, 2.0, 2.0, 2.0)
# Shifts of the lower arch from a typical bite: all are scored, and the best `_SLIDES` are aligned.
_ASIDE_MM, _UP_MM, _AHEAD_MM = (-4.0, -2.0, 0.0, 2.0, 4.0), (-2.0, 0.0, 2.0), (-4.0, -2.0, 0.0, 2.0, 4.0)
_SLIDES = 4
_MISFIT_GATE_MM = 1.5


@dataclass(frozen=True, eq=False)
class Candidate:
    """Candidate view of a photograph."""

    share: float  # fraction of the drawn lines that are near an outline [-]
    T_cam_upper: Array  # upper scan to camera [mm], shape (4, 4)
    focal_px: float
    mirrored: bool


@dataclass(frozen=True, eq=False)
class TypicalBite:
    """Poses of two arches in a typical bite."""

    T_anatomical_upper: Array  # upper scan to (left, up, front) axes, shape (4, 4)
    T_anatomical_lower: Array  # lower scan to the same axes, shape (4, 4)

    @property
    def T_upper_lower(self) -> Array:
        """Pose of the lower arch in the upper scan, shape (4, 4)."""
        return se3_inverse(self.T_anatomical_upper) @ self.T_anatomical_lower


def typical_bites(scans: Sequence[Scan]) -> list[TypicalBite]:
    """Return typical bites, one for each possible orientation of the two arches.

    The plane and forward direction of an arch follow from its shape, and up from its gum; without gum, both signs are
    tried.
    """
    frames = [[_row_frame(scan, r, side) for side in _sides(scan, r)] for r, scan in enumerate(scans)]
    shift = make_transform(np.eye(3), np.array([0.0, _OVERBITE_MM, -_OVERJET_MM]))
    return [TypicalBite(upper, shift @ lower) for upper, lower in product(*frames)]


def _sides(scan: Scan, arch: int) -> list[float]:
    """Return the signs for which the smallest principal axis of an arch may point up."""
    if len(scan.gum_faces) < len(scan.crown_faces) // 10:
        return [1.0, -1.0]
    gum = scan.vertices[np.unique(scan.gum_faces)].mean(0) - scan.centre
    towards_gum = float(np.sign(_least_axis(scan) @ gum))
    return [towards_gum if arch == 0 else -towards_gum]


def _least_axis(scan: Scan) -> Array:
    points = scan.crown_vertices(4000)
    return np.asarray(np.linalg.svd(points - points.mean(0), full_matrices=False)[2][2], np.float64)


def _row_frame(scan: Scan, arch: int, side: float) -> Array:
    """Return T_anatomical_scan of one arch, with its origin at the edges of the front teeth, shape (4, 4)."""
    points = scan.crown_vertices(4000)
    up = side * _least_axis(scan)
    # Compute it as the anatomical frame of a bite whose other arch is a shifted copy of this arch.
    T = anatomical_frame(points, points - _ROWS_APART_MM * up)
    x, y, z = (points @ T[:3, :3].T).T
    edge = np.percentile(y[z > np.percentile(z, 90)], 2 if arch == 0 else 98)
    return make_transform(T[:3, :3], np.array([T[0, 3], -edge, -np.percentile(z, 99.5)]))


def searched(drawing: Drawing, crowns: Sequence[Crowns], usual: TypicalBite, T_upper_lower: Array) -> list[Candidate]:
    """Return the most promising views of both arches, decimated and in an assumed bite, one per viewing direction."""
    size = next_fast_len(int(1.3 * _PX_PER_MM * _WIDTHS_MM.max()), real=True)
    drawn = list(_drawn_spectra(drawing, size))
    found: list[Candidate] = []
    for turn in product(_YAW, _PITCH, _ROLL):
        base = (
            make_transform(_facing(turn), np.zeros(3)) @ make_transform(np.eye(3), _FRONT_MM) @ usual.T_anatomical_upper
        )
        base[2, 3] += _DISTANCE_MM
        spectra = _seen_spectra(crowns, base, T_upper_lower, size)
        best: dict[bool, Candidate] = {}
        for width_mm, mirrored, spectrum, total in drawn:
            overlap = irfft2((spectrum * spectra.conj()).sum(0), (size, size))
            share = float(overlap.max()) / total
            if mirrored in best and share <= best[mirrored].share:
                continue
            row, column = np.unravel_index(int(overlap.argmax()), overlap.shape)
            # Convert the shift of the outlines relative to the image centre to a position of the teeth.
            shift = [(k + size // 2) % size - size // 2 for k in (column, row)]
            pose = base.copy()
            pose[:2, 3] += np.array(shift) / _PX_PER_MM
            best[mirrored] = Candidate(share, pose, drawing.size_px[0] / width_mm * _DISTANCE_MM, mirrored)
        found += best.values()
    return _of_each_hand(found, lambda one: -one.share, _CANDIDATES)


def _facing(turn: tuple[float, float, float]) -> Array:
    """Return the rotation from (left, up, front) to the (right, down, ahead) axes of a front camera, shape (3, 3)."""
    yaw, pitch, roll = turn
    facing = np.diag([1.0, -1.0, -1.0])
    return np.asarray(so3_exp([0, 0, roll]) @ so3_exp([pitch, 0, 0]) @ facing @ so3_exp([0, yaw, 0]), np.float64)


def _drawn_spectra(drawing: Drawing, size: int) -> Iterator[tuple[float, bool, NDArray[np.complex128], float]]:
    """Yield for each candidate: field of view [mm], whether mirrored, spectra by direction bin, number of points."""
    for mirrored in (False, True):
        lines = drawing.mirrored() if mirrored else drawing
        middle = middle_of(drawing.size_px)
        for width_mm in _WIDTHS_MM:
            pixels = (lines.pixels - middle) * (_PX_PER_MM * width_mm / drawing.size_px[0]) + size / 2
            picture = _by_sector(pixels, lines.normals, size)
            yield width_mm, mirrored, rfft2(picture), float(picture.sum())


def _by_sector(pixels: Array, normals: Array, size: int) -> Array:
    """Return binary images of points by direction bin, shape (_SECTORS, size, size)."""
    out = np.zeros((_SECTORS, size, size))
    sector = np.round(np.arctan2(normals[:, 1], normals[:, 0]) / np.pi * _SECTORS).astype(int) % _SECTORS
    column, row = np.round(pixels).astype(int).T
    inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
    out[sector[inside], row[inside], column[inside]] = 1.0
    return out


def _seen_spectra(
    crowns: Sequence[Crowns], T_cam_upper: Array, T_upper_lower: Array, size: int
) -> NDArray[np.complex128]:
    """Return spectra of images that are 1 on outlines and decrease with distance from them, shape (_SECTORS, h, w)."""
    focal = _PX_PER_MM * _DISTANCE_MM
    K = intrinsics(focal, focal, size / 2, size / 2)
    matrices = [K @ T_cam_upper[:3], K @ (T_cam_upper @ T_upper_lower)[:3]]
    depth, labels = draw_teeth(crowns, matrices, (size, size))
    seen = outlines_of(crowns, matrices, depth, labels)
    lines = _by_sector(seen.pixels, seen.normals, size)
    near = np.zeros_like(lines)
    for k in range(_SECTORS):
        any_line = lines[k] > 0
        if any_line.any():
            near[k] = np.exp2(-((distance_transform_edt(~any_line) / _NEAR_PX) ** 2))
    return np.asarray(rfft2(near), np.complex128)


@dataclass(frozen=True, eq=False)
class ArchPair:
    """Both arches split into teeth, at full resolution and decimated, and their typical bite."""

    usual: TypicalBite
    fine: tuple[Crowns, Crowns]
    thin: tuple[Crowns, Crowns]

    @classmethod
    def of(cls, scans: Sequence[Scan], usual: TypicalBite) -> ArchPair:
        """Split both scans into teeth."""
        frames = usual.T_anatomical_upper, usual.T_anatomical_lower
        fine, thin = (
            [split_teeth(scan, T, r) for r, (scan, T) in enumerate(zip(some, frames, strict=True))]
            for some in (scans, [thinned(scan, _FACES) for scan in scans])
        )
        return cls(usual, (fine[0], fine[1]), (thin[0], thin[1]))


@dataclass(frozen=True, eq=False)
class PhotoStart:
    """Initial pose of one photograph."""

    misfit: float  # misfit of its lines (see `Aligner.misfit`) [-]
    mirrored: bool
    bite: Bite  # pose and bite from this photograph alone, at reduced size
    rows: ArchPair
    other_misfit: float = 1.0  # smallest misfit of a start with the opposite mirroring


def find_first(drawing: Drawing, scans: Sequence[Scan], usual: Sequence[TypicalBite], contact: Contact) -> PhotoStart:
    """Return the best start of a photograph with an unknown bite, searching around typical bites."""
    pairs = [ArchPair.of(scans, bite) for bite in usual]
    tried = [start for rows in pairs for start in _aligned_candidates(drawing, rows, rows.usual.T_upper_lower)]
    return _best(tried, contact, _slid)


def find_next(drawing: Drawing, rows: ArchPair, T_upper_lower: Array, contact: Contact) -> PhotoStart:
    """Return the best start of a photograph, given an approximate bite from another photograph."""

    def with_bite(start: PhotoStart, aligner: Aligner) -> list[Bite]:
        return [replace(start.bite, T_upper_lower=T_upper_lower)]

    return _best(_aligned_candidates(drawing, rows, T_upper_lower), contact, with_bite)


def _aligned_candidates(drawing: Drawing, rows: ArchPair, T_upper_lower: Array) -> Iterator[PhotoStart]:
    """Yield the most promising views after some alignment steps."""
    aligner = Aligner(rows.thin, rows.usual.T_upper_lower, None)
    factor = _WIDTH_PX / drawing.size_px[0]
    for one in searched(drawing, rows.thin, rows.usual, T_upper_lower):
        lines = drawing.mirrored() if one.mirrored else drawing
        photo = Photo(lines, PhotoPose(one.T_cam_upper, one.focal_px, 0.0)).shrunk(factor)
        bite = aligner.aligned(Bite((photo,), T_upper_lower, np.zeros(2)), _WIDE_GATES)
        yield PhotoStart(_misfit(aligner, bite), one.mirrored, bite, rows)


def _misfit(aligner: Aligner, bite: Bite) -> float:
    """Return the misfit of one photograph, averaged over both arches."""
    return float(aligner.misfit(bite, _MISFIT_GATE_MM).mean())


def _slid(start: PhotoStart, aligner: Aligner) -> list[Bite]:
    """Return the bite of a start, and the best of the shifted ones."""
    usual = start.rows.usual
    axes = usual.T_anatomical_upper[:3, :3]
    out = []
    for slide in product(_ASIDE_MM, _UP_MM, _AHEAD_MM):
        T_upper_lower = make_transform(np.eye(3), axes.T @ slide) @ usual.T_upper_lower
        out.append(replace(start.bite, T_upper_lower=T_upper_lower))
    return [start.bite, *sorted(out, key=lambda one: _misfit(aligner, one))[:_SLIDES]]


def _best(
    tried: Iterable[PhotoStart], contact: Contact, bites: Callable[[PhotoStart, Aligner], list[Bite]]
) -> PhotoStart:
    """Return the best start after alignment of the finalists from each of the given bites."""
    ends = []
    for start in _of_each_hand(tried, lambda one: one.misfit, _FINALISTS):
        aligner = Aligner(start.rows.thin, start.rows.usual.T_upper_lower, contact)
        for begin in bites(start, aligner):
            bite = aligner.aligned(begin, _SLID_GATES)
            ends.append(replace(start, misfit=_misfit(aligner, bite), bite=bite))
    best = min(ends, key=lambda one: one.misfit)
    other = min((one.misfit for one in ends if one.mirrored is not best.mirrored), default=1.0)
    return replace(best, other_misfit=other)


S = TypeVar("S", Candidate, PhotoStart)


def _of_each_hand(found: Iterable[S], badness: Callable[[S], float], count: int) -> list[S]:
    """Return the best unmirrored and the best mirrored views, `count` of each for a fair comparison."""
    ordered = sorted(found, key=badness)
    return [one for way in (False, True) for one in [each for each in ordered if each.mirrored is way][:count]]
