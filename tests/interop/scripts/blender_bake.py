"""Run inside Blender's Python: bake jaws to keys with the add-on and export them; print the results as JSON.

Usage: python blender_bake.py ZIP FOLDER TAKE.usd SPLINES.usd,SPLINES.usd INSTANCES.usd FRAME
Matrices are the mandible's in the actor [mm]. Writes driven and baked .blend, .fbx and .glb files to FOLDER.
"""

import json
import logging
import os
import sys
from types import SimpleNamespace

import bpy

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
from blender_playback import NAMES, matrix
from extension import install


def opened(take, **options):
    """Import a take into an empty scene."""
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.usd_import(filepath=take, **options)


def played():
    """Return d and the mandible at every frame of the scene."""
    scene, found = bpy.context.scene, {}
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        found[frame] = [[bpy.data.objects["Actor"][name] for name in NAMES], matrix()]
    return found


def exported(folder, name):
    """Export the scene with default settings; return the log of the glTF exporter."""
    heard, logger = [], logging.getLogger("glTFImporter")
    listener = logging.Handler()
    listener.emit = lambda record: heard.append(record.getMessage())
    logger.addHandler(listener)
    bpy.ops.export_scene.gltf(filepath=os.path.join(folder, f"{name}.glb"))
    bpy.ops.export_scene.fbx(filepath=os.path.join(folder, f"{name}.fbx"))
    logger.removeHandler(listener)
    bpy.ops.wm.save_as_mainfile(filepath=os.path.join(folder, f"{name}.blend"), copy=True)
    return heard


def dialogs(package):
    """Return the exporters for which the file browser shows the jaw's panel, and the warning about lost motion."""
    scene, names = bpy.context.scene, ("EXPORT_SCENE_OT_fbx", "EXPORT_SCENE_OT_gltf", "WM_OT_usd_export")
    contexts = [
        SimpleNamespace(space_data=SimpleNamespace(active_operator=SimpleNamespace(bl_idname=x))) for x in names
    ]
    return [package.panel.JAW_PT_export.poll(context) for context in contexts], package.bake.warning(scene)


def state(package):
    """Return the frames and interpolation of the mandible's keys, the number of its drivers, and its offset."""
    mandible = bpy.data.objects["Mandible"]
    curves = [x for x in package.jaw.curves(mandible) if x.data_path in ("location", "rotation_quaternion")]
    return {
        "frames": [[point.co[0] for point in curve.keyframe_points] for curve in curves],
        "values": {f"{c.data_path}{c.array_index}": [point.co[1] for point in c.keyframe_points] for c in curves},
        "interpolation": sorted({point.interpolation for curve in curves for point in curve.keyframe_points}),
        "drivers": len(mandible.animation_data.drivers),
        "offset": [*mandible.delta_location, *mandible.delta_rotation_quaternion],
        "actions": sorted(action.name for action in bpy.data.actions),
    }


def refused(call, **arguments):
    """Return the error message of an operator."""
    try:
        return str(call(**arguments))
    except RuntimeError as error:
        return str(error)


def several(package, folder, take):
    """Export two jaws and a keyed camera to FBX, whose action FBX applies to the jaws too, in both modes."""
    opened(take)
    bpy.ops.wm.usd_import(filepath=take)
    bpy.data.objects["Actor.001"].animation_data_clear()
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    bpy.context.scene.collection.objects.link(camera)
    for frame in (30, 69):
        camera.location.x = frame
        camera.keyframe_insert("location", frame=frame)
    one_take = {"bake_anim_use_nla_strips": False, "bake_anim_use_all_actions": False}
    bpy.ops.export_scene.fbx(filepath=os.path.join(folder, "scene_live.fbx"), **one_take)
    bpy.ops.jaw.bake_to_keys()
    bpy.ops.export_scene.fbx(filepath=os.path.join(folder, "scene_default.fbx"))
    bpy.ops.export_scene.fbx(filepath=os.path.join(folder, "scene.fbx"), **one_take)
    bpy.data.actions.remove(bpy.data.actions["CameraAction"])
    bpy.ops.export_scene.fbx(filepath=os.path.join(folder, "jaws.fbx"))


def main(archive, folder, take, splines, instances, shown):
    """Run all checks."""
    bpy.ops.wm.read_homefile(use_empty=True)
    package = install(archive, folder)
    result = {"splines": []}
    for path in splines.split(","):
        opened(path)
        result["splines"].append(played())
    result["nothing"] = refused(bpy.ops.jaw.bake_to_keys, actor="Nobody")
    opened(take)
    bpy.context.scene.frame_start = 20  # before the take: the sliders have the value of their first key
    result["played"] = played()
    bpy.context.scene.frame_set(int(shown))
    result["live"] = [exported(folder, "live"), *dialogs(package), state(package)]
    bpy.ops.ed.undo_push(message="before the bake")
    bpy.ops.jaw.bake_to_keys("EXEC_DEFAULT", True)
    result["frame"] = bpy.context.scene.frame_current
    result["baked"] = [exported(folder, "baked"), *dialogs(package), state(package)]
    result["keyed"] = played()
    bpy.ops.ed.undo()
    result["undone"] = state(package)
    bpy.ops.jaw.bake_to_keys(actor="Actor", frames="TAKE")
    bpy.ops.jaw.bake_to_keys(actor="Actor", frames="TAKE")
    result["take"] = state(package)
    bpy.ops.jaw.use_sliders(actor="Actor")
    result["sliders"] = [state(package), played()]
    bpy.data.objects["Actor"].animation_data_clear()
    result["no_keys"] = refused(bpy.ops.jaw.bake_to_keys, frames="TAKE")
    bpy.data.objects.remove(bpy.data.objects["Mandible"])
    result["no_mandible"] = refused(bpy.ops.jaw.bake_to_keys)
    several(package, folder, take)
    result["instanced"] = []
    for instancing in (True, False):
        opened(instances, support_scene_instancing=instancing)
        names = sorted(actor.name for actor in package.jaw.actors())
        result["instanced"].append([names, sorted(package.jaw.without_sliders())])
    result["panel"] = package.panel.JAWUSD_PT_sliders.poll(bpy.context)
    print("RESULT " + json.dumps(result))


if __name__ == "__main__":
    main(*sys.argv[1:])
    sys.stdout.flush()
    os._exit(0)  # the module hangs at a normal exit in some versions
