"""Run inside Blender's Python: use all features of the add-on on an imported take; print the results as JSON.

Usage: python blender_addon.py ZIP FOLDER TAKE.usd POSES.json BONES.usd
BONES is the same take with its skeleton selected.
Matrices are the mandible's in the actor [mm].
"""

import json
import os
import sys

import bpy

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
from blender_playback import NAMES, matrix
from extension import install


def posed(d, actor="Actor", mandible="Mandible"):
    """Set the sliders of an actor and return its mandible's matrix."""
    actor = bpy.data.objects[actor]
    for name, value in zip(NAMES, d):
        actor[name] = value
    actor.update_tag()
    bpy.context.view_layer.update()
    return matrix(mandible)


def limits():
    """Return hard and soft limits of the sliders."""
    found = [bpy.data.objects["Actor"].id_properties_ui(name).as_dict() for name in NAMES]
    return [[ui[end] for end in ("min", "soft_min", "soft_max", "max")] for ui in found]


def readout(package, d):
    """Return the lines that the panel shows."""
    actor = bpy.data.objects["Actor"]
    return [text for text, _ in package.panel._readout(package.jaw.rig_of(actor), d)]


def two_actors(package, take, poses):
    """Import the take again; return both actors, the playback of the second, and both in different poses."""
    bpy.ops.wm.usd_import(filepath=take)
    actors = package.jaw.actors()
    names = [(actor.name, package.jaw.mandible_of(actor).name) for actor in actors]
    bpy.context.scene.frame_set(42)
    found = {"names": [name for name, _ in names], "played": [matrix(name) for _, name in names], "posed": []}
    actors[1].animation_data.action = None
    for rows in zip(poses, poses[::-1]):
        for d, (actor, mandible) in zip(rows, names):
            posed(d, actor, mandible)
        found["posed"].append([matrix(mandible) for _, mandible in names])
    return found


def without_rig_file(package, folder):
    """Export after the rig's file was deleted; return the message of Blender."""
    actor = bpy.data.objects["Actor"]
    source, actor[package.jaw.SOURCE] = actor[package.jaw.SOURCE], os.path.join(folder, "gone", "actor.usda")
    try:
        return list(bpy.ops.jawusd.export(actor="Actor", filepath=os.path.join(folder, "groundless.usdc")))
    except RuntimeError as error:  # an operator that reports an error
        return str(error)
    finally:
        actor[package.jaw.SOURCE] = source


def overridden(package, folder, take, d):
    """Override an actor linked from a file; return its mandible posed by d, with "Keep valid", and after reopening."""
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.usd_import(filepath=take)
    actor, made = package.jaw.actors()[0], bpy.data.collections.new("Rig")
    actor.animation_data_clear()
    bpy.context.scene.collection.children.link(made)
    for found in (actor, *actor.children_recursive):
        made.objects.link(found)
    library, shot = os.path.join(folder, "library.blend"), os.path.join(folder, "shot.blend")
    bpy.ops.wm.save_as_mainfile(filepath=library)
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(library, link=True) as (_, linked):
        linked.collections = ["Rig"]
    linked.collections[0].override_hierarchy_create(bpy.context.scene, bpy.context.view_layer)
    for reopened in (False, True):
        if reopened:
            bpy.ops.wm.save_as_mainfile(filepath=shot)
            bpy.ops.wm.open_mainfile(filepath=shot)
        actor = next(found for found in package.jaw.actors() if found.override_library)
        actor[package.jaw.KEEP] = True
        for name, value in zip(NAMES, d):
            actor[name] = value
        actor.update_tag()
        bpy.context.view_layer.update()
    mandible = package.jaw.mandible_of(actor)
    shown = mandible.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return {"override": mandible.override_library is not None, "pose": [list(row) for row in shown.matrix_local]}


def by_bones(package, take):
    """Import a take moved by bones into an empty scene; return its actors and the vertices of the mandible."""
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.usd_import(filepath=take)
    bpy.context.scene.frame_set(42)
    return {"actors": [actor.name for actor in package.jaw.actors()], "places": vertices()}


def enabled_again(d):
    """Disable the add-on, whose drivers then fail, and enable it; return the mandible before and after it restores."""
    module = "bl_ext.test_repository.jawusd_blender"
    bpy.ops.preferences.addon_disable(module=module)
    found = [posed(d)]
    bpy.ops.preferences.addon_enable(module=module)
    jaw = sys.modules[f"{module}.jaw"]
    if bpy.app.timers.is_registered(jaw._install):  # Blender calls it when it waits for events
        jaw._install()
    return [*found, posed(d)]


def dragged(way):
    """Drag a handle at the incisor by a distance [mm]; return the sliders, the handle's position and its target."""
    bpy.ops.jawusd.handle(actor="Actor", at="INCISOR")
    handle = bpy.data.objects["Actor incisor"]
    target = [a + b for a, b in zip(handle.location, way)]
    handle.location = target
    bpy.context.view_layer.update()
    found = {"d": [bpy.data.objects["Actor"][name] for name in NAMES], "at": list(handle.location), "target": target}
    bpy.context.scene.frame_set(bpy.context.scene.frame_current + 1)
    found["played"] = list(handle.location)
    bpy.ops.jawusd.handle(actor="Actor", at="CHIN")
    return found


def from_older_version(package, folder, take, d):
    """Reopen a file saved by an add-on before 0.3.0; return the mandible posed by d."""
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.usd_import(filepath=take)
    mandible, actor = bpy.data.objects["Mandible"], bpy.data.objects["Actor"]
    actor.animation_data_clear()
    package.jaw.remove_drivers(mandible)
    mandible.delta_location = [-256.0] * 3
    for channel, (path, index) in enumerate(
        [("location", i) for i in range(3)] + [("rotation_quaternion", i) for i in range(4)]
    ):
        mandible.driver_add(path, index).driver.expression = f"jawusd_channel(self, d1, d2, d3, keep_valid, {channel})"
    path = os.path.join(folder, "older.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    return posed(d)


def vertices():
    """Return the vertices of the mandible's mesh in the actor."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    root = bpy.data.objects["Actor"].evaluated_get(depsgraph)
    mesh = bpy.data.objects["MandibleMesh"].evaluated_get(depsgraph)
    to_root = root.matrix_world.inverted() @ mesh.matrix_world
    return [list(to_root @ vertex.co) for vertex in mesh.to_mesh().vertices]


def main(archive, folder, take, poses, bones):
    """Run all checks."""
    bpy.ops.wm.read_homefile(use_empty=True)
    package = install(archive, folder)
    with open(poses) as opened:
        poses = json.load(opened)
    bpy.ops.wm.usd_import(filepath=take)
    actor, scene, result = bpy.data.objects["Actor"], bpy.context.scene, {}
    result["keys"] = sum(len(curve.keyframe_points) for curve in package.jaw.curves(actor))
    bpy.ops.jawusd.export(actor="Actor", filepath=os.path.join(folder, "exported.usdc"))
    result["gone"] = without_rig_file(package, folder)
    actor.animation_data.action = None
    result["poses"] = [posed(d) for d in poses["inside"]]
    result["limits"] = limits()
    result["readout"] = [readout(package, d) for d in (poses["inside"][0], poses["outside"][0])]
    rig = package.jaw.rig_of(actor)
    result["ranges"] = [[float(x) for x in rig.ranges(*d)] for d in poses["inside"]]
    result["shown_ranges"] = [readout(package, d)[1] for d in poses["inside"]]
    result["outside"] = [posed(d) for d in poses["outside"]]
    actor[package.jaw.KEEP] = True
    result["kept"] = [posed(d) for d in poses["outside"]]
    result["sliders"] = [actor[name] for name in NAMES]
    bpy.ops.jawusd.key(actor="Actor")
    posed((0.0, 0.0, 0.0))
    bpy.ops.jawusd.key(actor="Actor")
    bpy.ops.jawusd.export(actor="Actor", filepath=os.path.join(folder, "kept.usdc"))
    actor.animation_data.action, actor[package.jaw.KEEP] = None, False
    result["enabled"] = enabled_again(poses["inside"][1])
    result["two"] = two_actors(package, take, poses["inside"])
    posed(poses["inside"][0])
    result["dragged"] = dragged((1.0, -3.0, 1.0))
    result["frames"] = [scene.frame_start, scene.frame_end]
    result["bones"] = by_bones(package, bones)
    result["older"] = from_older_version(package, folder, take, poses["inside"][1])
    result["overridden"] = overridden(package, folder, take, poses["outside"][0])
    print("RESULT " + json.dumps(result))


if __name__ == "__main__":
    main(*sys.argv[1:])
    sys.stdout.flush()
    os._exit(0)  # the module hangs at a normal exit in some versions
