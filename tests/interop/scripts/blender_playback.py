"""Run inside Blender's Python: play takes with the add-on and print the mandible in every frame, as JSON.

Usage: python blender_playback.py ZIP FOLDER TAKE.usd KEYS.json FRAME,FRAME,...
KEYS is a list of takes, each [[frame, d1, d2, d3], ...]; all except the imported motion are keyed on the sliders.
Each take is played forward, backward, and again after the file was saved on each of FRAMES and reopened. Prints
{"takes": [{"FRAME": [matrix forward, backward, ...reopened]}], "d": [{"FRAME": [d1, d2, d3]}]}.
"""

import json
import os
import sys

import bpy

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
from extension import install

NAMES = ("d1", "d2", "d3")


def matrix(name="Mandible"):
    """Return a mandible's evaluated matrix in the actor [mm], rows, in Blender's single precision."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    mandible = bpy.data.objects[name].evaluated_get(depsgraph)
    return [list(row) for row in mandible.matrix_local]


def played(frames, found, values=None):
    """Show frames in the given order; record the mandible and, if asked, the sliders."""
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        found.setdefault(str(frame), []).append(matrix())
        if values is not None:
            values[str(frame)] = [bpy.data.objects["Actor"][name] for name in NAMES]


def key(keys):
    """Replace the sliders' keys."""
    actor = bpy.data.objects["Actor"]
    actor.animation_data_clear()
    for frame, *d in keys:
        for name, value in zip(NAMES, d):
            actor[name] = value
            actor.keyframe_insert(f'["{name}"]', frame=frame)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = int(keys[0][0]), int(keys[-1][0])


def main(archive, folder, take, takes, saved_on):
    """Play all takes and print the displayed poses."""
    bpy.ops.wm.read_homefile(use_empty=True)
    package = install(archive, folder)
    result = {"takes": [], "d": []}
    with open(takes) as opened:
        takes = [None, *json.load(opened)]
    for keys in takes:
        bpy.ops.wm.read_homefile(use_empty=True)
        bpy.ops.wm.usd_import(filepath=take)
        if keys is not None:
            key(keys)
        scene = bpy.context.scene
        frames, found, values = list(range(scene.frame_start, scene.frame_end + 1)), {}, {}
        played(frames, found, values)
        played(frames[::-1], found)
        for frame in saved_on:
            scene = bpy.context.scene
            scene.frame_set(frame if keys is None else frames[frame % len(frames)])
            path = os.path.join(folder, "played.blend")
            bpy.ops.wm.save_as_mainfile(filepath=path)
            bpy.ops.wm.open_mainfile(filepath=path)
            played(frames, found)
        result["takes"].append(found)
        result["d"].append(values)
    scene = bpy.context.scene
    result["scene"] = [scene.render.fps / scene.render.fps_base, scene.unit_settings.length_unit]
    package.unregister()
    print("RESULT " + json.dumps(result))


if __name__ == "__main__":
    main(*sys.argv[1:5], [int(frame) for frame in sys.argv[5].split(",")])
    sys.stdout.flush()
    os._exit(0)  # the module hangs at a normal exit in some versions
