"""Blender add-on: a USD file with a jaw rig arrives with three sliders, live ranges and keys.

The extension is built by `python -m jawusd.plugins FILE.zip`, which puts `jawusd_reader.py` beside these modules.
"""

from __future__ import annotations

import os
import sys

import bpy

from . import jaw, panel


def _add_pxr_path() -> None:
    """Make Blender's own pxr importable where it is not: in Blender as a Python module."""
    version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    for kind in ("LOCAL", "SYSTEM"):
        base = bpy.utils.resource_path(kind)
        folder = os.path.join(base, "python", "lib", version, "site-packages")
        if base and os.path.isdir(os.path.join(folder, "pxr")) and folder not in sys.path:
            sys.path.append(folder)


class JawUsdHook(bpy.types.USDHook):
    """Turn the rigs of an imported stage into live ones."""

    bl_idname = "jawusd_hook"
    bl_label = "jawusd jaw rigs"

    @staticmethod
    def on_import(context: bpy.types.Context) -> bool:
        """Link every rig of the stage; Blender calls this at the end of an import."""
        return jaw.link_rigs(context.get_stage(), context.get_prim_map())


def register() -> None:
    """Register the hook, the panel and what keeps rigs alive in reopened files."""
    _add_pxr_path()
    # Blender aborts when a hook is registered and pxr cannot be imported; better fail here
    import pxr.Usd  # noqa: F401

    bpy.utils.register_class(JawUsdHook)
    panel.register()
    jaw.register()


def unregister() -> None:
    """Take everything back."""
    jaw.unregister()
    panel.unregister()
    bpy.utils.unregister_class(JawUsdHook)
