"""Run inside Blender's Python: import a shot with several actors and print their mandibles, as JSON.

Usage: python blender_shot.py FILE FRAME,FRAME,... ACTOR,ACTOR,...
Prints {frame: {actor: [[x, y, z], ...]}}, vertices of each actor's mandible in the actor's frame.
"""

import json
import os
import sys

import bpy

path, frames, names = sys.argv[1], [int(frame) for frame in sys.argv[2].split(",")], sys.argv[3].split(",")
bpy.ops.wm.read_homefile(use_empty=True)
bpy.ops.wm.usd_import(filepath=path)
found = {}
for frame in frames:
    bpy.context.scene.frame_set(frame)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    found[frame] = {}
    for name in names:
        actor = bpy.data.objects[name]
        below = actor.children_recursive
        mesh = next(item for item in below if item.type == "MESH" and item.name.startswith("MandibleMesh"))
        shown = mesh.evaluated_get(depsgraph)
        to_actor = actor.evaluated_get(depsgraph).matrix_world.inverted() @ shown.matrix_world
        found[frame][name] = [list(to_actor @ vertex.co) for vertex in shown.to_mesh().vertices]
print("RESULT " + json.dumps(found))
sys.stdout.flush()
os._exit(0)  # the module hangs at a normal exit in some versions
