"""Jaw rigs in a scene: drivers of the mandible, slider ranges that follow the opening, keys from the file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import bpy

from . import jawusd_reader

if TYPE_CHECKING:
    from pxr import Sdf, Usd

PrimMap = Mapping["Sdf.Path", list[bpy.types.ID]]  # prim path to the objects and data made from it

_STORE, _ACTOR, _FPS = "jawusd_rig", "jawusd_actor", "jawusd_fps"
_FUNCTION = "jawusd_channel"
_CHANNELS = (("location", 3), ("rotation_quaternion", 4))
# Blender 5.0 snaps driven values within 1e-4 of a whole number to it, in a unit quaternion up to 0.02 mm at the chin.
# It normalises quaternions before use, so longer ones lose nothing.
_QUATERNION_LENGTH = 1024.0

_rigs: dict[str, jawusd_reader.Rig] = {}  # by the text stored in the actor
_poses: dict[tuple[str, float, float, float], tuple[float, ...]] = {}
_parameters: dict[str, tuple[float, float, float]] = {}  # by actor, as last seen


def link_rigs(stage: Usd.Stage, prim_map: PrimMap) -> bool:
    """Add sliders, drivers and keys to the rigs of an imported stage; return whether there is one."""
    prims = jawusd_reader.find_rigs(stage)
    for prim in prims:
        mandible_path = prim.GetRelationship("jaw:mandible").GetTargets()[0]
        actor = _object_of(prim_map, prim.GetPath())
        mandible = _object_of(prim_map, mandible_path)
        if actor is None or mandible is None:
            print(f"jawusd: {prim.GetPath()} was not imported with its mandible; the rig stays as baked")
            continue
        rig = jawusd_reader.from_prim(prim)
        actor[_STORE] = rig.to_json()
        actor[_FPS] = stage.GetTimeCodesPerSecond()
        _add_sliders(actor, rig, [prim.GetAttribute(f"jaw:{name}").Get() or 0.0 for name in jawusd_reader.PARAMETERS])
        _drive(mandible, actor)
        _key(actor, prim)
        update_ranges(actor)
    return bool(prims)


def actors() -> list[bpy.types.Object]:
    """Return the objects that carry a rig."""
    return [found for found in bpy.data.objects if _STORE in found]


def rig_of(actor: bpy.types.Object) -> jawusd_reader.Rig:
    """Return the evaluator of an actor, built once per stored text."""
    text = actor[_STORE]
    if text not in _rigs:
        _rigs[text] = jawusd_reader.from_json(text)
    return _rigs[text]


def update_ranges(actor: bpy.types.Object) -> None:
    """Set the slider limits of d2 and d3 to what is valid at the present d1, with the other one as it is."""
    rig = rig_of(actor)
    d1, d2, d3 = (actor[name] for name in jawusd_reader.PARAMETERS)
    _parameters[actor.name_full] = (d1, d2, d3)
    # along each axis through the present value of the other; where that leaves nothing, through the path itself
    for name, found, fallback in zip(jawusd_reader.PARAMETERS[1:], rig.ranges(d1, d2, d3), rig.ranges(d1)):
        low, high = found if found[0] == found[0] else fallback
        if low == low:
            actor.id_properties_ui(name).update(min=low, max=high, soft_min=low, soft_max=high)


def _object_of(prim_map: PrimMap, path: Sdf.Path) -> bpy.types.Object | None:
    """Return the object made from a prim; of a prim merged with its only child, the child's."""
    exact = [found for found in prim_map.get(path, []) if isinstance(found, bpy.types.Object)]
    if exact:
        return exact[0]
    for other, made in prim_map.items():
        if str(other).startswith(f"{path}/"):
            for found in made:
                if isinstance(found, bpy.types.Object):
                    return found
    return None


def _add_sliders(actor: bpy.types.Object, rig: jawusd_reader.Rig, values: list[float]) -> None:
    for name, label, value, (low, high) in zip(jawusd_reader.PARAMETERS, jawusd_reader.LABELS, values, rig.d_range):
        actor[name] = float(value)
        ui = actor.id_properties_ui(name)
        ui.update(min=low, max=high, soft_min=low, soft_max=high, description=label, precision=2)
        actor.property_overridable_library_set(f'["{name}"]', True)


def _drive(mandible: bpy.types.Object, actor: bpy.types.Object) -> None:
    """Let d1, d2, d3 of the actor drive the mandible, instead of the cached motion of the file."""
    for constraint in list(mandible.constraints):
        if constraint.type == "TRANSFORM_CACHE":
            mandible.constraints.remove(constraint)
    mandible[_ACTOR] = actor
    mandible.rotation_mode = "QUATERNION"
    channel = 0
    for path, count in _CHANNELS:
        for index in range(count):
            driver = mandible.driver_add(path, index).driver
            driver.type = "SCRIPTED"
            driver.use_self = True
            for name in jawusd_reader.PARAMETERS:
                variable = driver.variables.new()
                variable.name = name
                variable.targets[0].id = actor
                variable.targets[0].data_path = f'["{name}"]'
            driver.expression = f"{_FUNCTION}(self, d1, d2, d3, {channel})"
            channel += 1


def _key(actor: bpy.types.Object, prim: Usd.Prim) -> None:
    """Give the sliders the samples of the file as linearly interpolated keys."""
    for name in jawusd_reader.PARAMETERS:
        attribute = prim.GetAttribute(f"jaw:{name}")
        times = attribute.GetTimeSamples()
        for time in times:
            actor[name] = attribute.Get(time)
            actor.keyframe_insert(f'["{name}"]', frame=time)
    for curve in curves(actor):
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"


def curves(actor: bpy.types.Object) -> list[bpy.types.FCurve]:
    """Return the curves of the actor's action, in layers (Blender 4.4 and later) or without."""
    action = actor.animation_data.action if actor.animation_data else None
    if action is None:
        return []
    if not getattr(action, "layers", None):
        return list(action.fcurves)
    bags = [bag for layer in action.layers for strip in layer.strips for bag in strip.channelbags]
    return [curve for bag in bags for curve in bag.fcurves]


def _channel(mandible: bpy.types.Object, d1: float, d2: float, d3: float, channel: int) -> float:
    """Return one channel of the mandible's location (mm, the actor is scaled) and quaternion: the driver function."""
    actor = mandible[_ACTOR]
    key = (actor.name_full, d1, d2, d3)
    if key not in _poses:
        _poses.clear()  # the seven channels of one pose follow one another
        translation, wxyz = jawusd_reader.decompose(rig_of(actor).pose(d1, d2, d3))
        _poses[key] = (*translation, *(_QUATERNION_LENGTH * x for x in wxyz))
    return _poses[key][channel]


@bpy.app.handlers.persistent
def _install(*_: object) -> None:
    """Register the driver function, which Blender drops with every file it opens."""
    bpy.app.driver_namespace[_FUNCTION] = _channel
    _poses.clear()
    _parameters.clear()


@bpy.app.handlers.persistent
def _follow(*_: object) -> None:
    """Update the ranges of every actor whose sliders have moved."""
    for actor in actors():
        if _parameters.get(actor.name_full) != tuple(actor[name] for name in jawusd_reader.PARAMETERS):
            update_ranges(actor)


_HANDLERS = (("load_post", _install), ("depsgraph_update_post", _follow), ("frame_change_post", _follow))


def register() -> None:
    """Install the driver function and the handlers."""
    _install()
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    """Remove them."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).remove(handler)
    bpy.app.driver_namespace.pop(_FUNCTION, None)
