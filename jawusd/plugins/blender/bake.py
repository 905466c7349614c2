"""Bake drivers to keys, which FBX, glTF, game engines, and Blender without the add-on need."""

from __future__ import annotations

import bpy
import numpy as np

from . import jaw, vendored

#: Export operators that write keys but not drivers, each with advice on its relevant settings.
SETTINGS = {
    "EXPORT_SCENE_OT_fbx": {
        "bake_anim_simplify_factor": "0: keep every frame; 1 costs up to 0.05 mm in slow motion",
        "bake_anim_use_all_actions": "Turn off if other objects are animated,",
        "bake_anim_use_nla_strips": "and this as well",
    },
    "EXPORT_SCENE_OT_gltf": {},
    "WM_OT_collada_export": {},
}
_CHANNELS = ("location", "rotation_quaternion")
# Custom property with the name of a property that is unique to the mandible. FBX export assigns an action to every
# object that has all channels of the action; a channel for the unique property prevents this.
_OWN = "jawusd_own"
_LINEAR = 1  # Blender's enum value for linear interpolation


def warning(scene: bpy.types.Scene) -> str | None:
    """Return a warning if the exporters in `SETTINGS` would lose motion of a scene; otherwise, None."""
    names = [found.name for found in scene.objects if jaw.is_driven(found)]
    return f"{', '.join(names)} will not move: its motion is on the sliders. Bake it to keys first." if names else None


def parameters_over(actor: bpy.types.Object, scene: bpy.types.Scene, frames: range) -> vendored.Array:
    """Return the displayed d of an actor in each frame, shape (F, 3) [mm]; restore the scene's current frame."""
    present, subframe, d = scene.frame_current, scene.frame_subframe, []
    for frame in frames:
        scene.frame_set(frame)
        d.append(jaw.shown(actor, jaw.parameters(actor)))
    scene.frame_set(present, subframe=subframe)
    return np.array(d)


def frames_of(actor: bpy.types.Object, scene: bpy.types.Scene, span: str) -> range:
    """Return the frames of the scene, or of an actor's take, first to last slider key; raises JawusdError if none."""
    if span == "SCENE":
        return range(scene.frame_start, scene.frame_end + 1)
    times = [point.co[0] for curve in jaw.curves(actor) for point in curve.keyframe_points]
    if not times:
        raise vendored.JawusdError(f"the sliders of {actor.name} have no keys.", hint="Bake the frames of the scene.")
    return range(int(np.floor(min(times))), int(np.ceil(max(times))) + 1)


def bake(actor: bpy.types.Object, scene: bpy.types.Scene, frames: range) -> None:
    """Key the mandible of an actor at every frame according to its sliders, and remove the drivers.

    Raises:
        vendored.JawusdError: The mandible belongs to another file, or was deleted.
    """
    mandible = jaw.mandible_of(actor)
    if not mandible.is_editable or mandible.override_library is not None:
        raise vendored.JawusdError(
            f"{mandible.name} belongs to another file, whose drivers cannot be removed here.",
            hint="Bake it in that file, or make actor and mandible local.",
        )
    T = jaw.rig_of(actor).pose(parameters_over(actor, scene, frames))
    values = np.concatenate([T[:, :3, 3], vendored.continuous_wxyz(T[:, :3, :3])], axis=1)
    jaw.remove_drivers(mandible)
    remove_baked_keys(mandible)
    mandible[_OWN] = f"{mandible.name} keys"[:60]
    mandible[mandible[_OWN]] = True
    for path in (*_CHANNELS, _own_path(mandible)):
        mandible.keyframe_insert(path, frame=frames[0])
    for curve in (found for found in jaw.curves(mandible) if found.data_path in _CHANNELS):
        column = values[:, 3 * _CHANNELS.index(curve.data_path) + curve.array_index]
        points = curve.keyframe_points
        points.add(len(frames) - len(points))
        points.foreach_set("co", np.column_stack([frames, column]).astype(np.float32).ravel())
        points.foreach_set("interpolation", np.full(len(frames), _LINEAR, dtype=np.int32))
        curve.update()
    scene.frame_set(scene.frame_current, subframe=scene.frame_subframe)


def remove_baked_keys(mandible: bpy.types.Object) -> None:
    """Remove the keys that `bake` added to a mandible."""
    for collection in jaw.curve_lists(mandible):
        for curve in [curve for curve in collection if curve.data_path in (*_CHANNELS, _own_path(mandible))]:
            collection.remove(curve)
    data = mandible.animation_data
    if data is not None and data.action is not None and not jaw.curves(mandible):
        action, data.action = data.action, None
        if action.users == 0:
            bpy.data.actions.remove(action)


def _own_path(mandible: bpy.types.Object) -> str:
    return f'["{bpy.utils.escape_identifier(str(mandible.get(_OWN, "")))}"]'
