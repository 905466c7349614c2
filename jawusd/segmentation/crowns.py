"""Where crowns, and what hides them, project to according to the scans."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.formats.mesh import Mesh, crown_face_mask
from jawusd.geometry import Camera, transform_points
from jawusd.meshes.raster import draw_depth_labels

OTHER, UPPER, LOWER = 0, 1, 2


@dataclass(frozen=True, eq=False)
class ScanSurface:
    """Hold one arch ready to be drawn."""

    vertices: Array  # scan coordinates [mm], shape (V, 3)
    crown_faces: NDArray[np.int32]  # faces of the teeth, int32, shape (F, 3)
    gum_faces: NDArray[np.int32]  # faces that only hide what lies behind them, int32, shape (G, 3)

    @classmethod
    def of(cls, mesh: Mesh) -> ScanSurface:
        """Split a teeth scan at the line where most corners of a face are tooth."""
        crown = crown_face_mask(mesh)
        return cls(mesh.vertices, mesh.faces[crown], mesh.faces[~crown])

    def crown_points(self) -> Array:
        """Return the vertices of the crowns [mm], shape (N, 3)."""
        return self.vertices[np.unique(self.crown_faces)]


@dataclass(frozen=True, eq=False)
class Expectation:
    """Hold what is expected where in a picture; px are pixels of that picture."""

    labels: NDArray[np.uint8]  # OTHER, UPPER or LOWER where that arch's crowns are nearest, shape (h, w)
    # signed distance to the outline of each arch's visible crowns, positive inside, shape (2, h, w)
    inside_px: NDArray[np.float32]


def expect_crowns(scans: tuple[ScanSurface, ScanSurface], poses: Array, camera: Camera) -> Expectation:
    """Draw both arches in poses (2, 4, 4), T_world_upper and T_world_lower, as a pinhole camera sees them."""
    labels = draw_crowns(scans, poses, camera)
    return Expectation(labels, np.stack([_signed_distance(labels == label) for label in (UPPER, LOWER)]))


def draw_crowns(scans: tuple[ScanSurface, ScanSurface], poses: Array, camera: Camera) -> NDArray[np.uint8]:
    """Return OTHER, UPPER or LOWER where that arch's crowns are nearest, shape (h, w)."""
    width, height = camera.size_px
    inverse_depth, labels = np.zeros((height, width), np.float32), np.zeros((height, width), np.uint8)
    for scan, pose, label in zip(scans, poses, (UPPER, LOWER), strict=True):
        world = transform_points(pose, scan.vertices)
        points = np.column_stack([camera.project_pinhole(world), camera.depth(world)]).astype(np.float32)
        draw_depth_labels(points, scan.gum_faces, 0, 0, False, inverse_depth, labels, OTHER)
        draw_depth_labels(points, scan.crown_faces, 0, 0, False, inverse_depth, labels, label)
    return labels


def _signed_distance(region: Mask) -> NDArray[np.float32]:
    """Return the distance to the outline of a region, positive inside [px]; far outside where there is none."""
    if not region.any():
        return np.full(region.shape, -1e3, np.float32)
    inner = cv2.distanceTransform(region.astype(np.uint8), cv2.DIST_L2, 5)
    outer = cv2.distanceTransform((~region).astype(np.uint8), cv2.DIST_L2, 5)
    return np.where(region, inner - 0.5, 0.5 - outer)
