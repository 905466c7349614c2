"""What the viewer is given of an actor, and what it may ask of whoever reads and writes its files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from jawusd.evaluator import JawRig
from jawusd.formats.mesh import Mesh
from jawusd.viewer.clip import Clip

#: The meshes a viewer knows; the first three stand still (skull frame), the others move (mandible frame).
STILL, MOVING = ("skull", "upper_teeth", "upper_gum"), ("mandible", "lower_teeth", "lower_gum")


@dataclass(frozen=True, eq=False)
class ViewedActor:
    """Hold an actor to be viewed.

    Attributes:
        name: of the actor.
        rig: its evaluator.
        meshes: by the names of `STILL` and `MOVING` [mm], already coarse enough for a screen; any may be missing.
        placeholders: names of meshes that only stand in for anatomy.
        fps: frames per second of new animations.
        folder: where it lies; animations are written there.
        clip_names: says which motions there are now, the captured take and the animation layers beside the rig.
        load_clip: reads one of them; raises a JawusdError.
        save_layer: writes an animation layer (file name, clip, overwrite) beside the rig and says where; raises a
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
