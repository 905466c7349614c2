"""Run inside Blender's Python: import a USD file and print the vertices of meshes, as JSON.

Usage: python blender_import.py FILE FRAME,FRAME,... MESH,MESH,...
Prints {"version", "actions", "properties", "looks": {mesh: {"colors", "uv"}}, "frames": {frame: {mesh: [[x, y, z],
...]}}}, positions in the frame of /Actor [mm].
"""

import json
import os
import sys

import bpy


def vertices(name, root, depsgraph):
    """Return the evaluated vertices of a mesh object in the frame of the root object."""
    evaluated = bpy.data.objects[name].evaluated_get(depsgraph)
    to_root = root.evaluated_get(depsgraph).matrix_world.inverted() @ evaluated.matrix_world
    mesh = evaluated.to_mesh()
    return [list(to_root @ vertex.co) for vertex in mesh.vertices]


def editable_keys():
    """Return the number of keys of each action's longest curve."""
    found = {}
    for action in bpy.data.actions:
        curves = list(getattr(action, "fcurves", []))
        for layer in getattr(action, "layers", []):
            for strip in layer.strips:
                for bag in strip.channelbags:
                    curves += list(bag.fcurves)
        found[action.name] = max((len(curve.keyframe_points) for curve in curves), default=0)
    return found


def look(name):
    """Return linear colours per vertex and texture coordinates per corner of a mesh object; None if missing."""
    mesh = bpy.data.objects[name].data
    colors, layers = mesh.color_attributes.get("displayColor"), mesh.uv_layers
    return {
        "colors": None if colors is None else [list(item.color)[:3] for item in colors.data],
        "uv": [list(item.uv) for item in layers[0].data] if len(layers) else None,
    }


def main(path, frames, meshes):
    """Import the file and print the results."""
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.usd_import(filepath=path)
    root = bpy.data.objects["Actor"]
    places = {}
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        places[frame] = {name: vertices(name, root, depsgraph) for name in meshes}
    properties = {key: str(value) for key, value in root.items() if key.startswith("jaw:")}
    result = {"version": bpy.app.version_string, "actions": editable_keys(), "properties": properties, "frames": places}
    result["bones"] = [bone.name for armature in bpy.data.armatures for bone in armature.bones]
    result["looks"] = {name: look(name) for name in meshes}
    print("RESULT " + json.dumps(result))


main(sys.argv[1], [int(frame) for frame in sys.argv[2].split(",")], sys.argv[3].split(","))
sys.stdout.flush()
os._exit(0)  # the module hangs at a normal exit in some versions
