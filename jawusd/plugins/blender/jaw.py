"""Jaw rigs in a scene: sliders, drivers of the mandible, and keys read from the file."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import zlib
from collections.abc import Mapping
from typing import TYPE_CHECKING

import bpy
import numpy as np

from . import vendored

if TYPE_CHECKING:
    from pxr import Sdf, Usd

PrimMap = Mapping["Sdf.Path", list[bpy.types.ID]]  # prim paths to the objects and data-blocks created from them

SOURCE, KEEP, FPS = "jawusd_source", "keep_valid", "jawusd_fps"
_STORE, _ACTOR, _FIXED = "jawusd_rig", "jawusd_actor", "jawusd_fixed"
_FUNCTION, _OLD_FUNCTION = "jawusd_offset", "jawusd_channel"
# Channels that the drivers set. A driver that fails, because the add-on is missing or scripts are disabled, evaluates
# to 0. The mandible's transform is therefore its rest pose, and the drivers set offsets that are 0 at rest: the delta
# location, and x, y, z of the delta rotation, whose w is constant.
_CHANNELS = (*(("delta_location", i) for i in range(3)), *(("delta_rotation_quaternion", i) for i in (1, 2, 3)))
# The w of the delta rotation, which Blender normalises. It is large because Blender 5.0 rounds driven values within
# 1e-4 of 0 or 1, which for a unit quaternion would move the chin by up to 0.02 mm.
_QUATERNION_W = 1024.0

_rigs: dict[str, vendored.JawRig] = {}  # evaluators by the rig text stored in the actor
_poses: dict[tuple[str, float, float, float, bool], tuple[float, ...]] = {}


def link_rigs(stage: Usd.Stage, prim_map: PrimMap) -> bool:
    """Add sliders, drivers and keys to the rigs of an imported stage; return whether the stage has rigs.

    Rigs that cannot have sliders are left as imported; the panel displays the reason.
    """
    from . import vendored_usd

    prims = vendored_usd.rig_prims(stage)
    for prim in prims:
        moving = prim.GetRelationship("jaw:mandible").GetTargets()[0]
        actor, mandible = (_object_of(prim_map, path) for path in (prim.GetPath(), moving))
        if actor is None or mandible is None:
            _note_missing_sliders(prim, _nearest_object(prim_map, prim.GetPath()))
            continue
        if any(modifier.type == "ARMATURE" for mesh in meshes_of(mandible) for modifier in mesh.modifiers):
            actor[_FIXED] = f"{prim.GetPath()}: bones move it. To get sliders, import it with motion = transforms."
            continue
        actor[SOURCE] = _source_of(prim)
        actor[FPS] = stage.GetTimeCodesPerSecond()
        with vendored.naming_file(actor[SOURCE]):
            rig = vendored_usd.rig_of(prim)
        actor[_STORE] = _text_of(rig)
        values = [prim.GetAttribute(f"jaw:{name}").Get() or 0.0 for name in vendored.PARAMETERS]
        _add_sliders(actor, rig, values)
        drive(mandible, actor)
        _key(actor, prim)
    return bool(prims)


def _note_missing_sliders(prim: Usd.Prim, nearest: bpy.types.Object | None) -> None:
    """Store in an object why a rig below it has no sliders."""
    if prim.IsInstance() or prim.IsInstanceProxy():
        why = 'it is instanced. To get sliders, import it with "Scene Instancing" off.'
    else:
        why = "its mandible was not imported. To get sliders, import the whole rig."
    print(f"jawusd: {prim.GetPath()}: {why}")
    if nearest is not None:
        nearest[_FIXED] = "\n".join(filter(None, (nearest.get(_FIXED), f"{prim.GetPath()}: {why}")))


def without_sliders() -> list[str]:
    """Return a line for each rig in the file that has no sliders: its prim, the reason, and the remedy."""
    return [line for found in bpy.data.objects for line in str(found.get(_FIXED, "")).splitlines()]


def actors() -> list[bpy.types.Object]:
    """Return the objects that have a rig."""
    return [found for found in bpy.data.objects if _STORE in found]


def mandible_of(actor: bpy.types.Object) -> bpy.types.Object:
    """Return the mandible of an actor.

    Children are searched first: in reopened files, mandibles of library overrides refer to the actor in the library.

    Raises:
        vendored.JawusdError: The mandible was deleted.
    """
    below = [found for found in actor.children_recursive if _ACTOR in found]
    below += [found for found in bpy.data.objects if found.get(_ACTOR) == actor]
    if not below:
        raise vendored.JawusdError(f"the mandible of {actor.name} was deleted.", hint="Import the rig again.")
    return below[0]


def meshes_of(mandible: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the meshes at and below a mandible."""
    return [found for found in (mandible, *mandible.children_recursive) if found.type == "MESH"]


def rig_of(actor: bpy.types.Object) -> vendored.JawRig:
    """Return the evaluator of an actor, cached by its stored text; raises JawusdError if an older add-on stored it."""
    text = actor[_STORE]
    if text not in _rigs:
        if text.startswith("{"):
            raise vendored.JawusdError("was imported by an older version of the add-on.", hint="Import the rig again.")
        with np.load(io.BytesIO(zlib.decompress(base64.b64decode(text))), allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        _rigs[text] = vendored.JawRig(arrays, json.loads(str(arrays.pop("meta"))))
    return _rigs[text]


def parameters(actor: bpy.types.Object) -> tuple[float, float, float]:
    """Return the slider values d1, d2, d3 [mm]."""
    d1, d2, d3 = (float(actor[name]) for name in vendored.PARAMETERS)
    return d1, d2, d3


def shown(actor: bpy.types.Object, d: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the displayed parameters [mm]: d, projected into the bound if the actor's "Keep valid" is on."""
    return _kept(rig_of(actor), d) if actor.get(KEEP) else d


def _kept(rig: vendored.JawRig, d: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return parameters [mm] projected into the bound."""
    if rig.is_inside(d):
        return d
    d1, d2, d3 = rig.keep_inside([0.0], [d]).d[0].tolist()
    return d1, d2, d3


def _text_of(rig: vendored.JawRig) -> str:
    """Return a rig as text that a scene can store."""
    packed = io.BytesIO()
    # Blender's numpy lacks the argument `allow_pickle`, which the type stubs require.
    np.savez(packed, **{**rig.arrays, "meta": np.array(json.dumps(rig.meta))})  # type: ignore[arg-type]  # flags are named
    return base64.b64encode(zlib.compress(packed.getvalue())).decode()


def _source_of(prim: Usd.Prim) -> str:
    """Return the file that defines a rig, usually `actor.usda`, even if the stage only references it."""
    for spec in prim.GetPrimStack():
        if spec.HasInfo("apiSchemas") and spec.layer.realPath:
            return str(spec.layer.realPath).split("[")[0]
    return str(prim.GetStage().GetRootLayer().realPath)


def _object_of(prim_map: PrimMap, path: Sdf.Path) -> bpy.types.Object | None:
    """Return the object created from a prim, or from its only child if Blender merged the two prims."""
    below = [other for other in prim_map if str(other).startswith(f"{path}/")]
    return next((found for other in (path, *below) for found in _objects(prim_map, other)), None)


def _nearest_object(prim_map: PrimMap, path: Sdf.Path) -> bpy.types.Object | None:
    """Return the object created from a prim or, if there is none, from its nearest ancestor."""
    return next((found for other in reversed(path.GetPrefixes()) for found in _objects(prim_map, other)), None)


def _objects(prim_map: PrimMap, path: Sdf.Path) -> list[bpy.types.Object]:
    return [found for found in prim_map.get(path, []) if isinstance(found, bpy.types.Object)]


def _add_sliders(actor: bpy.types.Object, rig: vendored.JawRig, values: list[float]) -> None:
    for name, value in zip(vendored.PARAMETERS, values):
        actor[name] = float(value)
    actor[KEEP] = False
    actor.id_properties_ui(KEEP).update(
        description="Show the nearest valid pose when the sliders are outside the bound"
    )
    _set_limits(actor, rig)
    for name in (*vendored.PARAMETERS, KEEP):
        actor.property_overridable_library_set(f'["{name}"]', True)


def _set_limits(actor: bpy.types.Object, rig: vendored.JawRig) -> None:
    """Set the range of the sliders. The hard range is far wider, since Blender clamps keyed values to it."""
    for name, label, (low, high) in zip(vendored.PARAMETERS, vendored.LABELS, rig.d_range.tolist()):
        slack = high - low
        ui = actor.id_properties_ui(name)
        ui.update(min=low - slack, max=high + slack, soft_min=low, soft_max=high, description=label, precision=2)


def drive(mandible: bpy.types.Object, actor: bpy.types.Object) -> None:
    """Drive the mandible by the actor's d1, d2, d3 instead of by keys or by the motion cached from the file."""
    for constraint in list(mandible.constraints):
        if constraint.type == "TRANSFORM_CACHE":
            mandible.constraints.remove(constraint)
    remove_drivers(mandible)
    mandible[_ACTOR] = actor
    mandible.rotation_mode = "QUATERNION"
    rest = rig_of(actor).pose((0.0, 0.0, 0.0))
    mandible.location, mandible.rotation_quaternion = rest[:3, 3], vendored.wxyz_from_matrix(rest[:3, :3])
    mandible.delta_rotation_quaternion = (_QUATERNION_W, 0.0, 0.0, 0.0)
    for channel, (path, index) in enumerate(_CHANNELS):
        driver = mandible.driver_add(path, index).driver
        driver.type = "SCRIPTED"
        driver.use_self = True
        for name in (*vendored.PARAMETERS, KEEP):
            variable = driver.variables.new()
            variable.name = name
            variable.targets[0].id = actor
            variable.targets[0].data_path = f'["{name}"]'
        driver.expression = f"{_FUNCTION}(self, d1, d2, d3, {KEEP}, {channel})"


def remove_drivers(mandible: bpy.types.Object) -> None:
    """Remove the drivers of a mandible, and reset its delta transform."""
    for curve in _drivers(mandible, (_FUNCTION, _OLD_FUNCTION)):
        mandible.driver_remove(curve.data_path, curve.array_index)
    mandible.delta_location, mandible.delta_rotation_quaternion = [0.0] * 3, [1.0, 0.0, 0.0, 0.0]


def is_driven(mandible: bpy.types.Object) -> bool:
    """Return whether a mandible is moved by the sliders and not by its own keys."""
    return bool(_drivers(mandible, (_FUNCTION,)))


def _drivers(mandible: bpy.types.Object, functions: tuple[str, ...]) -> list[bpy.types.FCurve]:
    """Return the drivers of a mandible that call one of the named functions."""
    data = mandible.animation_data
    return [curve for curve in data.drivers if curve.driver.expression.startswith(functions)] if data else []


def _key(actor: bpy.types.Object, prim: Usd.Prim) -> None:
    """Key the sliders with the samples and splines of the USD file, linearly interpolated."""
    from . import vendored_usd

    for name in vendored.PARAMETERS:
        attribute = prim.GetAttribute(f"jaw:{name}")
        times = vendored_usd.key_times(attribute)
        for time, value in zip(times, vendored_usd.values_at(attribute, times)):
            if value is not None:
                actor[name] = value
                actor.keyframe_insert(f'["{name}"]', frame=time)
    for curve in curves(actor):
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"


def curves(found: bpy.types.Object) -> list[bpy.types.FCurve]:
    """Return the animation curves of an object's action."""
    return [curve for collection in curve_lists(found) for curve in collection]


def curve_lists(found: bpy.types.Object) -> list[bpy.types.bpy_prop_collection[bpy.types.FCurve]]:
    """Return the curve collections of an object's action slot (Blender 4.4 and later) or of its action."""
    data = found.animation_data
    if data is None or data.action is None:
        return []
    if not hasattr(data.action, "slots"):
        return [data.action.fcurves]
    bags = [bag for layer in data.action.layers for strip in layer.strips for bag in strip.channelbags]
    return [bag.fcurves for bag in bags if bag.slot_handle == data.action_slot_handle]


def _offset(mandible: bpy.types.Object, d1: float, d2: float, d3: float, keep: float, channel: int) -> float:
    """Return one channel of the mandible's offset from its rest pose [mm]; this is the driver function."""
    actor = mandible[_ACTOR]
    key = (actor[_STORE], d1, d2, d3, bool(keep))
    if key not in _poses:
        _poses.clear()  # keep only the latest pose, since the six channels of a pose are evaluated in succession
        rig = rig_of(actor)
        T, rest = rig.pose(_kept(rig, (d1, d2, d3)) if keep else (d1, d2, d3)), rig.pose((0.0, 0.0, 0.0))
        w, *turn = vendored.wxyz_from_matrix(T[:3, :3] @ rest[:3, :3].T).tolist()
        _poses[key] = (*(T[:3, 3] - rest[:3, 3]).tolist(), *(_QUATERNION_W / w * x for x in turn))
    return _poses[key][channel]


@bpy.app.handlers.persistent
def _install(*_: object) -> None:
    """Register the driver function, which Blender discards whenever it opens a file."""
    bpy.app.driver_namespace[_FUNCTION] = _offset
    _poses.clear()
    for mandible in (found for found in bpy.data.objects if _ACTOR in found):
        if _drivers(mandible, (_OLD_FUNCTION,)):
            with contextlib.suppress(vendored.JawusdError):  # the error is displayed by the panel
                drive(mandible, mandible[_ACTOR])
        # Blender disables drivers whose function is missing; setting the expression makes it try again.
        for curve in _drivers(mandible, (_FUNCTION,)):
            curve.driver.expression = str(curve.driver.expression)


def register() -> None:
    """Install the driver function in the current file and in files opened later."""
    bpy.app.driver_namespace[_FUNCTION] = _offset
    bpy.app.handlers.load_post.append(_install)
    bpy.app.timers.register(_install, first_interval=0.0)  # add-ons cannot access objects while they are being enabled


def unregister() -> None:
    """Remove the driver function."""
    if bpy.app.timers.is_registered(_install):
        bpy.app.timers.unregister(_install)
    bpy.app.handlers.load_post.remove(_install)
    bpy.app.driver_namespace.pop(_FUNCTION, None)
