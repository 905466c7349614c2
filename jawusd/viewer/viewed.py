"""What the viewer shows, an actor or a capture, with the functions that read and write its files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from jawusd.evaluator import JawRig
from jawusd.formats.capture import Bootstrap
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import Tracks
from jawusd.geometry import Camera
from jawusd.geometry.arrays import Array, Mask
from jawusd.viewer.motion import Clip

#: Names of meshes: the first three stand still (skull frame), the others move (mandible frame).
STILL, MOVING = ("skull", "upper_teeth", "upper_gum"), ("mandible", "lower_teeth", "lower_gum")

Look = Literal["outlines", "tinted", "footage"]
#: Left, top, right, bottom of a part of a picture [px].
Region = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class ViewedActor:
    """Hold an actor to be viewed.

    Attributes:
        meshes: by the names of `STILL` and `MOVING` [mm], already decimated for a screen; any may be missing.
        placeholders: names of meshes that only stand in for anatomy.
        fps: frames per second of new animations.
        folder: of the rig; animations are written there.
        clip_names: lists the motions available now: the captured take and the animation layers beside the rig.
        load_clip: reads one of them; raises a JawusdError.
        save_layer: writes an animation layer (file name, clip, overwrite) beside the rig and returns its path; raises a
            JawusdError.
    """

    name: str
    rig: JawRig
    meshes: Mapping[str, Mesh]
    placeholders: frozenset[str]
    fps: float
    folder: Path
    clip_names: Callable[[], tuple[str, ...]]
    load_clip: Callable[[str], Clip]
    save_layer: Callable[[str, Clip, bool], Path]


@dataclass(frozen=True, eq=False)
class ViewedCapture:
    """Hold a capture to be viewed.

    Attributes:
        frames: first and last frame to step through, of the reference camera, both inclusive.
        offsets: frame k of a camera shows the instant of frame k + offset of the reference camera.
        sizes_px: (width, height) of the pictures by camera, for every camera with footage, in the capture's order.
        cameras: calibrated cameras by name; empty without a calibration.
        scans: the teeth by arch, "upper" and "lower" [mm], vertices as in their files.
        crowns: which faces of a scan are teeth, shape (F,); the others are gum.
        T_anatomical_skull: scan frame to anatomical frame, shape (4, 4).
        tracks: tracked poses; None without.
        picks: of the capture file; None without.
        picture: (camera, frame of the reference camera, T_world_upper and T_world_lower or None, look) to RGB
            (h, w, 3) uint8, gray where the camera has no picture; raises a JawusdError.
        teeth_region: (camera, frame) to the region of the teeth in its masks, None without masks.
        poses_of_picks: poses that agree with picks, T_world_upper and T_world_lower (4, 4), and the names of the picks
            that do not fit; raises a JawusdError.
        save_picks: writes picks to the capture file, given those read from it before; raises a JawusdError.
    """

    name: str
    fps: float
    frames: tuple[int, int]
    offsets: Mapping[str, int]
    sizes_px: Mapping[str, tuple[int, int]]
    cameras: Mapping[str, Camera]
    scans: Mapping[str, Mesh]
    crowns: Mapping[str, Mask]
    T_anatomical_skull: Array
    tracks: Tracks | None
    picks: Bootstrap | None
    picture: Callable[[str, int, tuple[Array, Array] | None, Look], NDArray[np.uint8]]
    teeth_region: Callable[[str, int], Region | None]
    poses_of_picks: Callable[[Bootstrap], tuple[tuple[Array, Array], list[str]]]
    save_picks: Callable[[Bootstrap, Bootstrap | None], None]

    def tracked_poses(self, frame: int) -> tuple[Array, Array] | None:
        """Return T_world_upper and T_world_lower of a frame, NaN where lost; None where nothing was tracked."""
        tracks = self.tracks
        if tracks is None:
            return None
        index = int(np.searchsorted(tracks.frames, frame))
        if index == len(tracks.frames) or tracks.frames[index] != frame:
            return None
        return tracks.T_world_upper[index], tracks.T_world_lower[index]
