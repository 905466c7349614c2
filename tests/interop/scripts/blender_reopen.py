"""Run inside Blender's Python: open a file as a render farm does, without the add-on, and print its mandible, as JSON.

Usage: python blender_reopen.py FILE.blend SCRIPTS     (SCRIPTS: 0 or 1, whether Blender may run scripts of files)
Prints {"FRAME": matrix in the actor [mm]}, first of the frame on which the file was saved, then of every frame.
"""

import json
import os
import sys

import bpy

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
from blender_playback import matrix

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.preferences.filepaths.use_scripts_auto_execute = sys.argv[2] == "1"
bpy.ops.wm.open_mainfile(filepath=sys.argv[1], use_scripts=sys.argv[2] == "1")
scene = bpy.context.scene
found = {f"saved on {scene.frame_current}": matrix()}
for frame in range(scene.frame_start, scene.frame_end + 1):
    scene.frame_set(frame)
    found[str(frame)] = matrix()
print("RESULT " + json.dumps(found))
sys.stdout.flush()
os._exit(0)  # the module hangs at a normal exit in some versions
