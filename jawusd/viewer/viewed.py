"""What the viewer shows: an actor or a capture, its file functions, and meshes reduced for a screen."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.evaluator import JawRig
from jawusd.formats.capture import Bootstrap
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import Tracks
from jawusd.geometry import Camera
from jawusd.viewer.motion import Clip

#: Names of meshes: the first three stand still (skull frame), the others move (mandible frame).
STILL, MOVING = ("skull", "upper_teeth", "upper_gum"), ("mandible", "lower_teeth", "lower_gum")

Look = Literal["outlines", "tinted", "footage"]
#: Left, top, right, bottom of a part of a picture [px].
Region = tuple[float, float, float, float]
_STEPS, _NEAR = 8, 0.93  # share of the wanted number of faces that ends the search


@dataclass(frozen=True, eq=False)
class ViewedActor:
    """Hold an actor to be viewed."""

    name: str
    rig: JawRig
    # by the names of `STILL` and `MOVING` [mm], already decimated for a screen; any may be missing
    meshes: Mapping[str, Mesh]
    placeholders: frozenset[str]  # names of meshes that only stand in for anatomy
    fps: float  # frames per second of new animations
    folder: Path  # of the rig; animations are written there
    # lists the motions available now: the captured take and the animation layers beside the rig
    clip_names: Callable[[], tuple[str, ...]]
    load_clip: Callable[[str], Clip]  # reads one of them; raises a JawusdError
    # writes an animation layer (file name, clip, overwrite) beside the rig and returns its path; raises a JawusdError
    save_layer: Callable[[str, Clip, bool], Path]
    # d (3,) [mm] to a picture of both arches with their contacts, RGB (h, w, 3); raises a JawusdError; None where the
    # rig does not know how the teeth meet
    contacts: Callable[[Array], NDArray[np.uint8]] | None = None


@dataclass(frozen=True, eq=False)
class ViewedCapture:
    """Hold a capture to be viewed."""

    name: str
    fps: float
    frames: tuple[int, int]  # first and last frame to step through, of the reference camera, both inclusive
    offsets: Mapping[str, int]  # frame k of a camera shows the instant of frame k + offset of the reference camera
    # (width, height) of the pictures by camera, for every camera with footage, in the capture's order
    sizes_px: Mapping[str, tuple[int, int]]
    cameras: Mapping[str, Camera]  # calibrated cameras by name; empty without a calibration
    scans: Mapping[str, Mesh]  # the teeth by arch, "upper" and "lower" [mm], vertices as in their files
    crowns: Mapping[str, Mask]  # which faces of a scan are teeth, shape (F,); the others are gum
    labels: Mapping[str, NDArray[np.uint8]]  # GUM, TOOTH, BOUNDARY or BASE per vertex of a scan, shape (V,), by arch
    T_anatomical_skull: Array  # scan frame to anatomical frame, shape (4, 4)
    tracks: Tracks | None  # tracked poses; None without
    picks: Bootstrap | None  # of the capture file; None without
    # (camera, frame of the reference camera, T_world_upper and T_world_lower or None, look) to RGB (h, w, 3) uint8,
    # gray where the camera has no picture; raises a JawusdError
    picture: Callable[[str, int, tuple[Array, Array] | None, Look], NDArray[np.uint8]]
    # the same without a camera: all of them side by side, in pictures of the size `wall_px`; the function given last is
    # called with the picture so far while cameras are being decoded
    wall: Callable[
        [int, tuple[Array, Array] | None, Look, Callable[[NDArray[np.uint8]], None] | None], NDArray[np.uint8]
    ]
    wall_px: tuple[int, int]
    # (camera, frame) to the region of the teeth in its masks, None without masks
    teeth_region: Callable[[str, int], Region | None]
    # poses that agree with picks, T_world_upper and T_world_lower (4, 4), and the names of the picks that do not fit;
    # raises a JawusdError
    poses_of_picks: Callable[[Bootstrap], tuple[tuple[Array, Array], list[str]]]
    # writes picks to the capture file, given those read from it before; raises a JawusdError
    save_picks: Callable[[Bootstrap, Bootstrap | None], None]
    # writes the labels of an arch that a person has seen, and returns the file; raises a JawusdError
    save_labels: Callable[[str, NDArray[np.uint8]], Path]

    def tracked_poses(self, frame: int) -> tuple[Array, Array] | None:
        """Return T_world_upper and T_world_lower of a frame, NaN where lost; None where nothing was tracked."""
        row = None if self.tracks is None else self.tracks.row_of(frame)
        if self.tracks is None or row is None:
            return None
        return self.tracks.T_world_upper[row], self.tracks.T_world_lower[row]


def for_view(mesh: Mesh, most_faces: int) -> Mesh:
    """Return a mesh decimated to at most `most_faces` faces for display; the mesh itself when it has no more.

    Vertex clustering (Rossignac and Borrel, "Multi-resolution 3D approximations for rendering complex scenes", 1993).
    The number of faces goes with the inverse square of the grid's cell, which gives every next cell.
    """
    if len(mesh.faces) <= most_faces:
        return mesh
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    fine, coarse, cell, best = 0.0, extent, np.sqrt(2.0 * area / most_faces), None
    for _ in range(_STEPS):
        if not fine < cell < coarse:
            cell = 0.5 * (fine + coarse)
        clustered = _clustered(mesh, cell)
        count = len(clustered.faces)
        if count > most_faces:
            fine = cell
        else:
            coarse, best = cell, clustered
            if count > _NEAR * most_faces:
                break
        cell *= np.sqrt(count / (0.97 * most_faces))
    return best if best is not None and len(best.faces) else mesh


def is_solid(mesh: Mesh) -> bool:
    """Return whether a mesh is closed with its faces outwards, so that no back face is visible from outside."""
    a, b, c = mesh.faces.T.astype(np.int64)
    starts, ends = np.concatenate([a, b, c]), np.concatenate([b, c, a])
    count = len(mesh.vertices)
    closed = np.isin(starts * count + ends, ends * count + starts).all()
    corners = mesh.vertices[mesh.faces]
    volume = np.linalg.det(corners - mesh.vertices.mean(axis=0)).sum()  # six times
    return bool(closed and volume > 0)


def _clustered(mesh: Mesh, cell_mm: float) -> Mesh:
    """Return the mesh with one vertex, the mean, per occupied cell."""
    cells = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / cell_mm).astype(np.int64)
    sizes = cells.max(axis=0) + 1
    flat = (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]
    _, owner, count = np.unique(flat, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(owner, column) / count for column in mesh.vertices.T], axis=1)
    colors = None
    if mesh.colors is not None:
        sums = [np.bincount(owner, column) / count for column in mesh.colors.T.astype(float)]
        colors = np.stack(sums, axis=1).round().astype(np.uint8)
    faces = owner[mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    # Cyclic permutations of three vertices are the same face; flipped ones are its other side.
    first = faces.argmin(axis=1)[:, None]
    turned = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    return Mesh(means, np.unique(turned, axis=0), colors)
