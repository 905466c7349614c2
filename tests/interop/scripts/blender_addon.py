"""Run inside Blender's Python: import a rig with the add-on, pose, key, save; or reopen the saved file.

Usage: python blender_addon.py ZIP FOLDER import USD POSES.json
       python blender_addon.py ZIP FOLDER reopen POSES.json
Prints {"poses": mesh vertices per pose, "ranges": per pose, "keys", "frames"} as JSON, in the frame of /Actor [mm].
"""

import json
import os
import sys
import zipfile

import bpy

MESH = "MandibleMesh"


def add_on(archive, folder):
    """Unpack the extension and register it, as Blender does."""
    package = os.path.join(folder, "jawusd_blender")
    with zipfile.ZipFile(archive) as opened:
        opened.extractall(package)
    sys.path.insert(0, folder)
    import jawusd_blender

    jawusd_blender.register()
    return jawusd_blender


def vertices():
    """Return the mandible's evaluated vertices in the frame of the actor."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    root = bpy.data.objects["Actor"].evaluated_get(depsgraph)
    mesh = bpy.data.objects[MESH].evaluated_get(depsgraph)
    to_root = root.matrix_world.inverted() @ mesh.matrix_world
    return [list(to_root @ vertex.co) for vertex in mesh.to_mesh().vertices]


def posed(poses):
    """Set the sliders to every pose and return what the mandible and the ranges become."""
    actor = bpy.data.objects["Actor"]
    places, ranges = [], []
    for pose in poses:
        for name, value in zip(("d1", "d2", "d3"), pose):
            actor[name] = value
        actor.update_tag()
        bpy.context.view_layer.update()
        places.append(vertices())
        found = [actor.id_properties_ui(name).as_dict() for name in ("d2", "d3")]
        ranges.append([[ui["min"], ui["max"]] for ui in found])
    return places, ranges


def main(archive, folder, what, *arguments):
    """Do what was asked and print the result."""
    bpy.ops.wm.read_homefile(use_empty=True)
    package = add_on(archive, folder)
    saved = os.path.join(folder, "saved.blend")
    result = {}
    if what == "import":
        bpy.ops.wm.usd_import(filepath=arguments[0])
        actor = bpy.data.objects["Actor"]
        action = actor.animation_data.action if actor.animation_data else None
        result["keys"] = sum(len(curve.keyframe_points) for curve in package.jaw.curves(actor)) if action else 0
    else:
        bpy.ops.wm.open_mainfile(filepath=saved)
        actor = bpy.data.objects["Actor"]
    frames = {}
    for frame in (30, 38, 55):
        bpy.context.scene.frame_set(frame)
        frames[frame] = {"d": [actor[name] for name in ("d1", "d2", "d3")], "places": vertices()}
    result["frames"] = frames
    if actor.animation_data:
        actor.animation_data.action = None
    with open(arguments[-1]) as opened:
        result["poses"], result["ranges"] = posed(json.load(opened))
    mandible = bpy.data.objects["Mandible"]
    result["drivers"] = [curve.driver.is_valid for curve in mandible.animation_data.drivers]
    if what == "import":
        bpy.ops.wm.usd_import(filepath=arguments[0])  # a second one, so that names like Actor.001 work too
        result["second"] = [found.name for found in package.jaw.actors()]
        bpy.ops.wm.read_homefile(use_empty=True)
        bpy.ops.wm.usd_import(filepath=arguments[0])
        bpy.ops.wm.save_as_mainfile(filepath=saved)
    package.unregister()
    print("RESULT " + json.dumps(result))


main(*sys.argv[1:])
sys.stdout.flush()
os._exit(0)  # the module hangs at a normal exit in some versions
