"""What the viewer is given of a capture, and what it may ask of whoever reads its footage and writes its picks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from jawusd.formats.capture import Bootstrap
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import Tracks
from jawusd.geometry import Camera
from jawusd.geometry.arrays import Array, Mask

Look = Literal["outlines", "tinted", "footage"]
#: Left, top, right, bottom of a part of a picture [px].
Region = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class ViewedCapture:
    """Hold a capture to be viewed.

    Attributes:
        name: of the capture.
        fps: frames per second.
        frames: first and last frame to step through, of the reference camera, both inclusive.
        offsets: frame k of a camera shows the instant of frame k + offset of the reference camera.
        sizes_px: (width, height) of the pictures by camera, for every camera with footage, in the capture's order.
        cameras: calibrated cameras by name; empty without a calibration.
        scans: the teeth by row, "upper" and "lower" [mm], vertices as in their files.
        crowns: which faces of a scan are teeth, shape (F,); the others are gum.
        T_anatomical_skull: scan frame to anatomical frame, shape (4, 4).
        tracks: tracked poses; None without.
        picks: of the capture file; None without.
        picture: (camera, frame of the reference camera, T_world_upper and T_world_lower or None, look) to RGB
            (h, w, 3) uint8, gray where the camera has no picture; raises a JawusdError.
        teeth_region: (camera, frame) to where its masks see teeth, None without masks.
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
        row = int(np.searchsorted(tracks.frames, frame))
        if row == len(tracks.frames) or tracks.frames[row] != frame:
            return None
        return tracks.T_world_upper[row], tracks.T_world_lower[row]
