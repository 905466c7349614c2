"""Run inside Blender's Python: import a take and print the projections of a mesh's vertices, as JSON.

Usage: python blender_cameras.py FILE WIDTH HEIGHT FRAME,FRAME,... MESH CAMERA,CAMERA,...
Prints {frame: {camera: [[x, y], ...]}} in pixels, (0, 0) at the centre of the top left pixel.
"""

import json
import os
import sys

import bpy
from bpy_extras.object_utils import world_to_camera_view


def main(path, width, height, frames, name, cameras):
    """Import the take and print the projections."""
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.usd_import(filepath=path)
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = width, height
    result = {}
    for frame in frames:
        scene.frame_set(frame)
        mesh = bpy.data.objects[name].evaluated_get(bpy.context.evaluated_depsgraph_get())
        places = [mesh.matrix_world @ vertex.co for vertex in mesh.to_mesh().vertices]
        result[frame] = {}
        for camera in cameras:
            seen = [world_to_camera_view(scene, bpy.data.objects[camera], place) for place in places]
            result[frame][camera] = [[view.x * width - 0.5, (1 - view.y) * height - 0.5] for view in seen]
    print("RESULT " + json.dumps(result))


given = sys.argv[1:]
main(given[0], int(given[1]), int(given[2]), [int(x) for x in given[3].split(",")], given[4], given[5].split(","))
sys.stdout.flush()
os._exit(0)  # the module hangs at a normal exit in some versions
