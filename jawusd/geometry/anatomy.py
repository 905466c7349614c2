"""The anatomical frame, the named landmarks and the mandible metric, computed from the scans.

Anatomical axes: x to the subject's left, y up, z anterior, origin at the upper incisal point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.geometry.se3 import make_transform, transform_points
from jawusd.geometry.so3 import hat

#: Order of the landmarks in every table and file; all move with the mandible.
LANDMARKS = ("incisor", "molar_left", "molar_right", "condyle_left", "condyle_right")

#: Words for population means in the description of inferred condyles.
MEAN_CONDYLES = "at mean adult positions"

# Used only without a mandible mesh: the mean Bonwill triangle of 120 adults in cone beam CT ("A
# three-dimensional morphometric study on the position of temporomandibular joints", PubMed 26734666): 99.6 mm between
# the condyles, 103.3 mm from each to the incisal point, 34.3 mm above the occlusal plane (Balkwill angle 20 degrees).
_CONDYLES_APART_MM, _CONDYLE_TO_INCISOR_MM, _CONDYLE_ABOVE_MM = 99.6, 103.3, 34.3
# Change of the distance between the condyles per mm of lower arch width: correlation 0.3 (Dahri et al. 2012, J Pak Dent
# Assoc 21:141, 100 adults) times the ratio of the standard deviations, about 5 to 2.5 mm.
_APART_PER_WIDTH = 0.6
_MEAN_WIDTH_MM, _WIDTH_RANGE_MM = 44.0, (36.0, 52.0)
# From the tragus of the ear to the condyle centre: 13 mm forward (Beyron's point) and about 20 mm inward.
_FROM_TRAGION_MM = np.array([-20.0, 0.0, 13.0])
# Typical posterior and lateral distances of the first molars from the incisal point.
_MOLAR_BEHIND_INCISOR_MM = 25.0
_MOLAR_ASIDE_MM = 22.0
_MIDLINE_MM = 4.0  # lateral extent of the incisal edge on each side of the midline
_THINNED = 3000  # number of points of an arch that are sufficient to find its axes
_MIN_FRONT = 40  # minimum number of points on an incisal edge
_MIN_SLABS = 4  # minimum number of coronal slabs with teeth on both sides to find the midline
# Size of the cells in which heights of the dental arches are compared, and minimum number of cells that both arches
# share; with fewer cells, mean heights are compared.
_CELL_MM, _MIN_CELLS = 4.0, 6


def anatomical_frame(upper_vertices: ArrayLike, lower_vertices: ArrayLike) -> Array:
    """Return T_anatomical_skull (4, 4) from the crown vertices (N, 3) and (M, 3) [mm] of two dental scans in occlusion.

    Up is the normal of the common plane of both arches, from the lower to the upper one; the midline is the mirror axis
    of the arches in that plane; anterior is the side of the closed end of the horseshoe-shaped arches. Teeth may be
    missing.
    """
    upper, lower = np.asarray(upper_vertices, dtype=np.float64), np.asarray(lower_vertices, dtype=np.float64)
    both = np.concatenate([_thin(upper), _thin(lower)])
    centre = both.mean(0)
    normal = bite_normal(upper, lower)
    e1 = np.linalg.svd(both - centre, full_matrices=False)[2][0]
    e1 = e1 - normal * (normal @ e1)
    e1 /= np.linalg.norm(e1)
    flat = np.stack([(both - centre) @ e1, (both - centre) @ np.cross(normal, e1)], axis=-1)
    angle = _mirror_angle(flat)
    anterior = np.cos(angle) * e1 + np.sin(angle) * np.cross(normal, e1)
    # the arch is wide and open at the back: its lateral spread grows away from the front
    depth = (both - centre) @ anterior
    lateral = np.abs((both - centre) @ np.cross(normal, anterior))
    if np.corrcoef(depth, lateral)[0, 1] > 0:
        anterior = -anterior
    R, midline = _centre_midline(both, np.stack([np.cross(normal, anterior), normal, anterior]))
    crown = upper @ R.T
    crown[:, 0] -= midline
    edge = _front_edge(crown, -1.0, 0.6)
    return make_transform(R, -np.array([midline, edge[:, 1].min(), edge[:, 2].mean()]))


def bite_normal(upper_vertices: ArrayLike, lower_vertices: ArrayLike) -> Array:
    """Return the normal (3,) of the common plane of two arches in occlusion, from the lower to the upper one.

    The sign is decided by local heights of the crown vertices (N, 3) and (M, 3) [mm], in cells where both arches
    overlap. Mean heights of whole arches mislead with missing, short or deeply overlapping teeth.
    """
    upper, lower = _thin(np.asarray(upper_vertices, np.float64)), _thin(np.asarray(lower_vertices, np.float64))
    centred = np.concatenate([upper - upper.mean(0), lower - lower.mean(0)])
    e1, e2, normal = np.linalg.svd(centred, full_matrices=False)[2]
    heights = []
    for points in (upper, lower):
        cells = np.floor(np.stack([points @ e1, points @ e2], 1) / _CELL_MM).astype(int)
        unique, index = np.unique(cells, axis=0, return_inverse=True)
        mean = np.bincount(index.ravel(), points @ normal) / np.bincount(index.ravel())
        heights.append(dict(zip(map(tuple, unique.tolist()), mean.tolist())))
    shared = [heights[0][cell] - heights[1][cell] for cell in heights[0].keys() & heights[1].keys()]
    above = np.median(shared) if len(shared) >= _MIN_CELLS else normal @ (upper.mean(0) - lower.mean(0))
    return -normal if above < 0 else normal


def _front_edge(crown: Array, side: float, within_mm: float) -> Array:
    """Return the points of the incisal edge near the midline, or of the nearest teeth if incisors are missing.

    Crowns are x from the midline, y up, z anterior [mm], (N, 3). The edge is their upper end if `side` is 1, the lower
    one if -1, within a height difference from the outermost point.
    """
    reach = max(_MIDLINE_MM, float(np.sort(np.abs(crown[:, 0]))[min(_MIN_FRONT, len(crown) - 1)]))
    front = crown[np.abs(crown[:, 0]) <= reach]
    front = front[front[:, 2] > front[:, 2].max() - 5.0]
    height = side * front[:, 1]
    return front[height > height.max() - within_mm]


def _centre_midline(points: Array, R: Array) -> tuple[Array, float]:
    """Rotate the lateral axis until the line midway between the buccal outlines of points (N, 3) [mm] is sagittal.

    R (3, 3) has the initial left, up and anterior axes as rows. Return the corrected R and the midline's lateral
    coordinate.
    """
    midline = float(np.percentile(points @ R[0], [2, 98]).mean())
    for _ in range(8):
        x, z = points @ R[0], points @ R[2]
        bins = np.linspace(np.percentile(z, 3), np.percentile(z, 85), 17)
        depth, middle = [], []
        for low, high in zip(bins[:-1], bins[1:], strict=True):
            slab = x[(z >= low) & (z < high)]
            # a slab that has teeth on only one side has no midpoint
            if min(np.count_nonzero(slab > midline), np.count_nonzero(slab < midline)) >= 10:
                depth.append(0.5 * (low + high))
                middle.append(0.5 * (np.percentile(slab, 1.5) + np.percentile(slab, 98.5)))
        if len(depth) < _MIN_SLABS:
            break
        slope, midline = np.polyfit(depth, middle, 1)
        if abs(slope) < 1e-6:
            break
        left = R[0] - np.tanh(slope) * R[2]
        left /= np.linalg.norm(left)
        R = np.stack([left, R[1], np.cross(left, R[1])])
    return R, float(midline)


def _thin(points: Array) -> Array:
    return points[:: max(1, len(points) // _THINNED)]


def _mirror_angle(flat: Array) -> float:
    """Return the angle [rad] of the axis about which a planar point set (N, 2) is most nearly symmetric."""
    # compare the outline, as radius over angle, with its mirror image: robust to uneven sampling
    flat = flat - 0.5 * (np.percentile(flat, 1, axis=0) + np.percentile(flat, 99, axis=0))
    bins = 360
    polar = np.arctan2(flat[:, 1], flat[:, 0])
    radius = np.linalg.norm(flat, axis=1)
    index = np.floor((polar + np.pi) / (2 * np.pi) * bins).astype(int) % bins
    profile = np.zeros(bins)
    np.maximum.at(profile, index, radius)
    kernel = np.hanning(13)
    profile = np.convolve(np.pad(profile, 12, mode="wrap"), kernel / kernel.sum(), mode="same")[12:-12]
    angles = -np.pi + (np.arange(bins) + 0.5) * 2 * np.pi / bins
    # mirroring at angle a maps direction phi to 2a - phi, which permutes the bins
    cost = np.array([np.mean((profile - profile[(shift - np.arange(bins)) % bins]) ** 2) for shift in range(bins)])
    shift = int(np.argmin(cost))
    around = [cost[(shift + k) % bins] for k in (-1, 0, 1)]
    bend = around[0] - 2 * around[1] + around[2]
    fraction = 0.0 if bend <= 0 else 0.5 * (around[0] - around[2]) / bend
    # bins i and shift - i are mirror images: a = (phi_i + phi_{shift-i}) / 2
    return float(0.5 * (2 * angles[0] + (shift + fraction) * 2 * np.pi / bins))


def find_landmarks(
    lower_vertices: ArrayLike,
    mandible_vertices: ArrayLike | None,
    T_anatomical_skull: ArrayLike,
    tragions: ArrayLike | None = None,
) -> Array:
    """Return the five landmarks of `LANDMARKS` on the mandible, mandible (scan) frame [mm], shape (5, 3).

    Args:
        lower_vertices: crown vertices of the lower scan, scan frame [mm], shape (N, 3).
        mandible_vertices: mandible mesh in the same frame [mm], shape (M, 3); without it, the condyles are placed at
            mean adult distances from the tragions or, without these, from the incisal point.
        T_anatomical_skull: scan frame to anatomical frame with the teeth in occlusion, shape (4, 4).
        tragions: upper edge of the left and right tragus of the ears, scan frame [mm], shape (2, 3).
    """
    A = np.asarray(T_anatomical_skull, dtype=np.float64)
    lower = transform_points(A, np.asarray(lower_vertices, dtype=np.float64))
    out = np.empty((5, 3))
    edge = _front_edge(lower, 1.0, 0.4)
    out[0] = [0.0, edge[:, 1].max(), edge[:, 2].mean()]
    for row, side in ((1, 1.0), (2, -1.0)):
        z = out[0, 2] - _MOLAR_BEHIND_INCISOR_MM
        near = lower[(lower[:, 0] * side > 0) & (np.abs(lower[:, 2] - z) < 3.0)]
        if len(near):
            out[row] = near[near[:, 1] >= np.percentile(near[:, 1], 70)].mean(0)
        else:  # the scan has no tooth in this region
            out[row] = [side * _MOLAR_ASIDE_MM, out[0, 1], z]
    if mandible_vertices is None:
        out[3:] = _mean_condyles(out[0], out[1, 0] - out[2, 0])
        if tragions is not None:
            out[3:] = transform_points(A, tragions) + _FROM_TRAGION_MM * [[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]]
    else:
        mandible = transform_points(A, np.asarray(mandible_vertices, dtype=np.float64))
        out[3], out[4] = _condyle(mandible, 1.0), _condyle(mandible, -1.0)
    return transform_points(np.linalg.inv(A), out)


def _mean_condyles(incisor: Array, arch_width_mm: float) -> Array:
    """Return the condyles of a mean adult with an arch width between the first molars, anatomical frame, (2, 3)."""
    wider_mm = np.clip(arch_width_mm, *_WIDTH_RANGE_MM) - _MEAN_WIDTH_MM
    half = 0.5 * (_CONDYLES_APART_MM + _APART_PER_WIDTH * wider_mm)
    behind = np.sqrt(_CONDYLE_TO_INCISOR_MM**2 - half**2 - _CONDYLE_ABOVE_MM**2)
    return incisor + np.array([[side * half, _CONDYLE_ABOVE_MM, -behind] for side in (1.0, -1.0)])


def landmark_frame(landmarks: ArrayLike) -> Array:
    """Return the transform (4, 4) from the frame of the landmarks (5, 3) [mm] to an anatomical frame defined by them.

    The occlusal plane contains the incisal point and the molars; the origin is the lower incisal point.
    """
    incisor, molar_left, molar_right = np.asarray(landmarks, dtype=np.float64)[:3]
    forward = incisor - 0.5 * (molar_left + molar_right)
    up = np.cross(forward, molar_left - molar_right)
    up /= np.linalg.norm(up)
    forward /= np.linalg.norm(forward)
    R = np.stack([np.cross(up, forward), up, forward])
    return make_transform(R, -R @ incisor)


def _condyle(mandible: Array, side: float) -> Array:
    """Return the centre of one condylar head in anatomical coordinates, shape (3,)."""
    half = mandible[mandible[:, 0] * side > 0]
    # the coronoid process may be as high as the condyle but lies well in front of it
    posterior = half[half[:, 2] < half[:, 2].min() + 0.28 * np.ptp(half[:, 2])]
    top = posterior[:, 1].max()
    head = posterior[posterior[:, 1] > top - 8.0]
    low, high = head.min(0), head.max(0)
    return np.array([0.5 * (low[0] + high[0]), top - 4.0, 0.5 * (low[2] + high[2])])


def mandible_metric(points: ArrayLike) -> Array:
    """Return M (6, 6) with ``xi^T M xi`` = mean squared displacement of points (N, 3) [mm] under a small twist xi.

    A point p moves by ``omega x p + v``, so M = mean of [-hat(p), I]^T [-hat(p), I].
    """
    p = np.asarray(points, dtype=np.float64)
    J = np.concatenate([-hat(p), np.broadcast_to(np.eye(3), (len(p), 3, 3))], axis=-1)
    return np.einsum("nij,nik->jk", J, J) / len(p)
