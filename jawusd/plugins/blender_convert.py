"""Turn a file of another format into a USD stage, inside Blender: `jawusd encode RIG take.fbx` runs this.

    blender -b --factory-startup -P blender_convert.py -- take.fbx take.usdc 24

or with a Python that has `bpy`. The last argument is the frames per second of files that do not say, as glTF ones; FBX
files say. A time of 0 is frame 0.
"""

from __future__ import annotations

import os
import sys

import bpy


def convert(source: str, target: str, fps: float) -> None:
    """Import a file into an empty scene and export it, over the frames of its actions."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = round(fps), round(fps) / fps
    if source.lower().endswith(".fbx"):
        bpy.ops.preferences.addon_enable(module="io_scene_fbx")
        bpy.ops.import_scene.fbx(filepath=source, anim_offset=0.0)
    else:
        bpy.ops.preferences.addon_enable(module="io_scene_gltf2")
        bpy.ops.import_scene.gltf(filepath=source)
    ranges = [action.frame_range for action in bpy.data.actions]
    scene.frame_start = int(min((first for first, _ in ranges), default=0))
    scene.frame_end = round(max((last for _, last in ranges), default=0))
    bpy.ops.wm.usd_export(filepath=target, export_animation=True, export_armatures=True, export_materials=False)


if __name__ == "__main__":
    given = sys.argv[sys.argv.index("--") + 1 :]
    convert(given[0], given[1], float(given[2]))
    sys.stdout.flush()
    os._exit(0)  # the module hangs at a normal exit in some versions
