"""Blender add-on for jaw rigs imported from USD: sliders, keys, handles, cameras, and export back to USD."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING

import bpy

from . import bake, handle, jaw, panel, vendored

if TYPE_CHECKING:
    from pxr import Sdf, Usd


class JawUsdHook(bpy.types.USDHook):
    """Hook that links the rigs of an imported stage."""

    bl_idname = "jawusd_hook"
    bl_label = "jawusd jaw rigs"

    @staticmethod
    def on_import(context: bpy.types.Context) -> bool:
        """Link every rig and camera of the stage; Blender calls this at the end of an import."""
        stage, prim_map = context.get_stage(), context.get_prim_map()
        is_first = not jaw.actors()
        linked = jaw.link_rigs(stage, prim_map)
        if linked and is_first:
            apply_stage_settings(stage)
        add_plates(stage, prim_map)
        return linked


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


def glTF2_pre_export_callback(export_settings: Mapping[str, logging.Logger]) -> None:
    """Warn if a glTF file would lack the motion of a jaw; Blender's exporter calls this function by name."""
    warning = bake.warning(bpy.context.scene)
    if warning:
        export_settings["log"].warning(warning)


def register() -> None:
    """Register the hook, the panel and the handlers that restore rigs in reopened files."""
    vendored.find_blender_pxr(bpy.utils.resource_path)
    # Fail here if pxr is missing: with a registered hook, Blender would abort.
    import pxr.Usd  # noqa: F401

    bpy.utils.register_class(JawUsdHook)
    panel.register()
    jaw.register()
    handle.register()


def unregister() -> None:
    """Unregister everything that `register` registered."""
    handle.unregister()
    jaw.unregister()
    panel.unregister()
    bpy.utils.unregister_class(JawUsdHook)
