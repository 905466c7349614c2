"""What the viewer shows, an actor or a capture, with the functions that read and write its files."""

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
