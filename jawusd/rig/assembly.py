"""What shots do to actors that leaves the jaw broken: hidden, cut off, deformed, of another size."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from jawusd.base.arrays import Array
from jawusd.base.errors import FormatError
from jawusd.rig.bones import bones_of
from jawusd.rig.keys import time_codes, times_between
from jawusd.rig.layout import MOTION, SKELETON
from jawusd.rig.motion_read import mandible_of, meshes_below, prims_between, skull_of

_UNEVEN = 1e-3  # of the scales of three axes, far above single precision: 0.1 mm of a jaw
_SIZES = 0.5, 2.0  # no head is twice another: beyond, the units were mixed up
_MM = 0.001  # metres
_FIRST = Usd.TimeCode.EarliestTime()


class Fault(NamedTuple):
    """A fault: "error" or "warning", the prim concerned, and what was found."""

    severity: str
    prim: Usd.Prim
    message: str


def faults_of_assembly(actor: Usd.Prim) -> Iterator[Fault]:
    """Return what is wrong with a rig in its stage, besides what its own rules find."""
    yield from _muted(actor)
    yield from _units(actor)
    yield from _shape(actor)
    where = actor.GetStage().GetRootLayer().identifier
    try:
        skull, mandible = skull_of(actor, where), mandible_of(actor, where)
    except FormatError as error:
        if error.message.startswith("jaw:skull"):
            yield Fault("error", actor, error.message)
        return  # the mandible has a rule of its own
    if skull is None:
        yield Fault("warning", actor, "has no active skull (jaw:skull).")
    elif skull.GetPath().HasPrefix(mandible.GetPath()) or mandible.GetPath().HasPrefix(skull.GetPath()):
        yield Fault("error", actor, f"jaw:skull and jaw:mandible, {mandible.GetPath()}, move together.")
    yield from _resets(actor, [prim for prim in (skull, mandible) if prim])
    yield from _shown(actor, skull, mandible)
    yield from _joints(actor, mandible)


def _muted(actor: Usd.Prim) -> Iterator[Fault]:
    for name in actor.GetStage().GetMutedLayers():
        yield Fault("error", actor, f"the layer {name} is muted.")


def _units(actor: Usd.Prim) -> Iterator[Fault]:
    """Find units and axes of the stage that are not those of the rig's own layer, and that nothing corrects."""
    stage, root = actor.GetStage(), actor.GetStage().GetRootLayer()
    stack = actor.GetAttribute("jaw:formatVersion").GetPropertyStack()
    own = stack[-1].layer if stack else root
    sublayered = own in stage.GetLayerStack()  # such are not converted, and nothing stands between
    for name in ("metersPerUnit", "upAxis") if own != root else ():
        found, wanted = (layer.pseudoRoot.GetInfo(name) for layer in (root, own))
        if root.pseudoRoot.HasInfo(name) and own.pseudoRoot.HasInfo(name) and found != wanted:
            said = f"the stage has {name} = {found}, the layer of the rig {wanted}"
            if sublayered:
                yield Fault("error", actor, f"{said}: give both the same, or reference the rig instead.")
            elif name == "upAxis" and np.allclose(axes := _axes(actor, _FIRST), np.diag(np.diag(axes))):
                yield Fault("warning", actor, f"{said}: it lies down, nothing turns it about x.")
    metres = UsdGeom.GetStageMetersPerUnit(stage)
    size = float(np.cbrt(abs(np.linalg.det(_axes(actor, _FIRST))))) * metres / _MM
    known = UsdGeom.StageHasAuthoredMetersPerUnit(stage) and not sublayered
    if known and size and not _SIZES[0] <= size <= _SIZES[1]:
        message = f"is {size:.3g} times as large as in life: the stage has {metres:g} m per unit, the actor mm. "
        yield Fault("warning", actor, f"{message}Scale the actor by {_MM / metres:g}.")


def _axes(actor: Usd.Prim, time: Usd.TimeCode) -> Array:
    """Return where the axes of an actor's prim point in the world, as columns, shape (3, 3)."""
    return np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(actor))[:3, :3].T


def _shape(actor: Usd.Prim) -> Iterator[Fault]:
    """Find prims above an actor, or itself, that deform or mirror it at one of their keys."""
    above = prims_between(actor, actor.GetStage().GetPseudoRoot())
    moving = [op.GetAttr() for prim in above for op in UsdGeom.Xformable(prim).GetOrderedXformOps()]
    times = time_codes(times_between(moving)[0])
    axes = np.array([_axes(actor, time) for time in times])
    scales = np.linalg.svd(axes, compute_uv=False)
    uneven = scales[:, 0] - scales[:, 2] > _UNEVEN * scales[:, 0]
    mirrored = np.linalg.det(axes) < 0  # scales of zero hide it
    if uneven.any():
        first = int(np.argmax(uneven))
        said = ", ".join(f"{scale:.4g}" for scale in scales[first])
        yield Fault("error", actor, f"is deformed, by itself or its parents, at {times[first]}: scales {said}.")
    elif mirrored.any():
        message = f"is mirrored at {times[int(np.argmax(mirrored))]}: left and right of the jaw are exchanged."
        yield Fault("error", actor, message)


def _resets(actor: Usd.Prim, parts: list[Usd.Prim]) -> Iterator[Fault]:
    """Find prims in an actor that do not follow it, or that take their own way."""
    meshes = [mesh for part in parts for mesh in meshes_below(part)]
    for prim in dict.fromkeys(above for mesh in meshes for above in prims_between(mesh, actor)):
        if prim not in parts[-1:] and UsdGeom.Xformable(prim).GetResetXformStack():  # the mandible has its own rule
            yield Fault("error", prim, "!resetXformStack! takes it out of the actor.")


def _shown(actor: Usd.Prim, skull: Usd.Prim | None, mandible: Usd.Prim) -> Iterator[Fault]:
    """Find mandibles that are hidden, now and then or always, while the skull or else the actor is shown."""
    meshes = meshes_below(mandible)
    beside = meshes_below(skull) if skull else []
    if not meshes:
        yield Fault("error", mandible, "has no active mesh.")
        return
    above = dict.fromkeys(prim for mesh in (*meshes, *beside) for prim in _upwards(mesh))
    seen = [UsdGeom.Imageable(prim) for prim in above if prim.IsA(UsdGeom.Imageable)]
    times, keyed = times_between(one.GetVisibilityAttr() for one in seen)
    for time in time_codes(times[keyed]):
        if not any(_is_shown(mesh, time) for mesh in meshes) and any(_is_shown(m, time) for m in beside or [actor]):
            yield Fault("error", mandible, f"is hidden at {time}, while the rest of the actor is shown.")
            return


def _upwards(prim: Usd.Prim) -> list[Usd.Prim]:
    return [prim.GetStage().GetPrimAtPath(path) for path in prim.GetPath().GetPrefixes()]


def _is_shown(prim: Usd.Prim, time: Usd.TimeCode) -> bool:
    seen = UsdGeom.Imageable(prim)
    hidden = seen.ComputeVisibility(time) == UsdGeom.Tokens.invisible
    return not hidden and seen.ComputePurpose() != UsdGeom.Tokens.guide


def _joints(actor: Usd.Prim, mandible: Usd.Prim) -> Iterator[Fault]:
    """Find animated joints that the skeleton lacks, in the variant with the skeleton too where it is not chosen."""
    bones = bones_of(mandible)
    variants = actor.GetVariantSet(MOTION)
    if bones is None and SKELETON in variants.GetVariantNames() and not actor.IsInstanceProxy():
        session = Sdf.Layer.CreateAnonymous()
        root = actor.GetStage().GetRootLayer()
        other = Usd.Stage.OpenMasked(root, session, Usd.StagePopulationMask([actor.GetPath()]))
        with Usd.EditContext(other, session):
            other.GetPrimAtPath(actor.GetPath()).GetVariantSet(MOTION).SetVariantSelection(SKELETON)
        bones = bones_of(other.GetPrimAtPath(mandible.GetPath()))
        if bones is None:
            yield Fault("error", actor, f"no bones move the mandible in the variant {SKELETON}.")
            return
    foreign = bones.foreign_joints() if bones is not None else []
    if foreign:
        yield Fault(
            "error", mandible, f"the joints {', '.join(foreign)} are animated, but the skeleton has none of that name."
        )
