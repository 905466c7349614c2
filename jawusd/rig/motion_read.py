"""Read how the mandible moves in a stage, from its transforms or bones or from samples of d."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pxr import Usd, UsdGeom

from jawusd.base.arrays import Array
from jawusd.base.errors import FormatError
from jawusd.geometry.se3 import rigidity_defect
from jawusd.rig.animation import LOST
from jawusd.rig.bones import bones_of, place_in
from jawusd.rig.keys import MOST_FRAMES, key_times, time_codes, values_at
from jawusd.rig.layout import PARAMETERS
from jawusd.rig.read import find_rig_prim, open_stage
from jawusd.rig.untrusted import raises_format_error

_RIGID = 1e-5  # single-precision quaternions, as DCCs write them, stay below
_APART = 1e-4  # far more than the transforms of two meshes that move together differ by


@raises_format_error(0)
def read_poses_of_stage(path: str | os.PathLike[str], prim_path: str | None = None) -> tuple[NDArray[np.int64], Array]:
    """Read the poses of the mandible at every whole frame of a stage.

    Args:
        path: An animation layer of a rig, or a shot that references one.
        prim_path: Which rig, where the stage has several.

    Returns:
        Frame numbers (F,) and T_skull_mandible (F, 4, 4) [mm], relative to the actor.

    Raises:
        RigError: Not a stage.
        FormatError: No rig or several, no mandible, no motion, or one that is not rigid.
    """
    stage = open_stage(path)
    actor = find_rig_prim(stage, path, prim_path)
    times = frames_of_stage(stage, path)
    return times, poses_at(mandible_of(actor, path), actor, times, path)


def poses_at(mandible: Usd.Prim, actor: Usd.Prim, times: ArrayLike, path: object) -> Array:
    """Return where a mandible is in the world, relative to the skull, by transforms or by bones.

    Args:
        times: shape (F,); without any, the default time is read.

    Returns:
        T_skull_mandible [mm], shape (F, 4, 4), in the actor's units; without a skull relative to the actor.

    Raises:
        FormatError: The motion is not rigid.
    """
    codes = time_codes(np.asarray(times, dtype=np.float64))
    poses, skull = poses_in_actor(mandible, actor, codes, path), skull_of(actor, path)
    if skull is not None:
        poses = np.asarray(np.linalg.solve(poses_in_actor(skull, actor, codes, path), poses), np.float64)
    defect = rigidity_defect(poses)
    if not defect.max() <= _RIGID:
        worst = int(np.argmax(np.where(np.isfinite(defect), defect, np.inf)))
        raise FormatError(
            f"the mandible is not rigid at frame {codes[worst]} (off by {defect[worst]:.2g}, allowed {_RIGID:g}).",
            path=str(path),
            hint="Samples of matrices shear in between: key translate and orient.",
        )
    return poses


def poses_in_actor(prim: Usd.Prim, actor: Usd.Prim, times: Sequence[Usd.TimeCode], path: object) -> Array:
    """Return what carries the points of the meshes below a prim to the actor's frame, shape (F, 4, 4).

    Raises:
        FormatError: Bones bend the meshes, or they move in different ways.
    """
    bones = bones_of(prim)
    if bones is not None:
        return bones.poses(actor, times, path)
    movers = _movers(prim)
    moved = np.empty((len(movers), len(times), 4, 4))
    for k, time in enumerate(times):
        cache = UsdGeom.XformCache(time)
        for i, mover in enumerate(movers):
            moved[i, k] = np.array(place_in(actor, mover, cache)).T  # USD multiplies rows from the left
    if not np.abs(moved - moved[:1]).max() <= _APART:
        raise FormatError(
            f"the meshes below {prim.GetPath()} move in different ways.",
            path=str(path),
            hint="Move the prim above them instead.",
        )
    first: Array = moved[0]
    return first


def moving_attributes(prim: Usd.Prim, actor: Usd.Prim) -> list[Usd.Attribute]:
    """Return the attributes that move a prim in its actor: of joints, or the ops of prims from meshes to actor."""
    bones = bones_of(prim)
    if bones is not None:
        return bones.keyed()
    chain = dict.fromkeys(above for mover in _movers(prim) for above in prims_between(mover, actor))
    return [op.GetAttr() for above in chain for op in UsdGeom.Xformable(above).GetOrderedXformOps()]


def prims_between(prim: Usd.Prim, actor: Usd.Prim) -> list[Usd.Prim]:
    """Return a prim and those above it that transforms move, up to its actor and without it."""
    found = []
    while prim and prim != actor and not prim.IsPseudoRoot():
        found.append(prim)
        prim = prim.GetParent()
    return [one for one in found if one.IsA(UsdGeom.Xformable)]


def meshes_below(prim: Usd.Prim) -> list[Usd.Prim]:
    """Return the active meshes below a prim, of an instance too."""
    return [mesh for mesh in Usd.PrimRange(prim, Usd.TraverseInstanceProxies()) if mesh.IsA(UsdGeom.Mesh)]


def _movers(prim: Usd.Prim) -> list[Usd.Prim]:
    """Return the meshes below a prim where one of them has transforms of its own, else the prim."""
    meshes = meshes_below(prim)
    below = [above for mesh in meshes for above in prims_between(mesh, prim)]
    own = any(UsdGeom.Xformable(one).GetXformOpOrderAttr().HasAuthoredValue() for one in below)
    return meshes if own else [prim]


@raises_format_error(0)
def read_parameters_of_stage(
    path: str | os.PathLike[str], prim_path: str | None = None
) -> tuple[Array, Array, float] | None:
    """Read the samples of d that an animation layer holds.

    Returns:
        Times (F,), d (F, 3) [mm] with NaN in the frames the layer lists as lost, and frames per second; None when the
        motion is given by transforms alone.

    Raises:
        RigError: Not a stage.
        FormatError: No rig or several, or parameters that are not finite.
    """
    stage = open_stage(path)
    return parameters_of(find_rig_prim(stage, path, prim_path), path)


def parameters_of(actor: Usd.Prim, path: object) -> tuple[Array, Array, float] | None:
    """Read the samples of d of a rig prim, as `read_parameters_of_stage` does.

    Raises:
        FormatError: Parameters that are not finite, or too many.
    """
    stage = actor.GetStage()
    attributes = [actor.GetAttribute(name) for name in PARAMETERS]
    sampled = [key_times(attribute) for attribute in attributes if attribute]
    times = np.unique(np.concatenate([np.zeros(0), *sampled]))
    if len(sampled) < len(PARAMETERS) or not len(times):
        return None
    if len(times) > MOST_FRAMES:
        raise FormatError(f"has {len(times)} samples of d, at most {MOST_FRAMES} are read.", path=str(path))
    d = np.array([values_at(attribute, times.tolist()) for attribute in attributes], dtype=np.float64).T
    if not np.isfinite(d).all():
        raise FormatError("its samples of d hold values that are not finite.", path=str(path))
    listed = stage.GetRootLayer().customLayerData.get(LOST, [])
    lost = np.setdiff1d(np.array(list(listed), dtype=np.float64), times)
    order = np.argsort(np.concatenate([times, lost]))
    all_d = np.concatenate([d, np.full((len(lost), 3), np.nan)])
    return np.concatenate([times, lost])[order], all_d[order], float(stage.GetTimeCodesPerSecond())


def mandible_of(actor: Usd.Prim, path: object) -> Usd.Prim:
    """Return the prim that a rig moves.

    Raises:
        FormatError: jaw:mandible names none or several, or one that is not there or cannot move.
    """
    return _named_by(actor, "jaw:mandible", path)


def skull_of(actor: Usd.Prim, path: object) -> Usd.Prim | None:
    """Return the prim of a rig's skull; None where it names none or is inactive: the skull's frame is the actor's.

    Raises:
        FormatError: jaw:skull names several, or one that is not there.
    """
    named = actor.GetRelationship("jaw:skull")
    found = [actor.GetStage().GetPrimAtPath(target) for target in named.GetTargets()] if named else []
    return None if all(prim and not prim.IsActive() for prim in found) else _named_by(actor, "jaw:skull", path)


def _named_by(actor: Usd.Prim, name: str, path: object) -> Usd.Prim:
    relationship, stage = actor.GetRelationship(name), actor.GetStage()
    targets = relationship.GetTargets() if relationship else []
    if len(targets) != 1:
        raise FormatError(f"{name} of {actor.GetPath()} names {len(targets)} prims, expected 1.", path=str(path))
    there = [prim for prim in map(stage.GetPrimAtPath, targets[0].GetPrefixes()) if prim]
    prim = stage.GetPrimAtPath(targets[0])
    if there and not there[-1].IsActive():
        found = f"{there[-1].GetPath()} is inactive."
    elif not prim or not prim.IsDefined():
        found = "there is no such prim. Is the geometry (payload) missing, or not loaded?"
    elif not prim.IsA(UsdGeom.Xformable):
        found = f"it is of type {prim.GetTypeName() or 'none'}, which nothing moves."
    elif not targets[0].HasPrefix(actor.GetPath()):
        found = "it does not lie in the actor."
    else:
        return prim
    raise FormatError(f"{name} names {targets[0]}: {found}", path=str(path))


def frames_of_stage(stage: Usd.Stage, path: object) -> NDArray[np.int64]:
    """Return the whole frames between start and end of a stage.

    Raises:
        FormatError: The stage has no start and end, or too many frames between them.
    """
    if not stage.HasAuthoredTimeCodeRange():
        raise FormatError(
            "has no start and end time code: nothing says which frames to read.",
            path=str(path),
            hint="Name an animation layer, or set both in the shot.",
        )
    first, last = int(np.ceil(stage.GetStartTimeCode())), int(np.floor(stage.GetEndTimeCode()))
    if not 0 < last - first + 1 <= MOST_FRAMES:
        raise FormatError(
            f"its time codes run from {stage.GetStartTimeCode():g} to {stage.GetEndTimeCode():g}: no whole frame, or "
            f"more than {MOST_FRAMES}.",
            path=str(path),
        )
    return np.arange(first, last + 1)
