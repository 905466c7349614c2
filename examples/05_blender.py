"""Bring the captured motion into Blender and save a .blend: python examples/05_blender.py [out/anim_capture.usdc]

Runs with the Python of `pip install bpy`, or inside Blender: blender -b -P examples/05_blender.py. It needs no jawusd:
the motion is baked into the file as plain transforms. For sliders, keys and cameras make the add-on with
`python -m jawusd.plugins jawusd_blender.zip`.
"""

import sys
from pathlib import Path

PROGRAM_ARGUMENTS = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]


def main(stage: Path, out: Path) -> None:
    """Import the motion, measure it, light it, save it."""
    import bpy

    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.usd_import(filepath=str(stage.resolve()), relative_path=False)
    scene, teeth = bpy.context.scene, bpy.data.objects["LowerTeethMesh"]
    actor = teeth
    while actor.parent is not None:
        actor = actor.parent
    print(f"objects: {', '.join(sorted(thing.name for thing in bpy.data.objects))}")
    print(f"Blender {bpy.app.version_string}: frames {scene.frame_start} .. {scene.frame_end}")

    travelled_mm, rest = 0.0, None
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        to_actor = actor.matrix_world.inverted() @ teeth.matrix_world
        place = to_actor @ teeth.data.vertices[0].co
        rest = place.copy() if rest is None else rest
        travelled_mm = max(travelled_mm, (place - rest).length)
    print(f"the first vertex of the lower teeth travels up to {travelled_mm:.1f} mm from its place in the first frame")

    bpy.ops.object.light_add(type="SUN")
    bpy.ops.object.camera_add()
    scene.camera = bpy.context.object
    bpy.ops.wm.save_as_mainfile(filepath=str(out.resolve()))
    print(out)


if __name__ == "__main__":
    try:
        import bpy  # noqa: F401
    except ModuleNotFoundError:
        print("bpy is not installed here: pip install bpy==4.5.15, or run this file inside Blender.")
        sys.exit(1)
    given = [Path(argument) for argument in PROGRAM_ARGUMENTS]
    main(given[0] if given else Path("out/anim_capture.usdc"), given[1] if len(given) > 1 else Path("jaw.blend"))
    sys.stdout.flush()
