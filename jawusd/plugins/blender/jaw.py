"""Jaw rigs in a scene: sliders, drivers of the mandible, keys from the file."""

from __future__ import annotations

import base64
import io
import json
import zlib
from collections.abc import Mapping
from typing import TYPE_CHECKING

import bpy
import numpy as np

from . import carried

if TYPE_CHECKING:
    from pxr import Sdf, Usd

PrimMap = Mapping["Sdf.Path", list[bpy.types.ID]]  # prim path to the objects and data made from it

SOURCE, KEEP, FPS = "jawusd_source", "keep_valid", "jawusd_fps"
_STORE, _ACTOR = "jawusd_rig", "jawusd_actor"
_FUNCTION = "jawusd_channel"
_CHANNELS = (("location", 3), ("rotation_quaternion", 4))
# Blender 5.0 sets driven values within 1e-4 of 0 or 1 to it: in a unit quaternion up to 0.02 mm at the chin. Places are
# driven this far from where they are, and moved back by `delta_location`; quaternions are normalised before use, so
# longer ones lose nothing.
_AWAY_MM, _QUATERNION_LENGTH = 256.0, 1024.0

_rigs: dict[str, carried.JawRig] = {}  # by the text stored in the actor
_poses: dict[tuple[str, float, float, float, bool], tuple[float, ...]] = {}


def link_rigs(stage: Usd.Stage, prim_map: PrimMap) -> bool:
    """Add sliders, drivers and keys to the rigs of an imported stage; return whether there is one.

    Rigs that bones move are left to them: drivers would move the mandible once more.
    """
    from . import carried_usd

    prims = carried.find_rigs(stage)
    for prim in prims:
        mandible_path = prim.GetRelationship("jaw:mandible").GetTargets()[0]
        actor = _object_of(prim_map, prim.GetPath())
        mandible = _object_of(prim_map, mandible_path)
        if actor is None or mandible is None:
            print(f"jawusd: {prim.GetPath()} was not imported with its mandible; the rig stays as baked")
            continue
        if any(modifier.type == "ARMATURE" for mesh in meshes_of(mandible) for modifier in mesh.modifiers):
            print(f"jawusd: bones move {prim.GetPath()}; for sliders import it with motion = transforms")
            continue
        actor[SOURCE] = _source_of(prim)
        actor[FPS] = stage.GetTimeCodesPerSecond()
        rig = carried_usd.rig_of(prim, actor[SOURCE])
        actor[_STORE] = _text_of(rig)
        values = [prim.GetAttribute(f"jaw:{name}").Get() or 0.0 for name in carried.PARAMETERS]
        _add_sliders(actor, rig, values)
        drive(mandible, actor)
        _key(actor, prim)
    return bool(prims)


def actors() -> list[bpy.types.Object]:
    """Return the objects that carry a rig."""
    return [found for found in bpy.data.objects if _STORE in found]


def mandible_of(actor: bpy.types.Object) -> bpy.types.Object:
    """Return the object that an actor moves.

    Library overrides of reopened files point to the actor in the library: there the hierarchy tells.
    """
    below = [found for found in actor.children_recursive if _ACTOR in found]
    return below[0] if below else next(found for found in bpy.data.objects if found.get(_ACTOR) == actor)


def meshes_of(mandible: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the meshes that a mandible carries, its own among them."""
    return [found for found in (mandible, *mandible.children_recursive) if found.type == "MESH"]


def rig_of(actor: bpy.types.Object) -> carried.JawRig:
    """Return the evaluator of an actor, built once per stored text.

    Raises:
        carried.JawusdError: An older version of the add-on stored it.
    """
    text = actor[_STORE]
    if text not in _rigs:
        if text.startswith("{"):
            raise carried.JawusdError("was imported by an older version of the add-on.", hint="Import the rig again.")
        with np.load(io.BytesIO(zlib.decompress(base64.b64decode(text))), allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        _rigs[text] = carried.JawRig(arrays, json.loads(str(arrays.pop("meta"))))
    return _rigs[text]


def parameters(actor: bpy.types.Object) -> tuple[float, float, float]:
    """Return d1, d2, d3 [mm] as the sliders show them."""
    d1, d2, d3 = (float(actor[name]) for name in carried.PARAMETERS)
    return d1, d2, d3


def shown(actor: bpy.types.Object, d: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the parameters [mm] that the mandible takes: d, brought inside the bound where the actor keeps valid."""
    return _kept(rig_of(actor), d) if actor.get(KEEP) else d


def _kept(rig: carried.JawRig, d: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return parameters [mm] brought inside the bound."""
    if rig.is_inside(d):
        return d
    d1, d2, d3 = rig.keep_inside([0.0], [d]).d[0].tolist()
    return d1, d2, d3


def _text_of(rig: carried.JawRig) -> str:
    """Return a rig as text that a scene can store."""
    packed = io.BytesIO()
    # Blender's numpy has no argument `allow_pickle`, which the types expect
    np.savez(packed, **{**rig.arrays, "meta": np.array(json.dumps(rig.meta))})  # type: ignore[arg-type]  # flags are named
    return base64.b64encode(zlib.compress(packed.getvalue())).decode()


def _source_of(prim: Usd.Prim) -> str:
    """Return the file that defines a rig, `actor.usda` as a rule, also where a stage references it."""
    for spec in prim.GetPrimStack():
        if spec.HasInfo("apiSchemas") and spec.layer.realPath:
            return str(spec.layer.realPath).split("[")[0]
    return str(prim.GetStage().GetRootLayer().realPath)


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


def _add_sliders(actor: bpy.types.Object, rig: carried.JawRig, values: list[float]) -> None:
    for name, value in zip(carried.PARAMETERS, values):
        actor[name] = float(value)
    actor[KEEP] = False
    actor.id_properties_ui(KEEP).update(description="Show the nearest valid jaw where the sliders leave the bound")
    _set_limits(actor, rig)
    for name in (*carried.PARAMETERS, KEEP):
        actor.property_overridable_library_set(f'["{name}"]', True)


def _set_limits(actor: bpy.types.Object, rig: carried.JawRig) -> None:
    """Let sliders end at the whole range; Blender clamps keyed values to the hard limits, so these lie far beyond."""
    for name, label, (low, high) in zip(carried.PARAMETERS, carried.LABELS, rig.d_range.tolist()):
        slack = high - low
        ui = actor.id_properties_ui(name)
        ui.update(min=low - slack, max=high + slack, soft_min=low, soft_max=high, description=label, precision=2)


def drive(mandible: bpy.types.Object, actor: bpy.types.Object) -> None:
    """Let d1, d2, d3 of the actor drive the mandible, instead of the cached motion of the file."""
    for constraint in list(mandible.constraints):
        if constraint.type == "TRANSFORM_CACHE":
            mandible.constraints.remove(constraint)
    mandible[_ACTOR] = actor
    mandible.rotation_mode = "QUATERNION"
    mandible.delta_location = [-_AWAY_MM] * 3
    channel = 0
    for path, count in _CHANNELS:
        for index in range(count):
            driver = mandible.driver_add(path, index).driver
            driver.type = "SCRIPTED"
            driver.use_self = True
            for name in (*carried.PARAMETERS, KEEP):
                variable = driver.variables.new()
                variable.name = name
                variable.targets[0].id = actor
                variable.targets[0].data_path = f'["{name}"]'
            driver.expression = f"{_FUNCTION}(self, d1, d2, d3, {KEEP}, {channel})"
            channel += 1


def release(mandible: bpy.types.Object) -> None:
    """Remove the drivers of a mandible; it goes back to where it is at rest in its parent."""
    for path, _ in _CHANNELS:
        mandible.driver_remove(path)
    mandible.delta_location = [0.0] * 3
    mandible.location, mandible.rotation_quaternion = [0.0] * 3, [1.0, 0.0, 0.0, 0.0]


def _key(actor: bpy.types.Object, prim: Usd.Prim) -> None:
    """Give the sliders the samples of the file as linearly interpolated keys."""
    for name in carried.PARAMETERS:
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


def _channel(mandible: bpy.types.Object, d1: float, d2: float, d3: float, keep: float, channel: int) -> float:
    """Return one channel of the mandible's location (mm, the actor is scaled) and quaternion: the driver function."""
    actor = mandible[_ACTOR]
    key = (actor[_STORE], d1, d2, d3, bool(keep))
    if key not in _poses:
        _poses.clear()  # the seven channels of one pose follow one another
        rig = rig_of(actor)
        T = rig.pose(_kept(rig, (d1, d2, d3)) if keep else (d1, d2, d3))
        turn = _QUATERNION_LENGTH * carried.wxyz_from_matrix(T[:3, :3])
        _poses[key] = (*(T[:3, 3] + _AWAY_MM).tolist(), *turn.tolist())
    return _poses[key][channel]


@bpy.app.handlers.persistent
def _install(*_: object) -> None:
    """Register the driver function, which Blender drops with every file it opens."""
    bpy.app.driver_namespace[_FUNCTION] = _channel
    _poses.clear()
    for mandible in bpy.data.objects:
        # Blender marks a driver whose function was missing as broken and does not try again
        for curve in mandible.animation_data.drivers if _ACTOR in mandible and mandible.animation_data else ():
            curve.driver.expression = str(curve.driver.expression)


def register() -> None:
    """Install the driver function, also in files to be opened and in the one that is open."""
    bpy.app.driver_namespace[_FUNCTION] = _channel
    bpy.app.handlers.load_post.append(_install)
    bpy.app.timers.register(_install, first_interval=0.0)  # add-ons see no objects while they are enabled


def unregister() -> None:
    """Remove it."""
    if bpy.app.timers.is_registered(_install):
        bpy.app.timers.unregister(_install)
    bpy.app.handlers.load_post.remove(_install)
    bpy.app.driver_namespace.pop(_FUNCTION, None)
