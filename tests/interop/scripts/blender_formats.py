"""Run inside Blender's Python: import a USD file, key its motion, and export the scene as FBX or glTF.

Usage: python blender_formats.py FILE OUT FIRST LAST
"""

import json
import os
import sys

import bpy


def key(objects, frames):
    """Convert motion from cache constraints to keys, which other formats support."""
    seen = {}
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        bpy.context.view_layer.update()
        for item in objects:
            seen[item.name, frame] = item.matrix_world.copy()
    for item in objects:
        item.constraints.clear()
        item.rotation_mode = "QUATERNION"
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        for item in objects:
            item.matrix_world = seen[item.name, frame]
            bpy.context.view_layer.update()
            for channel in ("location", "rotation_quaternion", "scale"):
                item.keyframe_insert(channel, frame=frame)


source, out, first, last = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath=source)
bpy.context.scene.frame_start, bpy.context.scene.frame_end = first, last
key([item for item in bpy.data.objects if len(item.constraints)], range(first, last + 1))
if out.endswith(".fbx"):
    bpy.ops.preferences.addon_enable(module="io_scene_fbx")
    bpy.ops.export_scene.fbx(filepath=out, bake_anim_simplify_factor=0.0)
else:
    bpy.ops.preferences.addon_enable(module="io_scene_gltf2")
    bpy.ops.export_scene.gltf(filepath=out)
print("RESULT " + json.dumps({"objects": sorted(found.name for found in bpy.data.objects)}))
sys.stdout.flush()
os._exit(0)  # the module hangs at a normal exit in some versions
