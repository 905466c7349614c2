"""Run inside Blender's Python: import a .glb and print the vertices of a mesh, as JSON.

Usage: python blender_gltf.py FILE FPS FRAME,FRAME,... MESH     (frame 0 is the start of the file's animation)
Prints {"frames": {frame: [[x, y, z], ...]}, "looks": {mesh: [colours, texture coordinates]}}, positions in the axes of
the file [mm].
"""

import json
import os
import sys

import bpy


def main(path, fps, frames, name):
    """Import the file and print the results."""
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.preferences.addon_enable(module="io_scene_gltf2")
    bpy.context.scene.render.fps = fps
    bpy.ops.import_scene.gltf(filepath=path, merge_vertices=False)
    places = {}
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        found = bpy.data.objects[name].evaluated_get(bpy.context.evaluated_depsgraph_get())
        world = [found.matrix_world @ vertex.co for vertex in found.to_mesh().vertices]
        places[frame] = [[1000 * p.x, 1000 * p.z, -1000 * p.y] for p in world]  # Blender has z up
    meshes = {item.name: item.data for item in bpy.data.objects if item.type == "MESH"}
    looks = {key: [len(mesh.color_attributes), len(mesh.uv_layers)] for key, mesh in meshes.items()}
    print("RESULT " + json.dumps({"frames": places, "looks": looks}))


main(sys.argv[1], int(sys.argv[2]), [int(frame) for frame in sys.argv[3].split(",")], sys.argv[4])
sys.stdout.flush()
os._exit(0)  # the module hangs at a normal exit in some versions
