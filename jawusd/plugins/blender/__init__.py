"""Blender add-on: a jaw rig imported from USD gets sliders, keys, a handle, its cameras, and a way back to USD.

The extension is built by `python -m jawusd.plugins FILE.zip`, which puts what it uses of jawusd beside these modules.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping

import bpy

from . import bake, carried, handle, jaw, operators, panel, scene


class JawUsdHook(bpy.types.USDHook):
    """Link the rigs of an imported stage."""

    bl_idname = "jawusd_hook"
    bl_label = "jawusd jaw rigs"

    @staticmethod
    def on_import(context: bpy.types.Context) -> bool:
        """Link every rig and camera of the stage; Blender calls this at the end of an import."""
        stage, prim_map = context.get_stage(), context.get_prim_map()
        alone = not jaw.actors()
        linked = jaw.link_rigs(stage, prim_map)
        if linked and alone:
            scene.take_rate(stage)
        scene.add_plates(stage, prim_map)
        return linked


def glTF2_pre_export_callback(export_settings: Mapping[str, logging.Logger]) -> None:
    """Warn of a jaw that a glTF file would hold without its motion; Blender's exporter calls it by this name."""
    warning = bake.warning(bpy.context.scene)
    if warning:
        export_settings["log"].warning(warning)


def register() -> None:
    """Register the hook, the panel and the handlers that restore rigs in reopened files."""
    carried.find_blender_pxr(bpy.utils.resource_path)
    # Blender aborts when a hook is registered and pxr cannot be imported: fail before
    import pxr.Usd  # noqa: F401

    bpy.utils.register_class(JawUsdHook)
    operators.register()
    panel.register()
    jaw.register()
    handle.register()


def unregister() -> None:
    """Remove them."""
    handle.unregister()
    jaw.unregister()
    panel.unregister()
    operators.unregister()
    bpy.utils.unregister_class(JawUsdHook)
