"""Valid rigs of both kinds, and what reads them."""

import numpy as np
from example_rig import example_meshes, example_motion, example_rig, forget_checksums


def write_rig(folder, kind):
    from jawusd.rig.animation import write_animation
    from jawusd.rig.bake import bake_rig

    frames, d = example_motion(8)
    bake_rig(folder, example_rig(kind), example_meshes(), name="a", fps=24.0, frames=frames, d=d, table_size=17)
    forget_checksums(folder)  # damage shall reach the readers
    for name in ("anim.usda", "anim.usdc"):
        write_animation(folder / name, folder / "actor.usda", frames, d, 24.0)
    return folder


def read_rig(place, path):
    from jawusd.base.errors import JawusdError
    from jawusd.rig import describe, load_rig
    from jawusd.rig.geo import read_geometry, read_gum
    from jawusd.rig.motion_read import read_parameters_of_stage, read_poses_of_stage

    shown = path if path.suffix == ".usdz" or path.name.startswith("anim") else place / "actor.usda"
    uses_a_rig = path.name.startswith("anim")
    try:
        rig = load_rig(shown)
        rig.margin(rig.pose([[5.0, 0.1, 0.0]])[:, :3, 3])
        describe(shown)
        if path.name == "geo.usdc":
            read_geometry(path)
            read_gum(path)
        if uses_a_rig:
            read_parameters_of_stage(shown)
            read_poses_of_stage(shown)
    except JawusdError as refusal:
        # A shot may refer to a layer elsewhere, which is opened only to find that it is not a rig.
        if not (uses_a_rig and "outside the folder of this file and not a rig" in str(refusal)):
            _check_inside(place)
        raise
    _check_inside(place)


def read_shot(place, path):
    from jawusd.rig import validate_stage

    validate_stage(path)
    _check_inside(place)
    read_rig(place, path)


def _check_inside(place):
    from pxr import Sdf

    inside = str(place.resolve())
    for layer in Sdf.Layer.GetLoadedLayers():
        real = layer.realPath
        if real and not real.startswith(inside) and "/pxr/" not in real and "generatedSchema" not in real:
            raise PermissionError(f"escaped: {real}")


def onnx_reader(rig):
    def read(place, path):
        from jawusd.rig.onnx_sidecar import onnx_error_mm

        onnx_error_mm(path, rig, np.array([[5.0, 0.2, 0.1]]))

    return read
