"""A placeholder for a missing mandible mesh: a tube swept below the lower scan and up to the condyles.

It indicates roughly where bone may be; it does not show the anatomy, and is marked as a placeholder. The condyles are
taken from the landmarks, or from the motion if the landmarks are only mean adult positions. In opening and in
protrusion the condyle slides along the same path, the eminence, so its trajectories form a thinner band than those of
nearby points (the kinematic condylar centre; Kohno 1972, Yatabe et al. 1995, J Dent Res 74:1321).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.formats.mesh import Mesh
from jawusd.geometry.anatomy import LANDMARKS
from jawusd.geometry.se3 import se3_inverse, transform_point, transform_points

_CONDYLES = [LANDMARKS.index(name) for name in ("condyle_left", "condyle_right")]
_INCISOR = LANDMARKS.index("incisor")

# Range and step [mm] of the search for the point with the thinnest band of trajectories, upward and forward from the
# mean adult position.
_REACH_MM = 18.0
_STEP_MM = 1.5
_PATH_DEGREE = 3
# Minimum travel of the condyles [mm], and maximum thickness of their band of trajectories as a fraction of the
# thickness at the mean position; outside these limits, the motion is not used.
_LEAST_TRAVEL_MM = 5.0
_CLEARLY_THINNER = 0.85
_FEWEST_POSES = 30

# Directions [rad] of the body's cross-sections, from the middle of the arch's open end; 0 is the front.
_STATIONS = np.radians([75.0, 50.0, 25.0, 0.0, -25.0, -50.0, -75.0])
_STATION_WIDTH = np.radians(9.0)
_FEWEST_VERTICES = 10
# Dimensions of a mean adult mandible [mm]: half thickness and half height of cross-sections, and depth of the body
# below the scan.
_BODY_MM = (5.5, 13.0)
_BODY_BELOW_SCAN_MM = 9.0
_HEAD_MM, _NECK_MM, _RAMUS_MM, _ANGLE_MM = (9.0, 4.5), (5.0, 4.0), (4.5, 14.0), (5.0, 13.0)
_CORNERS = 20
_SECTIONS = 12  # number of sections interpolated between two control sections


@dataclass(frozen=True, eq=False)
class Placeholder:
    """A placeholder for a mandible.

    Attributes:
        mesh: Closed surface, mandible frame [mm].
        condyles: Centres of left and right condyle, mandible frame [mm], shape (2, 3).
        source: Source of the condyles.
    """

    mesh: Mesh
    condyles: Array
    source: str


def grow_placeholder(rig: JawRig, lower_teeth: Mesh) -> Placeholder:
    """Build a placeholder from a rig and the lower scan, mandible frame [mm]."""
    T_anatomical_mandible = rig.T_anatomical_skull @ rig.T_rest
    condyles, source = find_condyles(rig)
    scan = transform_points(T_anatomical_mandible, lower_teeth.vertices)
    vertices, faces = _swept(*_control_sections(scan, transform_points(T_anatomical_mandible, condyles)))
    return Placeholder(Mesh(transform_points(se3_inverse(T_anatomical_mandible), vertices), faces), condyles, source)


def find_condyles(rig: JawRig) -> tuple[Array, str]:
    """Return the centres of left and right condyle, mandible frame [mm], shape (2, 3), and their source.

    The motion determines the height and the front-to-back position of a condyle; the landmark determines its distance
    from the midline.
    """
    landmarks = rig.landmarks[_CONDYLES]
    inferred = [text for text in rig.inferred if text.startswith("condyle")]
    if not any("mean adult places" in text for text in inferred):
        return landmarks, "landmarks of the model"
    T_anatomical_mandible = rig.T_anatomical_skull @ rig.T_rest
    back = se3_inverse(T_anatomical_mandible)
    poses = rig.T_anatomical_skull @ rig.pose(rig.captured_d) @ back
    poses = poses[:: max(1, len(poses) // 400)]
    mean = transform_points(T_anatomical_mandible, landmarks)
    found = [_thinnest(poses, place) for place in mean]
    if len(poses) < _FEWEST_POSES or any(place is None for place in found):
        return landmarks, "mean adult places"
    return transform_points(back, np.array(found)), "estimated from the motion"


def _thinnest(poses: Array, mean: Array) -> Array | None:
    """Return the point near a mean position whose sagittal trajectories form the thinnest band; None without one."""
    offsets = np.arange(-_REACH_MM, _REACH_MM + 0.5 * _STEP_MM, _STEP_MM)
    grid = np.stack(np.meshgrid([0.0], offsets, offsets, indexing="ij"), axis=-1)[0] + mean
    thickness = np.array([[_thickness(poses, point) for point in row] for row in grid])
    i, j = np.unravel_index(np.argmin(thickness), thickness.shape)
    inside = 0 < i < len(offsets) - 1 and 0 < j < len(offsets) - 1
    clear = thickness[i, j] < _CLEARLY_THINNER * _thickness(poses, mean)
    return grid[i, j] if inside and clear else None


def _thickness(poses: Array, point: Array) -> float:
    """Return the RMS distance [mm] of a point's sagittal trajectory from a smooth path."""
    y, z = transform_point(poses, point)[:, 1:].T
    travel = np.ptp(z)
    if travel < _LEAST_TRAVEL_MM:
        return np.inf
    s = (z - z.mean()) / travel
    path = np.polynomial.Polynomial.fit(s, y, _PATH_DEGREE)
    slope = path.deriv()(s) / travel
    return float(np.sqrt(np.mean((y - path(s)) ** 2 / (1 + slope**2))))


def _control_sections(scan: Array, condyles: Array) -> tuple[Array, Array, Array]:
    """Return centres and half axes of the control sections from the left to the right condyle, each (n, 3)."""
    body, thin, tall = _body(scan)
    left, right = (np.array(_ramus(condyle, body[end])) for condyle, end in ((condyles[0], 0), (condyles[1], -1)))
    sections = np.concatenate([left, np.stack([body, thin, tall], axis=1), right[::-1]])
    return sections[:, 0], sections[:, 1], sections[:, 2]


def _ramus(condyle: Array, rear: Array) -> list[tuple[Array, Array, Array]]:
    """Return centre and half axes of head, neck, ramus and angle. The thin axis points outward on both sides."""
    side = np.sign(condyle[0])
    angle = np.array([0.9 * condyle[0], rear[1] - 4.0, condyle[2] + 10.0])
    neck = condyle + [0.0, -11.0, 2.0]
    ramus = 0.5 * (neck + angle) + [0.0, 4.0, 6.0]
    x, z, diagonal = np.array([side, 0, 0]), np.array([0, 0, 1.0]), np.array([0, np.sqrt(0.5), np.sqrt(0.5)])
    sizes = zip((condyle, neck, ramus, angle), (_HEAD_MM, _NECK_MM, _RAMUS_MM, _ANGLE_MM), (z, z, z, diagonal))
    return [(centre, a * x, b * tall) for centre, (a, b), tall in sizes]


def _body(scan: Array) -> tuple[Array, Array, Array]:
    """Return centres and half axes of the body's sections, below the arch of the scan, each (n, 3)."""
    open_end = np.percentile(scan[:, 2], 5)
    direction = np.arctan2(scan[:, 0], scan[:, 2] - open_end)
    known: list[float] = []
    found: list[list[float]] = []
    for station in _STATIONS:
        near = scan[np.abs(direction - station) < _STATION_WIDTH]
        if len(near) >= _FEWEST_VERTICES:
            known.append(station)
            found.append([*near[:, [0, 2]].mean(axis=0), np.percentile(near[:, 1], 5)])
    if len(known) < 2:  # a scan of a few teeth: use a body of default size below them
        known, found = [0.0], [[*scan[:, [0, 2]].mean(axis=0), scan[:, 1].min()]]
    # stations run from left to right; np.interp needs increasing values
    x, z, low = (np.interp(_STATIONS, known[::-1], column) for column in np.array(found)[::-1].T)
    centres = np.stack([x, low - _BODY_BELOW_SCAN_MM, z], axis=1)
    outward = np.stack([np.sin(_STATIONS), np.zeros(len(_STATIONS)), np.cos(_STATIONS)], axis=1)
    return centres, _BODY_MM[0] * outward, np.tile([0.0, _BODY_MM[1], 0.0], (len(_STATIONS), 1))


def _swept(centres: Array, thin: Array, tall: Array) -> tuple[Array, NDArray[np.int32]]:
    """Return vertices and faces of elliptic sections swept along a smooth path, closed by rounded ends."""
    at = np.linspace(0, len(centres) - 1, _SECTIONS * (len(centres) - 1) + 1)
    centres, thin, tall = (_smooth(rows, at) for rows in (centres, thin, tall))
    # Rounded caps: further sections beyond both ends, with radii that follow a quarter circle.
    turn = np.linspace(0, np.pi / 2, 7)[1:-1]
    for end, inner in ((0, 1), (-1, -2)):
        ahead = centres[end] - centres[inner]
        ahead *= np.linalg.norm(tall[end]) / np.linalg.norm(ahead)
        shrinking = np.cos(turn)[:, None]
        dome = (centres[end] + np.sin(turn)[:, None] * ahead, shrinking * thin[end], shrinking * tall[end])
        parts = ((d[::-1], rows) if end == 0 else (rows, d) for d, rows in zip(dome, (centres, thin, tall)))
        centres, thin, tall = (np.concatenate(pair) for pair in parts)
    around = 2 * np.pi * np.arange(_CORNERS) / _CORNERS
    rings = centres[:, None] + np.cos(around)[:, None] * thin[:, None] + np.sin(around)[:, None] * tall[:, None]
    vertices = np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(axis=1)])
    return vertices, _outward(vertices, _tube_faces(len(rings)))


def _smooth(rows: Array, at: Array) -> Array:
    """Return a Catmull-Rom curve through rows (n, 3) at parameters 0 .. n - 1."""
    slopes = np.gradient(rows, axis=0)
    i = np.minimum(at.astype(int), len(rows) - 2)
    t = (at - i)[:, None]
    low = (1 + 2 * t) * (1 - t) ** 2 * rows[i] + t * (1 - t) ** 2 * slopes[i]
    return low + t * t * (3 - 2 * t) * rows[i + 1] + t * t * (t - 1) * slopes[i + 1]


def _tube_faces(rings: int) -> NDArray[np.int32]:
    j = np.arange(_CORNERS)
    k = (j + 1) % _CORNERS
    start = _CORNERS * np.arange(rings - 1)[:, None]
    quads = np.stack([start + j, start + k, start + _CORNERS + k, start + _CORNERS + j], axis=-1).reshape(-1, 4)
    first, last, end = rings * _CORNERS, rings * _CORNERS + 1, (rings - 1) * _CORNERS
    caps = [np.stack([np.full(_CORNERS, first), k, j], 1), np.stack([np.full(_CORNERS, last), end + j, end + k], 1)]
    return np.concatenate([quads[:, :3], quads[:, [0, 2, 3]], *caps]).astype(np.int32)


def _outward(vertices: Array, faces: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return faces whose normals point out of the volume, flipped if needed."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return faces if np.einsum("ij,ij->", a, np.cross(b, c)) > 0 else faces[:, ::-1].copy()
