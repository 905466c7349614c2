"""Run inside Blender's Python: import a take with the add-on and print its camera backgrounds, as JSON.

Usage: python blender_plates.py ZIP FOLDER FILE
"""

import json
import os
import sys

import bpy

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
from extension import install


def main(archive, folder, path):
    """Import the take and print the backgrounds."""
    bpy.ops.wm.read_homefile(use_empty=True)
    install(archive, folder)
    bpy.ops.wm.usd_import(filepath=path)
    scene, result = bpy.context.scene, {"cameras": {}}
    for found in bpy.data.objects:
        if found.type != "CAMERA":
            continue
        shown = found.data.background_images[0] if found.data.background_images else None
        row = shown and [shown.image.filepath, shown.image.source, shown.image_user.frame_offset]
        result["cameras"][found.name] = row
        result.setdefault("lenses", {})[found.name] = [found.data.lens, found.data.sensor_width]
    result["scene"] = [scene.camera.name, scene.render.resolution_x, scene.render.resolution_y]
    print("RESULT " + json.dumps(result))


main(*sys.argv[1:])
sys.stdout.flush()
os._exit(0)  # the module hangs at a normal exit in some versions
