"""A teeth scan prepared for tracking: crowns with an edge table, gum as occluder, and the crown-gum line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.formats.mesh import Mesh, crown_face_mask, tooth_labels
from jawusd.geometry import transform_point
from jawusd.geometry.points import welded
from jawusd.meshes.raster import draw_depth_labels, draw_silhouette, project, words_for
from jawusd.meshes.remeshing import decimated_scan
from jawusd.meshes.scan_surface import components
from jawusd.tracking.contour.gingival_margin import crown_gum_segments

#: Vertex indices of faces, or other index tables for compiled code.
Faces = NDArray[np.int32]

ARCHES = (0, 1)
ARCH_NAMES = ("upper", "lower")
CROWN, GUM = 1, 2  # labels of a rendered scan; 0 is empty

_PROBES = 300  # number of vertices at which motion is measured: enough for means accurate to 1 %
# Number of crown faces above which all but the last steps use a decimated scan, and number of crown faces of that scan:
# run time is proportional to the number of faces, and the loss of accuracy is below 0.002 mm.
_DENSE_FACES, _THIN_FACES = 60_000, 20_000
_GUM_SHARE = 0.02  # ratio of gum to crown faces below which gum faces are remnants of removed gum
_FEWEST_CROWN_FACES = 100  # minimum number of crown faces; with fewer, some viewing directions have no contour


@dataclass(frozen=True, eq=False)
class Scan:
    """The scan of one arch, ready for projection."""

    name: str  # "upper" or "lower"
    vertices: Array  # welded vertices in scan coordinates [mm], float64, shape (V, 3)
    vertices_single: NDArray[np.float32]  # the same vertices in float32, for the rasteriser
    crown_faces: Faces  # faces whose contour is matched, int32, shape (F, 3)
    gum_faces: Faces  # faces that only occlude, int32, shape (G, 3)
    planes: Array  # normal and offset (n, n.p) of every crown face, shape (F, 4); only signs of n.x - offset are used
    edges: Faces  # edges: two vertices, face, and other face (-1 at a border), int32, shape (E, 4)
    gingival_margin: Array  # segments of the crown-gum line that are not mesh edges [mm], shape (S, 2, 3)
    margin_directions: Array  # unit vectors on the crown surface across these segments, shape (S, 3)
    probes: Array  # vertices spread over the crowns, at which motion is measured [mm], shape (N <= 300, 3)
    centre: Array  # centroid of the crown vertices [mm], shape (3,)
    radius_mm: float  # maximum distance of a crown vertex from `centre` [mm]
    # whether labels or paint separate crown from gum (back faces of separated crowns are culled); otherwise the whole
    # scan counts as crown
    painted: bool
    # the same arch with fewer faces, for all but the last steps; None if this scan has few enough
    thin: Scan | None = None

    @property
    def shows_gum(self) -> bool:
        """Whether the scan contains gum around the crowns."""
        return len(self.gum_faces) > _GUM_SHARE * len(self.crown_faces)

    def crown_vertices(self, limit: int | None = None) -> Array:
        """Return the vertices of the crowns [mm], all or about `limit` of them, shape (N, 3)."""
        points = self.vertices[np.unique(self.crown_faces)]
        return points if limit is None else points[:: max(1, len(points) // limit)]

    def silhouette(self, matrix: Array, shape: tuple[int, int], left: int = 0, top: int = 0) -> NDArray[np.uint64]:
        """Return the pixels covered by the crowns in an image of size (h, w), as packed bits.

        `matrix` is the projection from scan coordinates [mm] to homogeneous px, shape (3, 4); `left` and `top` are the
        pixel coordinates of the image's first column and row.
        """
        bits = np.zeros((shape[0], words_for(shape[1])), np.uint64)
        draw_silhouette(self._projected(matrix), self.crown_faces, left, top, shape[1], self.painted, bits)
        return bits

    def draw(self, matrix: Array, depth: NDArray[np.float32], labels: NDArray[np.uint8]) -> None:
        """Render inverse depth [1/mm] and labels into zeroed images (h, w); `matrix` is as for `silhouette`."""
        points = self._projected(matrix)
        draw_depth_labels(points, self.crown_faces, 0, 0, self.painted, depth, labels, CROWN)
        draw_depth_labels(points, self.gum_faces, 0, 0, False, depth, labels, GUM)

    def _projected(self, matrix: Array) -> NDArray[np.float32]:
        points = np.empty((len(self.vertices), 3), np.float32)
        project(self.vertices_single, matrix.astype(np.float32), points)
        return points


def probe_points(scans: Sequence[Scan]) -> Array:
    """Return twelve points spread over each arch, in scan coordinates [mm], shape (2, 12, 3)."""
    return np.stack([scan.probes[np.linspace(0, len(scan.probes) - 1, 12).astype(int)] for scan in scans])


def teeth_centre(scans: Sequence[Scan], poses: Array) -> Array:
    """Return the centre of both arches in world coordinates [mm], shape (3,), at poses T_world_scan (2, 4, 4)."""
    return np.mean([transform_point(pose, scan.centre) for pose, scan in zip(poses, scans, strict=True)], axis=0)


def prepare_scan(mesh: Mesh, name: str) -> Scan:
    """Split a teeth scan into crowns and gum and build the tables of the contour search.

    Without labels and paint (see `formats.mesh.tooth_labels`), the whole scan counts as crown. `name` is "upper" or
    "lower", for messages.

    Raises:
        TrackingError: the scan has too few faces to be tracked.
    """
    # In a triangle soup, every edge would be a border, so coincident vertices are merged.
    vertices, index = welded(np.asarray(mesh.vertices, np.float64))
    faces = np.ascontiguousarray(index[np.asarray(mesh.faces, np.int32)], np.int32)
    painted = not (tooth_labels(mesh) > 0).all()
    crown = crown_face_mask(mesh)
    solid = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    crown_faces = np.ascontiguousarray(faces[crown & solid])
    if painted:
        crown_faces = _wound_outwards(vertices, crown_faces)
    gum_faces = np.ascontiguousarray(faces[~crown & solid])
    if len(crown_faces) < _FEWEST_CROWN_FACES:
        raise TrackingError(
            f"the {name} teeth scan has {len(crown_faces)} tooth faces; at least {_FEWEST_CROWN_FACES} are needed",
            hint="Check the scan file, and the faces that `jawusd scans` labels as crown.",
        )
    scan = _with_tables(name, vertices, crown_faces, gum_faces, painted)
    if len(crown_faces) <= _DENSE_FACES:
        return scan
    return replace(scan, thin=thinned(scan, _THIN_FACES))


def thinned(scan: Scan, crown_faces: int) -> Scan:
    """Return the arch decimated to about `crown_faces` crown faces; unchanged if it has no more than that."""
    if len(scan.crown_faces) <= crown_faces:
        return scan
    parts = decimated_scan(scan.vertices, scan.crown_faces, scan.gum_faces, crown_faces)
    thin = _with_tables(scan.name, *parts, scan.painted)
    # Twists are about the centre, so the decimated scan must have the same centre.
    return replace(thin, probes=scan.probes, centre=scan.centre, radius_mm=scan.radius_mm)


def mirrored(scan: Scan, point: Array, normal: Array) -> Scan:
    """Return the mirror image of an arch in the plane through a point [mm] with a unit normal, both (3,)."""
    vertices = scan.vertices - 2.0 * np.outer((scan.vertices - point) @ normal, normal)
    crown, gum = (np.ascontiguousarray(faces[:, ::-1]) for faces in (scan.crown_faces, scan.gum_faces))
    return _with_tables(scan.name, vertices, crown, gum, scan.painted)


def _with_tables(name: str, vertices: Array, crown_faces: Faces, gum_faces: Faces, painted: bool) -> Scan:
    """Return the scan with the tables of the contour search."""
    corner = vertices[crown_faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    crowns = vertices[np.unique(crown_faces)]
    centre = crowns.mean(0)
    margin, directions = crown_gum_segments(vertices, crown_faces, gum_faces)
    return Scan(
        name=name,
        vertices=vertices,
        vertices_single=vertices.astype(np.float32),
        crown_faces=crown_faces,
        gum_faces=gum_faces,
        planes=np.column_stack([normal, np.einsum("ij,ij->i", normal, corner[:, 0])]),
        edges=_edge_table(crown_faces),
        gingival_margin=margin,
        margin_directions=directions,
        probes=crowns[np.linspace(0, len(crowns) - 1, min(len(crowns), _PROBES)).astype(int)],
        centre=centre,
        radius_mm=float(np.linalg.norm(corner.reshape(-1, 3) - centre, axis=1).max()),
        painted=painted,
    )


def _wound_outwards(vertices: Array, faces: Faces) -> Faces:
    """Return the faces, with connected components of negative volume, about their own centres, flipped."""
    piece = components(faces, len(vertices))[faces[:, 0]]
    corners = vertices[faces]
    count = np.bincount(piece)
    middle = corners.mean(1)
    centre = np.stack([np.bincount(piece, middle[:, k]) / np.maximum(count, 1) for k in range(3)], axis=1)
    corners = corners - centre[piece][:, None]
    six_volumes = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    inside_out = np.bincount(piece, six_volumes)[piece] < 0
    return np.ascontiguousarray(np.where(inside_out[:, None], faces[:, ::-1], faces), np.int32)


def _edge_table(faces: Faces) -> Faces:
    """Return two vertices, face, and other face (-1 at a border) of every edge, one per pair of faces, shape (E, 4)."""
    pairs = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(faces), dtype=np.int32), 3)
    order = np.lexsort((owner, pairs[:, 1], pairs[:, 0]))
    pairs, owner = pairs[order], owner[order]
    new = np.r_[True, (pairs[1:] != pairs[:-1]).any(1)]
    rank = np.arange(len(pairs)) - np.flatnonzero(new)[np.cumsum(new) - 1]
    first = rank % 2 == 0
    has_second = np.r_[~first[1:], False]
    second = np.where(has_second, np.r_[owner[1:], -1], -1)
    return np.ascontiguousarray(np.column_stack([pairs, owner, second])[first], np.int32)
