"""Settings of a take in the scene: frame rate, frame range, units, and cameras with their footage."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING

import bpy

if TYPE_CHECKING:
    from pxr import Sdf, Usd


def apply_stage_settings(stage: Usd.Stage) -> None:
    """Set frame rate, frame range and unit of length of the scene to those of a stage."""
    scene, rate = bpy.context.scene, stage.GetTimeCodesPerSecond()
    scene.render.fps = max(1, round(rate))
    scene.render.fps_base = scene.render.fps / rate
    if stage.HasAuthoredTimeCodeRange():
        scene.frame_start, scene.frame_end = int(stage.GetStartTimeCode()), int(stage.GetEndTimeCode())
        scene.frame_set(scene.frame_start)
    scene.unit_settings.system, scene.unit_settings.length_unit = "METRIC", "MILLIMETERS"


def add_plates(stage: Usd.Stage, prim_map: Mapping[Sdf.Path, list[bpy.types.ID]]) -> None:
    """Show the undistorted footage of a take as the background of its cameras, if `jawusd plates` has written it."""
    scene, first = bpy.context.scene, None
    for path, made in prim_map.items():
        prim = stage.GetPrimAtPath(path)
        pattern, size = (prim.GetAttribute(f"jaw:{name}") for name in ("plate", "imageSize"))
        cameras = [found for found in made if isinstance(found, bpy.types.Object) and found.type == "CAMERA"]
        if not pattern or not cameras:
            continue
        first = first or (cameras[0], size.Get())
        layer = pattern.GetPropertyStack()[0].layer
        _show(cameras[0].data, layer.ComputeAbsolutePath(pattern.Get()), int(stage.GetEndTimeCode()))
    if first is not None:
        scene.camera = first[0]
        scene.render.resolution_x, scene.render.resolution_y = first[1]


def _show(camera: bpy.types.Camera, pattern: str, last: int) -> None:
    folder, beginning = os.path.dirname(pattern), os.path.basename(pattern).split("%")[0]
    files = sorted(f for f in os.listdir(folder) if f.startswith(beginning)) if os.path.isdir(folder) else []
    if not files or camera.background_images:
        return
    image = bpy.data.images.load(os.path.join(folder, files[0]), check_existing=True)
    image.source = "SEQUENCE"
    background = camera.background_images.new()
    background.image, background.alpha, background.display_depth = image, 1.0, "BACK"
    # The number in a plate's file name is its USD time code, which equals the scene's frame.
    user = background.image_user
    user.frame_start, user.frame_offset, user.frame_duration = 1, 0, max(last, 1)
    camera.show_background_images = True
