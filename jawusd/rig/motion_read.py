"""Read how the mandible moves in a stage, from its transforms or bones or from samples of d."""

from __future__ import annotations

import os
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pxr import Usd, UsdGeom

from jawusd.errors import FormatError
from jawusd.geometry.arrays import Array, Mask
from jawusd.geometry.se3 import rigidity_defect
from jawusd.rig.animation import LOST
from jawusd.rig.bones import bones_of
from jawusd.rig.layout import ACTOR, MANDIBLE, PARAMETERS
from jawusd.rig.read import find_rig_prim, open_stage
from jawusd.rig.untrusted import raises_format_error

_MOST_FRAMES = 220_000  # as many as are written, an hour at 60 per second
_RIGID = 1e-5  # single-precision quaternions, as DCCs write them, stay below


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
    return times, poses_at(mandible_of(stage, actor, path), actor, times, path)


def poses_at(mandible: Usd.Prim, actor: Usd.Prim, times: ArrayLike, path: object) -> Array:
    """Return T_skull_mandible (F, 4, 4) [mm] of a mandible of an actor at times (F,), by transforms or by bones.

    Raises:
        FormatError: The motion is not rigid.
    """
    times = np.asarray(times, dtype=np.float64)
    bones = bones_of(mandible)
    if bones is not None:
        poses = bones.poses(actor, [Usd.TimeCode(time) for time in times.tolist()], path)
    else:
        skull = skull_of(actor)
        poses = np.array([_placed(mandible, skull, actor, time) for time in times.tolist()])
    defect = rigidity_defect(poses)
    if not defect.max() <= _RIGID:
        worst = int(np.argmax(np.where(np.isfinite(defect), defect, np.inf)))
        raise FormatError(
            f"the mandible is not rigid at frame {times[worst]:g} (off by {defect[worst]:.2g}, allowed {_RIGID:g}).",
            path=str(path),
            hint="Samples of matrices shear in between: key translate and orient.",
        )
    return poses


def _placed(mandible: Usd.Prim, skull: Usd.Prim | None, actor: Usd.Prim, time: float) -> Array:
    cache = UsdGeom.XformCache(Usd.TimeCode(time))
    moved, _ = cache.ComputeRelativeTransform(mandible, actor)
    if skull is not None:
        placed, _ = cache.ComputeRelativeTransform(skull, actor)
        moved *= placed.GetInverse()
    return np.array(moved).T  # USD multiplies rows from the left


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
    actor = find_rig_prim(stage, path, prim_path)
    attributes = [actor.GetAttribute(name) for name in PARAMETERS]
    sampled = [key_times(attribute) for attribute in attributes if attribute]
    times = np.unique(np.concatenate([np.zeros(0), *sampled]))
    if len(sampled) < len(PARAMETERS) or not len(times):
        return None
    if len(times) > _MOST_FRAMES:
        raise FormatError(f"has {len(times)} samples of d, at most {_MOST_FRAMES} are read.", path=str(path))
    d = np.array([[attribute.Get(time) for attribute in attributes] for time in times], dtype=np.float64)
    if not np.isfinite(d).all():
        raise FormatError("its samples of d hold values that are not finite.", path=str(path))
    listed = stage.GetRootLayer().customLayerData.get(LOST, [])
    lost = np.setdiff1d(np.array(list(listed), dtype=np.float64), times)
    order = np.argsort(np.concatenate([times, lost]))
    all_d = np.concatenate([d, np.full((len(lost), 3), np.nan)])
    return np.concatenate([times, lost])[order], all_d[order], float(stage.GetTimeCodesPerSecond())


def key_times(attribute: Usd.Attribute) -> list[float]:
    """Return the times at which an attribute has samples; of a spline its knots and the whole frames between them."""
    if not hasattr(attribute, "HasSpline") or not attribute.HasSpline():  # OpenUSD before 25.05 has no splines
        return list(attribute.GetTimeSamples())
    knots = np.array(sorted(attribute.GetSpline().GetKnots()))
    first, last = np.ceil(knots.min(initial=np.inf)), np.floor(knots.max(initial=-np.inf))
    if not last - first < _MOST_FRAMES:
        return knots.tolist()
    return np.union1d(knots, np.arange(first, last + 1)).tolist()


def times_between(attributes: Iterable[Usd.Attribute]) -> tuple[Array, Mask]:
    """Return the times at which one of several attributes has samples, and the whole frames between them.

    Returns:
        Times, increasing, shape (n,), and which of them have samples, shape (n,).
    """
    keys = np.unique(np.concatenate([np.zeros(0), *(key_times(attribute) for attribute in attributes)]))
    first, last = np.ceil(keys.min(initial=np.inf)), np.floor(keys.max(initial=-np.inf))
    times = np.union1d(keys, np.arange(first, last + 1)) if 0 <= last - first < _MOST_FRAMES else keys
    return times, np.isin(times, keys)


def mandible_of(stage: Usd.Stage, actor: Usd.Prim, path: object) -> Usd.Prim:
    """Return the prim that a rig moves.

    Raises:
        FormatError: There is none.
    """
    targets = actor.GetRelationship("jaw:mandible").GetTargets() if actor.HasRelationship("jaw:mandible") else []
    default = actor.GetPath().AppendPath(MANDIBLE.removeprefix(f"{ACTOR}/"))
    prim = stage.GetPrimAtPath(targets[0] if targets else default)
    if not prim or not prim.IsA(UsdGeom.Xformable):
        raise FormatError(f"{actor.GetPath()} has no mandible that could move.", path=str(path))
    return prim


def skull_of(actor: Usd.Prim) -> Usd.Prim | None:
    """Return the prim of a rig's skull; None where it names none."""
    targets = actor.GetRelationship("jaw:skull").GetTargets() if actor.HasRelationship("jaw:skull") else []
    prim = actor.GetStage().GetPrimAtPath(targets[0]) if targets else None
    return prim if prim and prim.IsA(UsdGeom.Xformable) else None


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
    if not 0 < last - first + 1 <= _MOST_FRAMES:
        raise FormatError(
            f"its time codes run from {stage.GetStartTimeCode():g} to {stage.GetEndTimeCode():g}: no whole frame, or "
            f"more than {_MOST_FRAMES}.",
            path=str(path),
        )
    return np.arange(first, last + 1)
