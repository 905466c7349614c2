"""Handles at the chin or the incisor; dragging a handle moves the sliders by inverse kinematics, inside the bound."""

from __future__ import annotations

import bpy
import numpy as np

from . import jaw, vendored

_POINT, _ACTOR = "jawusd_point", "jawusd_handle_of"
_MOVED_MM = 1e-3  # minimum displacement of a handle that counts as a drag, greater than single-precision rounding


def add(actor: bpy.types.Object, point: tuple[float, float, float], name: str) -> bpy.types.Object:
    """Add a handle at a point of the mandible [mm], in the mandible frame, and return it."""
    handle = bpy.data.objects.new(name, None)
    handle.empty_display_type, handle.empty_display_size = "SPHERE", 3.0
    for collection in actor.users_collection:
        collection.objects.link(handle)
    handle.parent = actor
    handle[_POINT], handle[_ACTOR] = point, actor
    _snap(handle)
    return handle


def handles() -> list[bpy.types.Object]:
    """Return all handles in the current file."""
    return [found for found in bpy.data.objects if _POINT in found and found.get(_ACTOR) is not None]


def _position(handle: bpy.types.Object) -> vendored.Array:
    """Return the current position of a handle's point [mm], skull frame."""
    actor = handle[_ACTOR]
    T = jaw.rig_of(actor).pose(jaw.shown(actor, jaw.parameters(actor)))
    return vendored.transform_point(T, np.array(handle[_POINT]))


def _snap(handle: bpy.types.Object) -> None:
    handle.location = _position(handle)


def follow(handle: bpy.types.Object) -> bool:
    """Move the sliders so that a handle's point follows the handle; return whether the handle was dragged."""
    target = np.array(handle.location, dtype=np.float64)
    if np.linalg.norm(target - _position(handle)) <= _MOVED_MM:
        return False
    actor = handle[_ACTOR]
    d = jaw.rig_of(actor).ik(np.array(handle[_POINT]), target, start=jaw.parameters(actor)).d
    for name, value in zip(vendored.PARAMETERS, d.tolist()):
        actor[name] = value
    _snap(handle)
    actor.update_tag()
    return True


@bpy.app.handlers.persistent
def _dragged(_: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Move the sliders to follow dragged handles, and the handles to follow jaws that were moved in other ways."""
    moved = {update.id.original for update in depsgraph.updates if isinstance(update.id, bpy.types.Object)}
    for handle in handles():
        if handle in moved and not jaw.curves(handle):
            follow(handle)
        elif handle[_ACTOR] in moved and np.linalg.norm(_position(handle) - np.array(handle.location)) > _MOVED_MM:
            _snap(handle)


@bpy.app.handlers.persistent
def _played(*_: object) -> None:
    for handle in handles():
        _snap(handle)


_HANDLERS = (("depsgraph_update_post", _dragged), ("frame_change_post", _played))


def register() -> None:
    """Install the handlers that synchronise handles and sliders."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    """Remove the handlers installed by `register`."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).remove(handler)
