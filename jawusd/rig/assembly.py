"""Validation of an actor in a shot: whether its jaw is hidden, detached, deformed or of the wrong size."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from jawusd.base.arrays import Array
from jawusd.base.errors import FormatError
from jawusd.rig.attributes import key_and_frame_times, time_codes
from jawusd.rig.layout import MOTION, SKELETON, meshes_below
from jawusd.rig.motion_read import mandible_of, prims_between, skull_of
from jawusd.rig.skel import bones_of

_UNEVEN = 1e-3  # maximum relative difference of the three scales: 0.1 mm at jaw size, far above rounding
_SIZES = 0.5, 2.0  # smallest and largest plausible scale of a head; scales outside this range come from wrong units
_MM = 0.001  # one millimetre in metres
_FIRST = Usd.TimeCode.EarliestTime()


Fault = tuple[str, Usd.Prim, str]  # severity ("error" or "warning"), prim, message


def faults_of_assembly(actor: Usd.Prim) -> Iterator[Fault]:
    """Yield those faults of a rig in its stage that the other rules do not find."""
    for name in actor.GetStage().GetMutedLayers():
        yield "error", actor, f"the layer {name} is muted."
    yield from _units(actor)
    yield from _shape(actor)
    where = actor.GetStage().GetRootLayer().identifier
    try:
        skull, mandible = skull_of(actor, where), mandible_of(actor, where)
    except FormatError as error:
        if error.message.startswith("jaw:skull"):
            yield "error", actor, error.message
        return  # the rule for the mandible reports this fault
    if skull is None:
        yield "warning", actor, "has no active skull (jaw:skull)."
    elif skull.GetPath().HasPrefix(mandible.GetPath()) or mandible.GetPath().HasPrefix(skull.GetPath()):
        paths = f"jaw:skull ({skull.GetPath()}) and jaw:mandible ({mandible.GetPath()})"
        yield "error", actor, f"{paths} move together: they are the same prim, or one is below the other."
    yield from _resets(actor, [prim for prim in (skull, mandible) if prim])
    yield from _hidden(actor, skull, mandible)
    yield from _joints(actor, mandible)


def _units(actor: Usd.Prim) -> Iterator[Fault]:
    """Find units and axes of the stage that differ from those of the rig's layer and that no transform corrects."""
    stage, root = actor.GetStage(), actor.GetStage().GetRootLayer()
    stack = actor.GetAttribute("jaw:formatVersion").GetPropertyStack()
    own = stack[-1].layer if stack else root
    sublayered = own in stage.GetLayerStack()  # sublayers cannot be corrected by a transform
    for name in ("metersPerUnit", "upAxis") if own != root else ():
        found, wanted = (layer.pseudoRoot.GetInfo(name) for layer in (root, own))
        if root.pseudoRoot.HasInfo(name) and own.pseudoRoot.HasInfo(name) and found != wanted:
            difference = f"the stage has {name} = {found}, but the layer of the rig has {wanted}"
            if sublayered:
                yield "error", actor, f"{difference}: set both to the same value, or reference the rig instead."
            elif name == "upAxis" and np.allclose(axes := _axes(actor, _FIRST), np.diag(np.diag(axes))):
                yield "warning", actor, f"{difference}, and no transform rotates the actor about x."
    metres = UsdGeom.GetStageMetersPerUnit(stage)
    size = float(np.cbrt(abs(np.linalg.det(_axes(actor, _FIRST))))) * metres / _MM
    known = UsdGeom.StageHasAuthoredMetersPerUnit(stage) and not sublayered
    if known and size and not _SIZES[0] <= size <= _SIZES[1]:
        message = f"is {size:.3g} times life size: the stage has {metres:g} m per unit, but the actor is in mm. "
        yield "warning", actor, f"{message}Scale the actor by {_MM / metres:g}."


def _axes(actor: Usd.Prim, time: Usd.TimeCode) -> Array:
    """Return the axes of an actor in the world, as columns, shape (3, 3)."""
    return np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(actor))[:3, :3].T


def _shape(actor: Usd.Prim) -> Iterator[Fault]:
    """Find transforms of an actor or its parents that deform or mirror it at one of their keys."""
    above = prims_between(actor, actor.GetStage().GetPseudoRoot())
    moving = [op.GetAttr() for prim in above for op in UsdGeom.Xformable(prim).GetOrderedXformOps()]
    times = time_codes(key_and_frame_times(moving)[0])
    axes = np.array([_axes(actor, time) for time in times])
    scales = np.linalg.svd(axes, compute_uv=False)
    uneven = scales[:, 0] - scales[:, 2] > _UNEVEN * scales[:, 0]
    mirrored = np.linalg.det(axes) < 0  # the axes are not meaningful if a scale is zero
    if uneven.any():
        first = int(np.argmax(uneven))
        listed = ", ".join(f"{scale:.4g}" for scale in scales[first])
        message = f"has a non-uniform scale, its own or that of its parents, at {times[first]}: scales {listed}."
        yield "error", actor, message
    elif mirrored.any():
        message = f"is mirrored at {times[int(np.argmax(mirrored))]}: left and right of the jaw are swapped."
        yield "error", actor, message


def _resets(actor: Usd.Prim, parts: list[Usd.Prim]) -> Iterator[Fault]:
    """Find prims in an actor that reset the transform stack."""
    meshes = [mesh for part in parts for mesh in meshes_below(part)]
    for prim in dict.fromkeys(above for mesh in meshes for above in prims_between(mesh, actor)):
        if prim not in parts[-1:] and UsdGeom.Xformable(prim).GetResetXformStack():  # another rule checks the mandible
            yield "error", prim, "!resetXformStack! detaches it from the actor."


def _hidden(actor: Usd.Prim, skull: Usd.Prim | None, mandible: Usd.Prim) -> Iterator[Fault]:
    """Find mandibles that are hidden at some time while the skull, or the actor if there is none, is visible."""
    meshes = meshes_below(mandible)
    skull_meshes = meshes_below(skull) if skull else []
    if not meshes:
        yield "error", mandible, "has no active mesh."
        return
    paths = dict.fromkeys(path for mesh in (*meshes, *skull_meshes) for path in mesh.GetPath().GetPrefixes())
    above = map(actor.GetStage().GetPrimAtPath, paths)
    imageable = [UsdGeom.Imageable(prim) for prim in above if prim.IsA(UsdGeom.Imageable)]
    times, keyed = key_and_frame_times(each.GetVisibilityAttr() for each in imageable)
    for time in time_codes(times[keyed]):
        others = skull_meshes or [actor]
        if not any(_is_visible(mesh, time) for mesh in meshes) and any(_is_visible(p, time) for p in others):
            yield "error", mandible, f"is hidden at {time} while the rest of the actor is visible."
            return


def _is_visible(prim: Usd.Prim, time: Usd.TimeCode) -> bool:
    imageable = UsdGeom.Imageable(prim)
    invisible = imageable.ComputeVisibility(time) == UsdGeom.Tokens.invisible
    return not invisible and imageable.ComputePurpose() != UsdGeom.Tokens.guide


def _joints(actor: Usd.Prim, mandible: Usd.Prim) -> Iterator[Fault]:
    """Find animated joints that the skeleton lacks; the skeleton variant is checked even if it is not selected."""
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
            yield "error", actor, f"no bones move the mandible in the variant {SKELETON}."
            return
    foreign = bones.foreign_joints() if bones is not None else []
    if foreign:
        message = f"the joints {', '.join(foreign)} are animated, but the skeleton has no joints of these names."
        yield "error", mandible, message
