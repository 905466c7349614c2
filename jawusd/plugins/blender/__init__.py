"""Blender add-on: an imported USD file with a jaw rig gets three sliders, live ranges and keys.

The extension is built by `python -m jawusd.plugins FILE.zip`, which puts `jawusd_reader.py` beside these modules.
"""

from __future__ import annotations

import bpy

from . import jaw, jawusd_reader, panel


class JawUsdHook(bpy.types.USDHook):
    """Add sliders and drivers to the rigs of an imported stage."""

    bl_idname = "jawusd_hook"
    bl_label = "jawusd jaw rigs"

    @staticmethod
    def on_import(context: bpy.types.Context) -> bool:
        """Link every rig of the stage; Blender calls this at the end of an import."""
        return jaw.link_rigs(context.get_stage(), context.get_prim_map())


def register() -> None:
    """Register the hook, the panel and the handlers that restore rigs in reopened files."""
    jawusd_reader.find_blender_pxr(bpy.utils.resource_path)
    # Blender aborts when a hook is registered and pxr cannot be imported: fail before
    import pxr.Usd  # noqa: F401

    bpy.utils.register_class(JawUsdHook)
    panel.register()
    jaw.register()


def unregister() -> None:
    """Remove them."""
    jaw.unregister()
    panel.unregister()
    bpy.utils.unregister_class(JawUsdHook)
