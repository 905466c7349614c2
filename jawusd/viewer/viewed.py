"""Inputs of the viewer: an actor or a capture, with meshes for display, and functions that read and write files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.evaluator import JawRig
from jawusd.formats.mesh import Mesh, crown_face_mask, tooth_labels

if TYPE_CHECKING:  # pages of rigs need no captures, which take a tenth of a second to import
    from jawusd.formats.capture import Bootstrap, Capture
    from jawusd.formats.tracks import Tracks
    from jawusd.geometry import Camera
    from jawusd.media.overlay import Backdrop, PlacedScan
    from jawusd.media.side_by_side import CameraWall
    from jawusd.viewer.motion import Clip

#: Names of the fixed meshes (skull frame) and of the moving meshes (mandible frame).
STILL, MOVING = ("skull", "upper_teeth", "upper_gum"), ("mandible", "lower_teeth", "lower_gum")

#: What a panel calls after a change.
Callback = Callable[[], None]
#: An image, RGB (h, w, 3).
Image = NDArray[np.uint8]
#: T_world_upper and T_world_lower of a frame, shape (4, 4) each.
Poses = tuple[Array, Array]
Look = Literal["outlines", "tinted", "footage"]
#: A region of an image: left, top, right, bottom [px].
Region = tuple[float, float, float, float]
_STEPS, _NEAR = 8, 0.93  # maximum number of iterations, and fraction of the requested face count at which they stop


@dataclass(frozen=True, eq=False)
class ViewedFootage:
    """The footage of an actor's captured take."""

    cameras: tuple[str, ...]  # names of the cameras with footage or masks, in the capture's order
    frames: tuple[int, int]  # first and last frame (inclusive) of the take
    # maps (camera, frame of the reference camera) to an image cropped to the teeth, RGB (h, w, 3) uint8; any thread may
    # call it; raises a JawusdError
    picture: Callable[[str, int], Image]


@dataclass(frozen=True, eq=False)
class ViewedActor:
    """An actor to view."""

    name: str
    rig: JawRig
    # meshes [mm] by the names in `STILL` and `MOVING`, decimated for display; each is optional
    meshes: Mapping[str, Mesh]
    placeholders: frozenset[str]  # names of meshes that are placeholders, not anatomy
    fps: float  # frame rate of new animations
    folder: Path  # folder of the rig, to which animations are written
    # returns the available motions: the captured take and the animation layers beside the rig
    clip_names: Callable[[], tuple[str, ...]]
    take: str | None  # name of the captured motion, which pages play first; None without one
    load_clip: Callable[[str], Clip]  # reads a motion by name; raises a JawusdError
    # writes an animation layer (file name, clip, overwrite) beside the rig and returns its path; raises a JawusdError
    save_layer: Callable[[str, Clip, bool], Path]
    # maps d (3,) [mm] to an image of both arches with their contacts, RGB (h, w, 3); raises a JawusdError; None if the
    # rig has no occlusion
    contacts: Callable[[Array], Image] | None = None
    verdict: str = ""  # sentence on the build of the rig; "" if there is none
    footage: ViewedFootage | None = None  # None if the capture is not available


_SPECKS_PERCENT = 0.5  # percentage of mask pixels on each side that may lie far from the teeth
_FILL: dict[Look, float] = {"outlines": 0.0, "tinted": 0.3}  # opacity of the teeth


@dataclass(frozen=True, eq=False)
class ViewedCapture:
    """A capture to view; any thread may call the methods. Poses are T_world_upper and T_world_lower."""

    source: Capture  # with the calibration and the labels of the build whose poses are shown
    frames: tuple[int, int]  # first and last frame (inclusive) of the reference camera to step through
    offsets: Mapping[str, int]  # frame k of a camera is simultaneous with frame k + offset of the reference camera
    backdrops: Mapping[str, Backdrop]  # images of every camera with footage or masks, in the capture's order
    all_cameras: CameraWall  # the same images side by side
    cameras: Mapping[str, Camera]  # calibrated cameras by name; empty without a calibration
    scans: Mapping[str, Mesh]  # by arch, "upper" and "lower": vertices in the order and coordinates [mm] of the files
    T_anatomical_skull: Array  # scan frame to anatomical frame, shape (4, 4)
    tracks: Tracks | None  # tracked poses, if any
    # fits poses (4, 4) to picks, and returns them with the names of inconsistent picks; raises a JawusdError
    poses_of_picks: Callable[[Bootstrap], tuple[Poses, list[str]]]
    # writes the new picks (first argument) to the capture file if it still has the expected old picks (second
    # argument); otherwise raises a JawusdError
    save_picks: Callable[[Bootstrap, Bootstrap | None], None]
    # writes the approved labels of an arch and returns the file; raises a JawusdError
    save_labels: Callable[[str, NDArray[np.uint8]], Path]

    @cached_property
    def sizes_px(self) -> dict[str, tuple[int, int]]:
        """Return (width, height) of the images of every camera with footage or masks."""
        return {name: backdrop.size_px for name, backdrop in self.backdrops.items()}

    @cached_property
    def crowns(self) -> dict[str, Mask]:
        """Return by arch which faces of a scan are teeth, shape (F,); the others are gum."""
        return {arch: crown_face_mask(mesh) for arch, mesh in self.scans.items()}

    @cached_property
    def labels(self) -> dict[str, NDArray[np.uint8]]:
        """Return GUM, TOOTH, BOUNDARY or BASE of every vertex by arch, shape (V,)."""
        return {arch: tooth_labels(mesh) if mesh.labels is None else mesh.labels for arch, mesh in self.scans.items()}

    def picture(self, name: str, frame: int, poses: Poses | None, look: Look) -> Image:
        """Return a camera's image at a frame of the reference camera, RGB (h, w, 3), with the teeth drawn over it.

        It is gray if the camera has no image of that frame; raises a JawusdError.
        """
        from jawusd.media.overlay import EMPTY_GRAY, draw_overlay

        image = self.backdrops[name].picture(frame)
        if image is None:
            width, height = self.sizes_px[name]
            return np.full((height, width, 3), EMPTY_GRAY, np.uint8)
        placed = self._placed(frame, poses, look)
        if not placed or name not in self.cameras:
            return image
        return draw_overlay(image, self.cameras[name], placed, fill=_FILL[look])

    def wall(self, frame: int, poses: Poses | None, look: Look, partly: Callable[[Image], None] | None = None) -> Image:
        """Return all cameras' images side by side, as `picture` does; `partly` as in `CameraWall.draw`."""
        return self.all_cameras.draw(frame, self._placed(frame, poses, look), fill=_FILL.get(look, 0.0), partly=partly)

    def _placed(self, frame: int, poses: Poses | None, look: Look) -> list[PlacedScan]:
        from jawusd.media.overlay import LOWER_COLOUR, UPPER_COLOUR, PlacedScan, arch_colours

        if poses is None or look == "footage":
            return []
        row = None if self.tracks is None else self.tracks.row_of(frame)
        colours = (UPPER_COLOUR, LOWER_COLOUR) if self.tracks is None or row is None else arch_colours(self.tracks, row)
        return [PlacedScan(*scan) for scan in zip(self.scans.values(), poses, colours, strict=True)]

    def teeth_region(self, name: str, frame: int) -> Region | None:
        """Return the region covered by a camera's masks in a frame, or None."""
        from jawusd.media.masks import open_masks

        source = next(camera for camera in self.source.cameras if camera.name == name)
        if source.masks is None:
            return None
        seen = []
        for reader in open_masks(source, self.sizes_px[name]):
            with reader as masks:
                mask = masks.read(frame - self.offsets[name])
            if mask is not None:
                y, x = np.nonzero(mask > 127)
                seen.append(np.column_stack([x, y]))
        if not any(map(len, seen)):
            return None
        low, high = np.percentile(np.vstack(seen), (_SPECKS_PERCENT, 100 - _SPECKS_PERCENT), axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def tracked_poses(self, frame: int) -> Poses | None:
        """Return T_world_upper and T_world_lower of a frame, NaN where lost; None if the frame was not tracked."""
        row = None if self.tracks is None else self.tracks.row_of(frame)
        if self.tracks is None or row is None:
            return None
        return self.tracks.T_world_upper[row], self.tracks.T_world_lower[row]


def for_view(mesh: Mesh, most_faces: int) -> Mesh:
    """Return a mesh decimated to at most `most_faces` faces for display; leave smaller meshes unchanged.

    The method is vertex clustering (Rossignac and Borrel, "Multi-resolution 3D approximations for rendering complex
    scenes", 1993). The number of faces is about inversely proportional to the square of the cell size.
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
    """Return whether a mesh is closed and oriented outwards, so that no back face is visible from outside."""
    a, b, c = mesh.faces.T.astype(np.int64)
    starts, ends = np.concatenate([a, b, c]), np.concatenate([b, c, a])
    count = len(mesh.vertices)
    closed = np.isin(starts * count + ends, ends * count + starts).all()
    corners = mesh.vertices[mesh.faces]
    volume = np.linalg.det(corners - mesh.vertices.mean(axis=0)).sum()  # six times the signed volume
    return bool(closed and volume > 0)


def _clustered(mesh: Mesh, cell_mm: float) -> Mesh:
    """Return the mesh with the vertices in each grid cell replaced by their mean."""
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
    # Cyclic permutations of three vertices describe the same face; a flipped order describes its back.
    first = faces.argmin(axis=1)[:, None]
    turned = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    return Mesh(means, np.unique(turned, axis=0), colors)
