"""Validation rules for rigs: functions of a rig prim, independent of UsdValidation and of the schema plugin.

The last part finds an actor in a shot whose jaw is hidden, detached, deformed or of the wrong size.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from jawusd.base.arrays import Array
from jawusd.base.errors import FormatError, JawusdError
from jawusd.evaluator import JawRig
from jawusd.evaluator.verdicts import OUTSIDE, place
from jawusd.rig import motion_read
from jawusd.rig.attributes import key_and_frame_times, time_codes
from jawusd.rig.layout import MOTION, ONNX_ATTRIBUTES, PARAMETERS, SIDECAR_HASH_KEY, SKELETON, meshes_below
from jawusd.rig.read import read_table, recorded_hashes, rig_of
from jawusd.rig.skel import bones_of
from jawusd.rig.table import landmark_distance, sample_valid
from jawusd.rig.untrusted import VALUE_ERRORS, value_error_message

_TABLE_SLACK_MM = 0.01  # tolerance on the stated error of the table [mm], which was measured at other parameters
_OPS = [("xformOp:translate", "double3"), ("xformOp:orient", "quatd")]
_PROBES = 500  # number of random valid d at which the table is compared with the model
_UNEVEN = 1e-3  # maximum relative difference of the three scales: 0.1 mm at jaw size, far above rounding
_SIZES = 0.5, 2.0  # smallest and largest plausible scale of a head; scales outside this range come from wrong units
_MM = 0.001  # one millimetre in metres
_FIRST = Usd.TimeCode.EarliestTime()


@dataclass(frozen=True)
class Finding:
    """A violation of a rule, or a note."""

    severity: str  # "error", "warning" or "info"
    rule: str  # name of the rule
    path: str  # path of the prim or attribute
    message: str  # the value that was found, and the allowed values


Rule = Callable[[Usd.Prim], Iterator[Finding]]
_Fault = tuple[str, Usd.Prim, str]  # severity, prim, message


def check_model(prim: Usd.Prim) -> Iterator[_Fault]:
    """Check that version, units and model arrays can be read, and that the motion was made with this model."""
    rig = rig_of(prim)
    own, made_for = recorded_hashes(prim)
    if own not in (None, rig.model_hash):
        message = "the rig was baked from another model (jaw:modelHash): files of several actors were mixed, "
        message += "or model values such as ranges were edited. `jawusd publish` gives each actor unique file names."
        yield "error", prim, message
    if made_for not in (None, rig.model_hash):
        message = f"the motion was made with another model (see {PARAMETERS[0]}). "
        message += "Either files of several actors were mixed: run `jawusd publish` on them first. "
        message += "Or the rig was rebuilt since: run `jawusd rebake` on the motion."
        yield "error", prim, message


def check_table(prim: Usd.Prim) -> Iterator[_Fault]:
    """Check that the sampled table is complete and within its stated error of the exact model."""
    table = read_table(prim)
    rig = _rig(prim)
    if rig is None:
        return
    d = sample_valid(rig, _PROBES)
    read = table.pose(d, rig.T_rest)
    error_mm = landmark_distance(rig, read, rig.pose(d)).max()
    if error_mm > table.max_error_mm + _TABLE_SLACK_MM:
        message = f"the table is {error_mm:.3f} mm from the model; maxError is {table.max_error_mm:.3f} mm."
        yield "error", prim, message


def check_onnx(prim: Usd.Prim) -> Iterator[_Fault]:
    """Check that the ONNX files of the rig were made from this model and reproduce its results."""
    rig = _rig(prim)
    attributes = [prim.GetAttribute(name) for name in ONNX_ATTRIBUTES]
    assets = {a.Get(): a.GetCustomDataByKey(SIDECAR_HASH_KEY) for a in attributes if isinstance(a.Get(), Sdf.AssetPath)}
    if rig is None or not assets:
        return
    try:
        from jawusd.rig.onnx_sidecar import ALLOWED_MM, PROBES, onnx_error_mm
    except ImportError:
        yield "info", prim, "not checked: the package onnx is not installed (jawusd[build])."
        return
    d = sample_valid(rig, PROBES)
    for asset, recorded in assets.items():
        if not asset.resolvedPath:
            yield "error", prim, f"{asset.path} does not exist."
            continue
        try:
            error_mm = onnx_error_mm(asset.resolvedPath, rig, d, recorded)
        except JawusdError as error:
            yield "error", prim, f"{asset.path} {error.message}"
            continue
        if not error_mm <= ALLOWED_MM:
            message = f"{asset.path} is {error_mm:.3f} mm from the model; the maximum is {ALLOWED_MM} mm."
            yield "error", prim, message


def check_bounds(prim: Usd.Prim) -> Iterator[_Fault]:
    """Check that d1, d2, d3 are inside the bound at every time; deviations within the tolerance are only noted."""
    rig = _rig(prim)
    if rig is None:
        return
    times, _ = key_and_frame_times(prim.GetAttribute(name) for name in PARAMETERS)
    d = motion_read.parameters_at(prim, times)
    margin = rig.margin(d)
    worst = int(np.argmin(np.where(np.isfinite(margin), margin, -np.inf)))
    outside = ~rig.is_inside(d)
    if outside.any():
        values = ", ".join(f"{x:.2f}" for x in d[worst])
        verdict = place(float(margin[worst]), rig.tolerance_mm)
        message = f"{outside.sum()} of {len(d)} samples are outside; worst at {time_codes(times)[worst]}: "
        message += f"d = ({values}) mm, margin {margin[worst]:.2f} mm, {verdict}."
        yield "warning" if verdict == OUTSIDE else "info", prim, message


def check_mandible(prim: Usd.Prim) -> Iterator[_Fault]:
    """Check that the mandible moves like the model, and only by translate (double3) and orient (quatd) or by bones."""
    if not prim.IsLoaded():
        yield "error", prim, "the geometry (payload) is not loaded and cannot be checked."
        return
    mandible = motion_read.mandible_of(prim)
    bones, body = bones_of(mandible), UsdGeom.Xformable(mandible)
    names = [(op.GetOpName(), op.GetTypeName()) for op in body.GetOrderedXformOps()]
    if bones is None and (names != _OPS or body.GetResetXformStack()):
        message = f"the ops are {names}; expected translate (double3) and orient (quatd)."
        if body.GetResetXformStack():
            message = "!resetXformStack! detaches it from the actor: it does not move with the actor."
        yield "error", mandible, message
        return
    rig = _rig(prim)
    if rig is None:
        return
    try:
        times, error_mm, allowed_mm = motion_read.compared_with_parameters(prim, mandible, rig)
        away_mm = motion_read.skull_displacement_mm(prim, rig)
    except FormatError as error:
        yield "error", mandible, error.message
        return
    if not away_mm <= motion_read.BAKED_MM:
        message = f"the skull is moved in the actor by {away_mm:.3f} mm; the maximum is {motion_read.BAKED_MM} mm. "
        message += "Move the actor instead."
        yield "error", prim, message
        return
    over_mm = error_mm - allowed_mm
    worst = int(np.argmax(np.where(np.isfinite(over_mm), over_mm, np.inf)))
    if not over_mm[worst] <= 0:
        message = f"the baked pose at {times[worst]} is {error_mm[worst]:.3f} mm from the pose of d; "
        message += f"the maximum is {allowed_mm[worst]:.2f} mm."
        keyed = any(attribute.GetNumTimeSamples() for attribute in motion_read.moving_attributes(mandible, prim))
        message += " To make them agree, run" if keyed else " Only d is keyed, not the mandible: bake it with"
        yield "error", mandible, f"{message} `jawusd rebake`."


def _rig(prim: Usd.Prim) -> JawRig | None:
    """Return the evaluator; None if `check_model` finds an error."""
    try:
        return rig_of(prim)
    except JawusdError:
        return None


def check_assembly(actor: Usd.Prim) -> Iterator[_Fault]:
    """Check that a shot does not hide, deform, detach or rescale the jaw of an actor."""
    for name in actor.GetStage().GetMutedLayers():
        yield "error", actor, f"the layer {name} is muted."
    yield from _units(actor)
    yield from _shape(actor)
    try:
        skull, mandible = motion_read.skull_of(actor), motion_read.mandible_of(actor)
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


def _units(actor: Usd.Prim) -> Iterator[_Fault]:
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


def _shape(actor: Usd.Prim) -> Iterator[_Fault]:
    """Find transforms of an actor or its parents that deform or mirror it at one of their keys."""
    above = motion_read.prims_between(actor, actor.GetStage().GetPseudoRoot())
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


def _resets(actor: Usd.Prim, parts: list[Usd.Prim]) -> Iterator[_Fault]:
    """Find prims in an actor that reset the transform stack."""
    meshes = [mesh for part in parts for mesh in meshes_below(part)]
    for prim in dict.fromkeys(above for mesh in meshes for above in motion_read.prims_between(mesh, actor)):
        if prim not in parts[-1:] and UsdGeom.Xformable(prim).GetResetXformStack():  # another rule checks the mandible
            yield "error", prim, "!resetXformStack! detaches it from the actor."


def _hidden(actor: Usd.Prim, skull: Usd.Prim | None, mandible: Usd.Prim) -> Iterator[_Fault]:
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


def _joints(actor: Usd.Prim, mandible: Usd.Prim) -> Iterator[_Fault]:
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


def _rule(name: str, check: Callable[[Usd.Prim], Iterator[_Fault]]) -> Rule:
    """Return a check as a rule that also reports what cannot be read, and values of unexpected types, as an error."""

    def faults(prim: Usd.Prim) -> Iterator[_Fault]:
        try:
            yield from check(prim)
        except JawusdError as error:
            yield "error", prim, error.message
        except VALUE_ERRORS as error:
            yield "error", prim, value_error_message(error)

    @functools.wraps(check)
    def rule(prim: Usd.Prim) -> Iterator[Finding]:
        return (Finding(severity, name, str(at.GetPath()), message) for severity, at, message in faults(prim))

    return rule


RULES: dict[str, Rule] = {
    name: _rule(name, check)
    for name, check in {
        "Model": check_model,
        "Table": check_table,
        "Onnx": check_onnx,
        "Bounds": check_bounds,
        "Mandible": check_mandible,
        "Assembly": check_assembly,
    }.items()
}
