"""Run inside Blender's Python: import a file and export the scene as USD, with its animation.

Usage: python blender_export.py FILE OUT FIRST LAST
"""

import json
import os
import sys

import bpy

path, out, first, last = sys.argv[1:]
bpy.ops.wm.read_homefile(use_empty=True)
bpy.ops.wm.usd_import(filepath=path)
bpy.context.scene.frame_start, bpy.context.scene.frame_end = int(first), int(last)
bpy.ops.wm.usd_export(filepath=out, export_animation=True, export_armatures=True)
print("RESULT " + json.dumps({"objects": sorted(found.name for found in bpy.data.objects)}))
sys.stdout.flush()
os._exit(0)  # the module hangs at a normal exit in some versions
