"""Contacts of a subject's teeth and jaw joints: solids, the clearance of poses, and images of tooth contacts.

In a joint, cartilage and disc separate the bones but are not in the scans, and tracking and model errors are largest at
the condyles. Clearances of the joints are therefore reported, but never used to reject poses.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array, Mask
from jawusd.evaluator import JawRig
from jawusd.evaluator.contact import AUTHORED_MM, NEAR_MM, UNIT_MM, ContactField
from jawusd.formats.mesh import BASE, DEEP, TOUCHING, Mesh
from jawusd.geometry.anatomy import LANDMARKS
from jawusd.geometry.se3 import se3_inverse, transform_points
from jawusd.meshes.collision import FARTHEST_MM, STEP_MM, Pair, Solid, distances, solid, tips_box

_CROWN_MM = 14.0  # maximum height of a crown above the gum
# minimum fraction of lines whose first crossing enters the scan; at least 0.93 for consistent winding
_LEAST_WOUND = 0.6
_WIDEST_GAP_MM = 1.0
_DEEPEST_MM = 2.5  # maximum penetration of teeth, and of a condyle into the skull, in the closed bite
_COARSEST_MM = 1.5  # maximum median edge length of a scan's triangles

#: Grid step of sampled joint clearances [mm].
JOINT_STEP_MM = 0.8
_BONE_GRID_MM = 0.5  # step of the distance grid; clearances differ by at most 0.014 mm from those of a 0.25 mm grid
# Indices of the left and the right condyle.
_CONDYLES = [index for index, name in enumerate(LANDMARKS) if name.startswith("condyle")]
_CONDYLE_MM = 10.0  # radius around the condyle landmark that includes the condylar head but not the coronoid process
_REACH_MM = 26.0  # maximum translation of the condylar head, which may move past the articular eminence
_COARSEST_BONE_MM = 4.0  # maximum median edge length of a bone's triangles; a condyle is about 8 mm deep
_FEWEST_FACES = 30
_FARTHEST_CONDYLE_MM = 8.0  # maximum distance of a condyle from the skull in the closed bite

_STEP_MM, _MOST_OPENING_MM = 0.3, 16.0  # grid step and maximum mouth opening of sampled tooth clearances
# Clearance above which the coarse step is used: twice NEAR_MM, the clearance below which errors are measured.
_CLOSE_MM = 1.0
_BEYOND_MM = 1.0  # distance from the bound up to which poses outside it are also sampled
_FREE_MM = 0.8  # minimum clearance of all valid poses at larger mouth openings for sampling to stop
_ERROR_SAMPLES = 30000  # number of random test poses; one in twenty is a valid pose with the teeth close together
_CAPTURED_QUANTILE = 0.01
_LARGEST_LIMIT_MM = 1.0
Picture = NDArray[np.uint8]

_ENAMEL, _PAPER = np.array([236.0, 229.0, 212.0]), 255
_LIGHT = np.array([0.3, 0.87, -0.4])
_FLOOR_MM = 11.0  # maximum depth below the crown tips at which a surface is drawn; deeper surfaces are gum


class NoContact(Exception):
    """Raised if contacts cannot be computed from the scans; the message gives the reason."""


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Opposing surfaces of skull and mandible in the anatomical frame, the mandible in the closed bite."""

    pairs: tuple[Pair, ...]  # solids: both dental arches, or skull and condyle for the left and the right joint
    # penetration depth of each pair in the closed bite [mm], shape (P,); negative for gaps, down to
    # -`collision.FARTHEST_MM`
    closed: Array
    zero: Array  # depth of each pair at which its clearance is 0 [mm], shape (P,)
    T_anatomical_skull: Array  # skull to anatomical coordinates, shape (4, 4)
    T_rest: Array  # T_skull_mandible of the closed bite, shape (4, 4)

    @property
    def closed_mm(self) -> float:
        """Penetration depth of the deepest pair in the closed bite [mm]; negative for a gap."""
        return float(self.closed.max())

    def moved(self, T_skull_mandible: Array) -> Array:
        """Return the motions (..., 4, 4) of the lower solids from the closed bite to poses (..., 4, 4)."""
        A = self.T_anatomical_skull
        return np.asarray(A @ T_skull_mandible @ se3_inverse(A @ self.T_rest))

    def clearances(self, T_skull_mandible: Array) -> Array:
        """Return the smallest clearance of the pairs [mm], shape (n,), in poses (n, 4, 4): zero minus depth."""
        T = self.moved(T_skull_mandible)
        return np.min([zero - pair.depth(T) for pair, zero in zip(self.pairs, self.zero)], axis=0)


class Teeth(Surfaces):
    """Both dental arches; clearances are relative to the depth in the closed bite."""

    @property
    def pair(self) -> Pair:
        """Upper and lower arch."""
        return self.pairs[0]


def find_teeth(upper: Mesh, lower: Mesh, T_anatomical_skull: Array, T_rest: Array) -> Teeth:
    """Return both dental arches as solids; the upper scan is in the skull frame, the lower in the mandible frame [mm].

    Raises:
        NoContact: A scan is too coarse or inconsistently wound, or the arches are too far apart or overlap too much.
    """
    placed = (("upper", upper, T_anatomical_skull, 1.0), ("lower", lower, T_anatomical_skull @ T_rest, -1.0))
    with ThreadPoolExecutor(len(placed)) as pool:  # threads, since most of the work releases the GIL
        pair = Pair(*pool.map(lambda row: _solid(*row), placed))
    closed = float(pair.depth(np.eye(4)[None])[0])
    if closed < -_WIDEST_GAP_MM:
        raise NoContact(f"in occlusion, the arches are more than {_WIDEST_GAP_MM:g} mm apart")
    if closed > _DEEPEST_MM:
        raise NoContact(
            f"in occlusion, the teeth penetrate each other by {closed:.1f} mm; at most {_DEEPEST_MM:g} mm is allowed"
        )
    depths = np.array([closed])
    return Teeth((pair,), depths, depths, T_anatomical_skull, T_rest)


def _solid(name: str, mesh: Mesh, T: Array, up: float) -> Solid:
    faces = mesh.faces if mesh.labels is None else mesh.faces[(mesh.labels[mesh.faces] != BASE).all(axis=1)]
    corners = transform_points(T, mesh.vertices)[faces]
    if not len(corners) or (edge := _median_edge(corners)) > _COARSEST_MM:
        raise NoContact(f"the {name} scan is too coarse: its edges measure {edge if len(corners) else 0:.1f} mm")
    return _wound_solid(f"{name} scan", corners, up, tips_box(corners, up, _CROWN_MM))


def _median_edge(corners: Array) -> float:
    return float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))


def _wound_solid(name: str, corners: Array, up: float, box: Array, step_mm: float = STEP_MM) -> Solid:
    """Return the solid of triangles of either winding; raises NoContact, naming the mesh, if it is inconsistent."""
    found = solid(corners, up, box, step_mm)
    if found.entering < 0.5:  # flip a mesh that is inside out
        found = solid(np.ascontiguousarray(corners[:, ::-1]), up, box, step_mm)
    if found.entering < _LEAST_WOUND:
        raise NoContact(f"the triangles of the {name} are not consistently wound")
    return found


def find_joints(skull: Mesh, mandible: Mesh, landmarks: Array, T_anatomical_skull: Array, T_rest: Array) -> Surfaces:
    """Return both jaw joints as solids, given both bones and `geometry.LANDMARKS` (5, 3) in their own frames [mm].

    Raises:
        NoContact: Bone is missing at the condyles or around them, a mesh is too coarse, or a condyle is too far from
            the skull or penetrates it too deeply.
    """
    closed_bite = T_anatomical_skull @ T_rest
    above = transform_points(T_anatomical_skull, skull.vertices)[skull.faces]
    below = transform_points(closed_bite, mandible.vertices)[mandible.faces]
    heads = transform_points(closed_bite, landmarks[_CONDYLES])
    left, right = (_joint(above, below, head) for head in heads)
    closed = np.array([float(pair.depth(np.eye(4)[None])[0]) for pair in (left, right)])
    for pair, depth in zip((left, right), closed):
        if depth <= -FARTHEST_MM:
            gap, _ = cKDTree(pair.upper.samples.points).query(pair.lower.samples.points)
            if gap.min() > _FARTHEST_CONDYLE_MM:
                raise NoContact(
                    f"a condyle is {gap.min():.1f} mm from the skull; at most {_FARTHEST_CONDYLE_MM:g} mm is allowed"
                )
    if closed.max() > _DEEPEST_MM:
        raise NoContact(
            f"in occlusion, a condyle penetrates the skull by {closed.max():.1f} mm; at most "
            f"{_DEEPEST_MM:g} mm is allowed"
        )
    return Surfaces((left, right), closed, np.maximum(closed, 0.0), T_anatomical_skull, T_rest)


def _joint(above: Array, below: Array, head: Array) -> Pair:
    condyle = np.array([head - _CONDYLE_MM, head + _CONDYLE_MM])
    fossa = np.array([head - _REACH_MM, head + _REACH_MM])
    _check_fine("mandible", below, condyle)
    _check_fine("skull", above, fossa)
    upper = _wound_solid("skull", above, 1.0, fossa, _BONE_GRID_MM)
    return Pair(upper, _wound_solid("mandible", below, -1.0, condyle, _BONE_GRID_MM))


def _check_fine(name: str, corners: Array, box: Array) -> None:
    """Raise NoContact if a bone is missing or too coarse in a box (2, 3) [mm]."""
    part = corners[((corners >= box[0]) & (corners <= box[1])).all(axis=2).any(axis=1)]
    if len(part) < _FEWEST_FACES:
        raise NoContact(f"the mesh of the {name} has no bone at the condyles")
    edge = _median_edge(part)
    if edge > _COARSEST_BONE_MM:
        raise NoContact(f"the mesh of the {name} is too coarse at the condyles: its edges measure {edge:.1f} mm")


def sample_field(
    surfaces: Surfaces, rig: JawRig, step_mm: float = _STEP_MM, most_opening_mm: float = _MOST_OPENING_MM
) -> ContactField:
    """Sample the clearance on a grid of poses over a rig's bound, with a finer step where surfaces are close.

    Args:
        step_mm: Grid step where surfaces are close; elsewhere, the step is twice as large.
        most_opening_mm: Largest sampled opening; smaller if the surfaces separate earlier.
    """
    box = _box(surfaces, rig, step_mm, most_opening_mm)
    field = _sampled(surfaces, rig, box, step_mm, _sampled(surfaces, rig, box, 2.0 * step_mm))
    captured = rig.captured_d
    least = float(np.quantile(field.clearance(captured).clearance_mm, _CAPTURED_QUANTILE)) if len(captured) else 0.0
    limit = -float(np.clip(-least, AUTHORED_MM, _LARGEST_LIMIT_MM))
    return replace(field, error_mm=_error(surfaces, rig, field), limit_mm=limit)


def _sampled(
    surfaces: Surfaces, rig: JawRig, box: Array, step_mm: float, coarse: ContactField | None = None
) -> ContactField:
    """Sample the clearance over a box (3, 2) [mm]; given coarse samples, only where their clearances are small.

    Every axis has a grid point at 0, so that the clearance is exact in the closed bite.
    """
    ends = [(np.floor(low / step_mm), np.ceil(high / step_mm)) for low, high in box]
    axes = [step_mm * np.arange(first, last + 1) for first, last in ends]
    d = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    wanted = rig.margin(d) > -(_BEYOND_MM + step_mm)
    values = np.zeros(d.shape[:3])
    if coarse is not None:
        values = coarse.clearance(d.reshape(-1, 3)).clearance_mm.reshape(values.shape)
        wanted &= values < _CLOSE_MM
    values[wanted] = surfaces.clearances(rig.pose(d[wanted]))
    if coarse is None:
        nearest = distance_transform_edt(~wanted, return_distances=False, return_indices=True)
        values = values[tuple(nearest)]
    first = np.array([axis[0] for axis in axes])
    values = np.round(values / UNIT_MM) * UNIT_MM
    return ContactField(first, np.full(3, step_mm), values, surfaces.closed_mm, 0.0, -AUTHORED_MM)


def _box(surfaces: Surfaces, rig: JawRig, step_mm: float, most_opening_mm: float) -> Array:
    """Return the parameter range (3, 2) [mm] to sample: the part of the rig's bound where surfaces are close."""
    wide = rig.d_range + np.array([-_BEYOND_MM, _BEYOND_MM])
    wide[0, 1] = min(wide[0, 1], most_opening_mm)
    axes = [np.linspace(low, high, n) for (low, high), n in zip(wide, (33, 9, 7))]
    d = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    clearances = np.full(d.shape[:3], np.inf)
    valid = rig.margin(d) > -_BEYOND_MM
    clearances[valid] = surfaces.clearances(rig.pose(d[valid])) - max(surfaces.closed_mm, 0.0)
    close = np.flatnonzero((clearances < _FREE_MM).any(axis=(1, 2)))
    top = axes[0][min(close.max(initial=0) + 1, len(axes[0]) - 1)]
    wide[0, 1] = max(top, wide[0, 0] + 2 * step_mm)
    return wide


def _error(surfaces: Surfaces, rig: JawRig, field: ContactField) -> float:
    """Return the largest error [mm] of interpolated clearances at random valid parameters with close surfaces."""
    rng = np.random.default_rng(0)
    low = field.first_mm
    d = rng.uniform(low, low + field.step_mm * (np.array(field.values.shape) - 1), (_ERROR_SAMPLES, 3))
    d = d[rig.margin(d) >= 0]
    read = field.clearance(d).clearance_mm
    d, read = d[read < NEAR_MM], read[read < NEAR_MM]
    if not len(d):
        return 0.0
    return float(np.abs(np.minimum(surfaces.clearances(rig.pose(d)), FARTHEST_MM) - read).max())


@dataclass(frozen=True, eq=False)
class _Arch:
    """The occlusal side of an arch as a height map."""

    points: Array  # surface points in the coordinate frame of the solid [mm], shape (n, 3)
    pixels: NDArray[np.int64]  # row and column of each point in the image, shape (n, 2)
    shade: Array  # brightness of each point, shape (n,)
    size: tuple[int, int]  # number of rows and columns of the image


class ContactMap:
    """Images of a subject's tooth contacts in any pose, like marks of articulating paper."""

    def __init__(self, teeth: Teeth) -> None:
        self._teeth = teeth
        self._arches = _arch(teeth.pair.upper, 1.0), _arch(teeth.pair.lower, -1.0)

    def draw(self, T_skull_mandible: Array) -> Picture:
        """Draw both arches side by side, front teeth at the top, subject's left on the right; return RGB (h, w, 3)."""
        pair, T = self._teeth.pair, self._teeth.moved(T_skull_mandible)
        upper, lower = self._arches
        sides = (
            self._picture(upper, distances(pair.lower.grid, transform_points(se3_inverse(T), upper.points))),
            self._picture(lower, distances(pair.upper.grid, transform_points(T, lower.points))),
        )
        height = max(len(side) for side in sides)
        padded = [np.pad(s, ((0, height - len(s)), (4, 4), (0, 0)), constant_values=_PAPER) for s in sides]
        return np.concatenate(padded, axis=1).repeat(2, axis=0).repeat(2, axis=1)

    def _picture(self, arch: _Arch, apart: Array) -> Picture:
        colors = arch.shade[:, None] * _ENAMEL
        closed = max(self._teeth.closed_mm, 0.0)
        # If the scans have a gap in the closed bite, that gap counts as contact.
        apart = apart + min(self._teeth.closed_mm, 0.0)
        for mark in reversed(TOUCHING):
            colors[apart < mark.apart_mm] = mark.color
        colors[apart < DEEP.apart_mm - closed] = DEEP.color
        out = np.full((*arch.size, 3), _PAPER, np.uint8)
        out[arch.pixels[:, 0], arch.pixels[:, 1]] = np.clip(colors, 0, 255).astype(np.uint8)
        return out


def _arch(solid: Solid, up: float) -> _Arch:
    """Return the points at which vertical lines from the opposing jaw first meet a solid."""
    grid = solid.grid
    values = grid.values if up > 0 else grid.values[:, ::-1]
    inside = values < 0
    layer = inside.argmax(axis=1)
    i, k = np.nonzero(inside.any(axis=1) & (layer > 0))
    j = layer[i, k]
    before, after = values[i, j - 1, k].astype(float), values[i, j, k].astype(float)
    place = j - after / (after - before)  # interpolated position of the surface, in units of grid layers
    row = place if up > 0 else values.shape[1] - 1 - place
    height = np.full(values.shape[::2], np.nan)
    height[i, k] = place * grid.step_mm
    near = height[i, k] < np.nanmin(height) + _FLOOR_MM
    points = grid.origin + grid.step_mm * np.stack([i, row, k], axis=1)
    pixels = np.stack([values.shape[2] - 1 - k, i], axis=1)
    return _Arch(
        points[near], pixels[near], _shade(height, grid.step_mm)[i, k][near], (values.shape[2], values.shape[0])
    )


def _shade(height: Array, step_mm: float) -> Array:
    """Return the brightness (nx, nz) of a height map (nx, nz) [mm] that is lit from behind."""
    known: Mask = np.isfinite(height)
    filled = np.where(known, height, np.nanmax(height))
    x, z = np.gradient(filled, step_mm)
    normal = np.stack([x, np.ones_like(x), z], axis=-1) / np.sqrt(1.0 + x**2 + z**2)[..., None]
    return np.asarray(0.3 + 0.75 * np.clip(normal @ _LIGHT, 0.0, 1.0))
