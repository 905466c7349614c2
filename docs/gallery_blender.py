"""Render the captured motion with Cycles, on the processor, inside Blender's Python; see make_gallery.py.

Usage: python gallery_blender.py out/anim_capture.usdc FOLDER FIRST FRAMES STEP
"""

import math
import os
import sys

import bpy
from mathutils import Vector

WIDTH, HEIGHT, SAMPLES = 480, 400, 12
COLOURS = {"Enamel": (0.86, 0.80, 0.66), "Gum": (0.62, 0.22, 0.20), "Bone": (0.72, 0.62, 0.45)}


def surfaces():
    """Give the materials colours of teeth, gum and bone."""
    for material in bpy.data.materials:
        name = next((name for name in COLOURS if material.name.startswith(name)), None)
        if name is None:
            continue
        material.use_nodes = True
        shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
        shader.inputs["Base Color"].default_value = (*COLOURS[name], 1.0)
        shader.inputs["Roughness"].default_value = 0.3 if name == "Enamel" else 0.55


def corners():
    """Return the middle and the size of all meshes in the present frame."""
    meshes = [thing for thing in bpy.data.objects if thing.type == "MESH"]
    points = [mesh.matrix_world @ Vector(corner) for mesh in meshes for corner in mesh.bound_box]
    low, high = (Vector(map(pick, zip(*points))) for pick in (min, max))
    return (low + high) / 2, (high - low).length


def place(made, where, at):
    """Put a light or a camera at a place, looking at another."""
    made.location = where
    made.rotation_euler = (at - where).to_track_quat("-Z", "Y").to_euler()


def main(stage, folder, first, frames, step):
    """Import, light, render."""
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.usd_import(filepath=stage, relative_path=False)
    scene = bpy.context.scene
    start = scene.frame_start + first
    scene.frame_set(start + frames // 2)
    surfaces()
    middle, size = corners()
    for energy, way in ((3.0, (0.6, -1.0, 0.8)), (1.2, (-1.0, -0.6, 0.2))):
        bpy.ops.object.light_add(type="SUN")
        bpy.context.object.data.energy, bpy.context.object.data.angle = energy, math.radians(20)
        place(bpy.context.object, middle + size * Vector(way), middle)
    bpy.ops.object.camera_add()
    scene.camera = bpy.context.object
    scene.camera.data.lens, scene.camera.data.clip_start = 85.0, 0.001
    place(scene.camera, middle + 2.1 * size * Vector((0.75, -1.0, 0.18)).normalized(), middle)
    scene.world = bpy.data.worlds.new("studio")
    scene.world.color = (0.32, 0.34, 0.37)
    scene.render.engine, scene.cycles.device = "CYCLES", "CPU"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.seed = SAMPLES, True, 0
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = WIDTH, HEIGHT, 100
    scene.view_settings.view_transform = "Standard"
    for frame in range(start, start + frames, step):
        scene.frame_set(frame)
        scene.render.filepath = f"{folder}/{frame:05d}.png"
        bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main(*sys.argv[1:3], *map(int, sys.argv[3:6]))
    sys.stdout.flush()
    os._exit(0)  # the module hangs at a normal exit in some versions
