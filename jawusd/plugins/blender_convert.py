"""Convert an FBX or glTF file to a USD stage inside Blender: `jawusd encode RIG take.fbx` runs this script.

    blender -b --factory-startup -P blender_convert.py -- take.fbx take.usdc 24

It also runs in a Python with `bpy`. The last argument is the frame rate for files that do not contain one, such as
glTF; it is ignored for FBX. Time 0 becomes frame 0.
"""

from __future__ import annotations

import os
import sys
import traceback

import bpy

_STILL = 1e-6  # maximum variation of an animation curve that counts as constant
_TRANSFORM_PATHS = ("location", "rotation", "scale", "pose.bones")


def convert(source: str, target: str, fps: float) -> None:
    """Import a file into an empty scene and export the frame range of its actions."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = round(fps), round(fps) / fps
    if source.lower().endswith(".fbx"):
        bpy.ops.preferences.addon_enable(module="io_scene_fbx")
        bpy.ops.import_scene.fbx(filepath=source, anim_offset=0.0)
        _assign_takes()
    else:
        bpy.ops.preferences.addon_enable(module="io_scene_gltf2")
        bpy.ops.import_scene.gltf(filepath=source)
    ranges = [action.frame_range for action in bpy.data.actions]
    scene.frame_start = int(min((first for first, _ in ranges), default=0))
    scene.frame_end = round(max((last for _, last in ranges), default=0))
    bpy.ops.wm.usd_export(filepath=target, export_animation=True, export_armatures=True, export_materials=False)


def _assign_takes() -> None:
    """Assign to every object of an FBX file the take in which the object moves.

    By default, Blender's FBX exporter writes every action for every object, such as the camera's action for the jaw,
    and the importer assigns the first of these actions to the object.
    """
    for found in bpy.data.objects:
        if not any(item.type == "MESH" for item in (found, *found.children_recursive)):
            continue
        moving = [action for action in bpy.data.actions if action.name.startswith(f"{found.name}|") and _moves(action)]
        if len(moving) > 1:
            names = ", ".join(action.name for action in moving)
            raise ValueError(f"{found.name} moves in several takes ({names}); export the file with All Actions off")
        if moving:
            data = found.animation_data
            data.action = moving[0]
            if hasattr(data, "action_slot"):  # action slots exist since Blender 4.4; the importer does not set them
                data.action_slot = data.action_suitable_slots[0]


def _moves(action: bpy.types.Action) -> bool:
    """Return whether an action moves an object or its bones."""
    layers = getattr(action, "layers", None)  # Blender 4.2 has no layers
    bags = [bag for layer in layers for strip in layer.strips for bag in strip.channelbags] if layers else [action]
    curves = [curve for bag in bags for curve in bag.fcurves if curve.data_path.startswith(_TRANSFORM_PATHS)]
    values = [[point.co[1] for point in curve.keyframe_points] for curve in curves]
    return any(max(row) - min(row) > _STILL for row in values if row)


if __name__ == "__main__":
    given, failed = sys.argv[sys.argv.index("--") + 1 :], False
    try:
        convert(given[0], given[1], float(given[2]))
    except Exception:  # jawusd reports the last line of the traceback
        traceback.print_exc()
        failed = True
    sys.stdout.flush()
    os._exit(failed)  # bpy hangs at a normal exit in some versions
