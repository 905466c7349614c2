"""Blender add-on for jaw rigs imported from USD: sliders, keys, handles, cameras, and export back to USD.

`python -m jawusd.plugins FILE.zip` builds the extension, which includes the modules of jawusd that it needs.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping

import bpy

from . import bake, handle, jaw, panel, scene, vendored


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
            scene.apply_stage_settings(stage)
        scene.add_plates(stage, prim_map)
        return linked


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
