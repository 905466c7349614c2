"""Read the motion of the mandible in a stage from transforms, bones or samples of d, and how far the skull is moved."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pxr import Usd, UsdGeom

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, FormatError
from jawusd.evaluator import JawRig
from jawusd.geometry.se3 import rigidity_defect
from jawusd.rig.animation import BETWEEN_MM, LOST
from jawusd.rig.attributes import MAX_FRAMES, key_and_frame_times, key_times, time_codes, values_at
from jawusd.rig.layout import PARAMETERS, meshes_below
from jawusd.rig.read import find_rig_prim, open_stage
from jawusd.rig.skel import SAME_MOTION, bones_of, transform_in_actor
from jawusd.rig.table import landmark_distance
from jawusd.rig.untrusted import raises_format_error

#: Maximum landmark distance [mm] of a baked pose from the pose that d gives.
BAKED_MM = 0.01
_RIGID = 1e-5  # maximum rigidity defect; single-precision quaternions written by DCC programs stay below it


@raises_format_error
def read_poses_of_stage(path: AnyPath, prim_path: str | None = None) -> tuple[NDArray[np.int64], Array]:
    """Read frame numbers (F,) and T_skull_mandible (F, 4, 4) [mm], relative to the actor, at whole frames of a stage.

    Raises:
        RigError: The file is not a stage.
        FormatError: No rig, several rigs and no `prim_path`, no mandible, no time range, or a motion that is not rigid.
    """
    stage = open_stage(path)
    actor = find_rig_prim(stage, path, prim_path)
    times = frames_of_stage(stage)
    return times, poses_at(mandible_of(actor), actor, times)


def poses_at(mandible: Usd.Prim, actor: Usd.Prim, times: ArrayLike) -> Array:
    """Return the poses T_skull_mandible (F, 4, 4) [mm] at times (F,), in the actor's units, from transforms or bones.

    Without times, the default time is read; without a skull, the poses are relative to the actor.

    Raises:
        FormatError: The motion is not rigid.
    """
    codes = time_codes(np.asarray(times, dtype=np.float64))
    poses, skull = poses_in_actor(mandible, actor, codes), skull_of(actor)
    if skull is not None:
        poses = np.asarray(np.linalg.solve(poses_in_actor(skull, actor, codes), poses), np.float64)
    defect = rigidity_defect(poses)
    if not defect.max() <= _RIGID:
        worst = int(np.argmax(np.where(np.isfinite(defect), defect, np.inf)))
        raise FormatError(
            f"the mandible is not rigid at frame {codes[worst]}: "
            f"its deviation from a rigid transform is {defect[worst]:.2g}; the maximum is {_RIGID:g}.",
            hint="Matrix samples shear when interpolated: key translate and orient instead.",
        )
    return poses


def poses_in_actor(prim: Usd.Prim, actor: Usd.Prim, times: Sequence[Usd.TimeCode]) -> Array:
    """Return transforms (F, 4, 4) from the meshes below a prim to its actor.

    Raises FormatError if bones deform the meshes, or if these move differently.
    """
    bones = bones_of(prim)
    if bones is not None:
        return bones.poses(actor, times)
    movers = _moving_prims(prim)
    moved = np.empty((len(movers), len(times), 4, 4))
    for k, time in enumerate(times):
        cache = UsdGeom.XformCache(time)
        for i, mover in enumerate(movers):
            moved[i, k] = np.array(transform_in_actor(actor, mover, cache)).T  # USD uses row vectors
    if not np.abs(moved - moved[:1]).max() <= SAME_MOTION:
        raise FormatError(
            f"the meshes below {prim.GetPath()} move differently.", hint="Move the prim above them instead."
        )
    first: Array = moved[0]
    return first


def moving_attributes(prim: Usd.Prim, actor: Usd.Prim) -> list[Usd.Attribute]:
    """Return the attributes that move a prim in its actor: those of joints, or of prims up to the actor."""
    bones = bones_of(prim)
    if bones is not None:
        return bones.animated_attributes()
    chain = dict.fromkeys(above for mover in _moving_prims(prim) for above in prims_between(mover, actor))
    return [op.GetAttr() for above in chain for op in UsdGeom.Xformable(above).GetOrderedXformOps()]


def prims_between(prim: Usd.Prim, actor: Usd.Prim) -> list[Usd.Prim]:
    """Return the transformable prims from a prim up to its actor, excluding the actor."""
    found = []
    while prim and prim != actor and not prim.IsPseudoRoot():
        found.append(prim)
        prim = prim.GetParent()
    return [each for each in found if each.IsA(UsdGeom.Xformable)]


def _moving_prims(prim: Usd.Prim) -> list[Usd.Prim]:
    """Return the meshes below a prim if they or prims in between have transforms, otherwise the prim."""
    meshes = meshes_below(prim)
    below = [above for mesh in meshes for above in prims_between(mesh, prim)]
    is_transformed = any(UsdGeom.Xformable(each).GetXformOpOrderAttr().HasAuthoredValue() for each in below)
    return meshes if is_transformed else [prim]


@raises_format_error
def read_parameters_of_stage(path: AnyPath, prim_path: str | None = None) -> tuple[Array, Array, float] | None:
    """Read the times (F,), the samples of d (F, 3) [mm] and the frame rate of an animation layer; NaN in lost frames.

    None if the motion is given by transforms only.

    Raises:
        RigError: The file is not a stage.
        FormatError: No rig or several rigs, or parameters that are not finite.
    """
    stage = open_stage(path)
    return parameters_of(find_rig_prim(stage, path, prim_path))


def parameters_of(actor: Usd.Prim) -> tuple[Array, Array, float] | None:
    """Read d of a rig prim as `read_parameters_of_stage` does; raises FormatError for too many or infinite samples."""
    stage = actor.GetStage()
    attributes = [actor.GetAttribute(name) for name in PARAMETERS]
    sampled = [key_times(attribute) for attribute in attributes if attribute]
    times = np.unique(np.concatenate([np.zeros(0), *sampled]))
    if len(sampled) < len(PARAMETERS) or not len(times):
        return None
    if len(times) > MAX_FRAMES:
        raise FormatError(f"has {len(times)} samples of d; the maximum is {MAX_FRAMES}.")
    d = np.array([values_at(attribute, times.tolist()) for attribute in attributes], dtype=np.float64).T
    if not np.isfinite(d).all():
        raise FormatError("its samples of d have values that are not finite.")
    listed = stage.GetRootLayer().customLayerData.get(LOST, [])
    lost = np.setdiff1d(np.array(list(listed), dtype=np.float64), times)
    order = np.argsort(np.concatenate([times, lost]))
    all_d = np.concatenate([d, np.full((len(lost), 3), np.nan)])
    return np.concatenate([times, lost])[order], all_d[order], float(stage.GetTimeCodesPerSecond())


def mandible_of(actor: Usd.Prim) -> Usd.Prim:
    """Return the mandible prim of a rig; raises FormatError if jaw:mandible has no single target that can be moved."""
    return _relationship_target(actor, "jaw:mandible")


def skull_of(actor: Usd.Prim) -> Usd.Prim | None:
    """Return the skull prim of a rig, None if unset or inactive; raises FormatError if missing or not the only one."""
    relationship = actor.GetRelationship("jaw:skull")
    targets = relationship.GetTargets() if relationship else []
    found = [actor.GetStage().GetPrimAtPath(target) for target in targets]
    if all(prim and not prim.IsActive() for prim in found):
        return None
    return _relationship_target(actor, "jaw:skull")


def _relationship_target(actor: Usd.Prim, name: str) -> Usd.Prim:
    relationship, stage = actor.GetRelationship(name), actor.GetStage()
    targets = relationship.GetTargets() if relationship else []
    if len(targets) != 1:
        raise FormatError(f"{name} of {actor.GetPath()} has {len(targets)} targets; expected 1.")
    existing = [prim for prim in map(stage.GetPrimAtPath, targets[0].GetPrefixes()) if prim]
    prim = stage.GetPrimAtPath(targets[0])
    if existing and not existing[-1].IsActive():
        found = f"{existing[-1].GetPath()} is inactive."
    elif not prim or not prim.IsDefined():
        found = "there is no such prim. Is the geometry (payload) missing, or not loaded?"
    elif not prim.IsA(UsdGeom.Xformable):
        found = f"it is of type {prim.GetTypeName() or 'none'}, which cannot be transformed."
    elif not targets[0].HasPrefix(actor.GetPath()):
        found = "it is not below the actor."
    else:
        return prim
    raise FormatError(f"{name} targets {targets[0]}: {found}")


def frames_of_stage(stage: Usd.Stage) -> NDArray[np.int64]:
    """Return the whole frames between start and end of a stage; raises FormatError if there are none, or too many."""
    if not stage.HasAuthoredTimeCodeRange():
        raise FormatError(
            "has no start and end time codes, which determine the frames to read.",
            hint="Give an animation layer, or set both in the shot.",
        )
    first, last = int(np.ceil(stage.GetStartTimeCode())), int(np.floor(stage.GetEndTimeCode()))
    if not 0 < last - first + 1 <= MAX_FRAMES:
        raise FormatError(
            f"its time codes run from {stage.GetStartTimeCode():g} to {stage.GetEndTimeCode():g}: this range contains "
            f"no whole frame, or more than {MAX_FRAMES}.",
        )
    return np.arange(first, last + 1)


def parameters_at(actor: Usd.Prim, times: Array) -> Array:
    """Return d (n, 3) [mm] of a rig prim at times (n,), or d (1, 3) at the default time if there are no times."""
    rows = [[actor.GetAttribute(name).Get(time) for name in PARAMETERS] for time in time_codes(times)]
    return np.array(rows, dtype=np.float64)


class Comparison(NamedTuple):
    """Landmark distances [mm] of a mandible from the poses given by d."""

    times: list[Usd.TimeCode]
    away_mm: Array  # the distances, shape (n,)
    allowed_mm: Array  # the largest allowed distances, shape (n,)


def compared_with_parameters(actor: Usd.Prim, mandible: Usd.Prim, rig: JawRig) -> Comparison:
    """Compare a mandible with d at the keys of both (if only d is keyed, the jaw does not move), or the default time.

    Except for bones, whole frames between the keys are compared too; there, both are interpolated differently.

    Raises:
        FormatError: The motion is not rigid.
    """
    moving = moving_attributes(mandible, actor)
    times, keyed = key_and_frame_times([*moving, *(actor.GetAttribute(name) for name in PARAMETERS)])
    if bones_of(mandible) is not None:
        times, keyed = times[keyed], keyed[keyed]
    allowed_mm = np.where(keyed, BAKED_MM, BAKED_MM + BETWEEN_MM) if len(times) else np.array([BAKED_MM])
    away_mm = landmark_distance(rig, poses_at(mandible, actor, times), rig.pose(parameters_at(actor, times)))
    return Comparison(time_codes(times), away_mm, allowed_mm)


def skull_displacement_mm(actor: Usd.Prim, rig: JawRig) -> float:
    """Return the largest displacement [mm] of the skull in its actor; raises FormatError if bones deform it."""
    skull = skull_of(actor)
    if skull is None:
        return 0.0
    times = time_codes(key_and_frame_times(moving_attributes(skull, actor))[0])
    poses = poses_in_actor(skull, actor, times)
    return float(landmark_distance(rig, poses, np.broadcast_to(np.eye(4), poses.shape)).max())
