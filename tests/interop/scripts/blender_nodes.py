"""Run inside Blender's Python: make the Geometry Nodes file of a rig; or reopen it without scripts and pose it.

Usage: python blender_nodes.py PLUGINS make USD BLEND
       python blender_nodes.py PLUGINS reopen BLEND POSES.json FRAME,FRAME,... MESH,MESH,...
Prints {"poses": {mesh: vertices per pose}, "frames": {frame: {mesh: vertices}}, "limits", "fps", "drivers"} as JSON, in
the frame of /Actor [mm].
"""

import json
import os
import sys

import bpy


def vertices(name):
    """Return the evaluated vertices of a mesh object in the frame of the actor."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    root = bpy.data.objects["Actor"].evaluated_get(depsgraph)
    mesh = bpy.data.objects[name].evaluated_get(depsgraph)
    to_root = root.matrix_world.inverted() @ mesh.matrix_world
    return [list(to_root @ vertex.co) for vertex in mesh.to_mesh().vertices]


def reopen(blend, poses, frames, meshes):
    """Open the file with scripts switched off, play its keys, then set the sliders to every pose."""
    bpy.context.preferences.filepaths.use_scripts_auto_execute = False
    bpy.ops.wm.open_mainfile(filepath=blend, use_scripts=False)
    carrier = bpy.data.objects[meshes[0]]
    modifier = carrier.modifiers["Jaw"]
    sockets = [item for item in modifier.node_group.interface.items_tree if item.socket_type == "NodeSocketFloat"]
    result = {"frames": {}, "poses": {name: [] for name in meshes}, "texts": len(bpy.data.texts)}
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        result["frames"][frame] = {name: vertices(name) for name in meshes}
    if carrier.animation_data:
        carrier.animation_data.action = None
    for pose in poses:
        for socket, value in zip(sockets, pose):
            modifier[socket.identifier] = value
        carrier.update_tag()
        bpy.context.view_layer.update()
        for name in meshes:
            result["poses"][name].append(vertices(name))
    result["limits"] = [[socket.min_value, socket.max_value] for socket in sockets]
    result["fps"] = bpy.context.scene.render.fps / bpy.context.scene.render.fps_base
    drivers = [c.driver for o in bpy.data.objects if o.animation_data for c in o.animation_data.drivers]
    result["drivers"] = [[driver.type, driver.is_valid] for driver in drivers]
    return result


def main(plugins, what, *arguments):
    """Do what was asked and print the result."""
    if what == "make":
        sys.path.insert(0, plugins)
        import blender_nodes

        blender_nodes.make_file(*arguments)
        result = {}
    else:
        with open(arguments[1]) as opened:
            poses = json.load(opened)
        result = reopen(arguments[0], poses, [int(x) for x in arguments[2].split(",")], arguments[3].split(","))
    print("RESULT " + json.dumps(result))


main(*sys.argv[1:])
sys.stdout.flush()
os._exit(0)  # the module hangs at a normal exit in some versions
