"""The rules for rigs: plain functions of a rig prim, independent of UsdValidation and of the schema plugin."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom

from jawusd.errors import FormatError, JawusdError
from jawusd.evaluator import JawRig
from jawusd.evaluator.verdicts import OUTSIDE, place
from jawusd.geometry.arrays import Array
from jawusd.rig import _gf
from jawusd.rig.baked import BAKED_MM, looked_at, skull_moved_mm, time_codes
from jawusd.rig.bones import bones_of
from jawusd.rig.layout import ONNX_ATTRIBUTES, PARAMETERS, SIDECAR_HASH
from jawusd.rig.motion_read import times_between
from jawusd.rig.read import named_models, read_table, rig_of
from jawusd.rig.sampling import sample_valid
from jawusd.rig.table import landmark_distance
from jawusd.rig.untrusted import FAULTS, fault_message

_TABLE_SLACK_MM = 0.01  # the table states its error over more parameters than are tried here
_ONNX_MM = 0.01
_OPS = [("xformOp:translate", "double3"), ("xformOp:orient", "quatd")]
_PROBES = 500
_ONNX_PROBES = 100


@dataclass(frozen=True)
class Finding:
    """A violation of a rule, or a note.

    Attributes:
        severity: "error", "warning" or "info".
        rule: Name of the rule.
        path: Prim or attribute concerned.
        message: What was found and what is allowed.
    """

    severity: str
    rule: str
    path: str
    message: str


Rule = Callable[[Usd.Prim], Iterator[Finding]]


def check_model(prim: Usd.Prim) -> Iterator[Finding]:
    """Check that version, units and model arrays can be read, and are those of the motion on top of them."""
    try:
        rig = rig_of(prim, _where(prim))
    except JawusdError as error:
        yield _finding("error", "Model", prim, error.message)
        return
    own, made_for = named_models(prim)
    if own not in (None, rig.model_hash):
        message = "the model is not the one it was baked from (jaw:modelHash): files of several actors were mixed, "
        message += "or values were changed by hand. `jawusd publish` gives actors names of their own."
        yield _finding("error", "Model", prim, message)
    if made_for not in (None, rig.model_hash):
        message = f"the model is not the one that its motion was made with ({PARAMETERS[0]} names another). "
        message += "Either files of several actors were mixed: `jawusd publish` them first. "
        message += "Or the rig was built anew since: `jawusd rebake` the motion."
        yield _finding("error", "Model", prim, message)


def check_table(prim: Usd.Prim) -> Iterator[Finding]:
    """Check that the sampled table is complete, and within its stated error of the exact model."""
    try:
        table = read_table(prim, _where(prim))
    except JawusdError as error:
        yield _finding("error", "Table", prim, error.message)
        return
    rig = _rig(prim)
    if rig is None:
        return
    d = sample_valid(rig, _PROBES)
    read = table.pose(d, rig.T_rest)
    error_mm = landmark_distance(rig, read, rig.pose(d)).max()
    if error_mm > table.max_error_mm + _TABLE_SLACK_MM:
        message = f"the table is {error_mm:.3f} mm from the model, maxError says {table.max_error_mm:.3f} mm."
        yield _finding("error", "Table", prim, message)


def check_onnx(prim: Usd.Prim) -> Iterator[Finding]:
    """Check that the ONNX files named by the rig were made from this model and give its results."""
    rig = _rig(prim)
    attributes = [prim.GetAttribute(name) for name in ONNX_ATTRIBUTES]
    assets = {a.Get(): a.GetCustomDataByKey(SIDECAR_HASH) for a in attributes if isinstance(a.Get(), Sdf.AssetPath)}
    if rig is None or not assets:
        return
    try:
        from jawusd.rig.onnx_check import onnx_error_mm
    except ImportError:
        yield _finding("info", "Onnx", prim, "not checked: the package onnx is not installed (jawusd[build]).")
        return
    d = sample_valid(rig, _ONNX_PROBES)
    for asset, recorded in assets.items():
        if not asset.resolvedPath:
            yield _finding("error", "Onnx", prim, f"{asset.path} is not there.")
            continue
        try:
            error_mm = onnx_error_mm(asset.resolvedPath, rig, d, recorded)
        except JawusdError as error:
            yield _finding("error", "Onnx", prim, f"{asset.path} {error.message}")
            continue
        if not error_mm <= _ONNX_MM:
            message = f"{asset.path} is {error_mm:.3f} mm from the model, allowed {_ONNX_MM} mm."
            yield _finding("error", "Onnx", prim, message)


def check_bounds(prim: Usd.Prim) -> Iterator[Finding]:
    """Check that every value of d1, d2, d3, at every time, lies inside the bound; within the tolerance is a note."""
    rig = _rig(prim)
    if rig is None:
        return
    times = time_codes(times_between(prim.GetAttribute(name) for name in PARAMETERS)[0])
    d = _parameters(prim, times)
    margin = rig.margin(d)
    worst = int(np.argmin(np.where(np.isfinite(margin), margin, -np.inf)))
    outside = ~rig.is_inside(d)
    if outside.any():
        values = ", ".join(f"{x:.2f}" for x in d[worst])
        said = place(float(margin[worst]), rig.tolerance_mm)
        message = f"{outside.sum()} of {len(d)} samples are outside; worst at {times[worst]}: d = ({values}) mm, "
        message += f"margin {margin[worst]:.2f} mm, {said}."
        yield _finding("warning" if said == OUTSIDE else "info", "Bounds", prim, message)


def check_mandible(prim: Usd.Prim) -> Iterator[Finding]:
    """Check that the mandible moves as the model does: by translate (double3) and orient (quatd) alone, or by bones."""
    targets = prim.GetRelationship("jaw:mandible").GetTargets() if prim.HasRelationship("jaw:mandible") else []
    if len(targets) != 1:
        yield _finding("error", "Mandible", prim, f"jaw:mandible names {len(targets)} prims, expected 1.")
        return
    if not prim.IsLoaded():
        return
    mandible = UsdGeom.Xformable(prim.GetStage().GetPrimAtPath(targets[0]))
    if not mandible:
        yield _finding("error", "Mandible", prim, f"{targets[0]}, named by jaw:mandible, is no Xformable prim.")
        return
    bones = bones_of(mandible.GetPrim())
    ops = mandible.GetOrderedXformOps()
    names = [(op.GetOpName(), op.GetTypeName()) for op in ops]
    if bones is None and (names != _OPS or mandible.GetResetXformStack()):
        message = f"the ops are {names}, expected translate (double3) and orient (quatd)."
        yield _finding("error", "Mandible", mandible.GetPrim(), message)
        return
    rig = _rig(prim)
    if rig is None:
        return
    moving = bones.keyed() if bones else [op.GetAttr() for op in ops]
    at, allowed_mm = looked_at(prim, moving, bones is not None)
    times = time_codes(at)
    try:
        baked = bones.poses(prim, times, _where(prim)) if bones else _transforms(moving, times)
        away_mm = skull_moved_mm(prim, rig)
    except FormatError as error:
        yield _finding("error", "Mandible", mandible.GetPrim(), error.message)
        return
    still = not any(attribute.GetNumTimeSamples() for attribute in moving)
    yield from _check_baked(rig, mandible.GetPrim(), times, baked, _parameters(prim, times), allowed_mm, still)
    if not away_mm <= BAKED_MM:
        message = f"the skull is moved in the actor by {away_mm:.3f} mm ({BAKED_MM} allowed): move the actor instead."
        yield _finding("error", "Mandible", prim, message)


def _transforms(ops: list[Usd.Attribute], times: list[Usd.TimeCode]) -> Array:
    translate, orient = ops
    return np.stack([_gf.transform_from_ops(_at(translate, time), _at(orient, time)) for time in times])


def _check_baked(
    rig: JawRig,
    mandible: Usd.Prim,
    times: list[Usd.TimeCode],
    baked: Array,
    d: Array,
    allowed_mm: Array,
    still: bool,
) -> Iterator[Finding]:
    error_mm = landmark_distance(rig, baked, rig.pose(d))
    over_mm = error_mm - allowed_mm
    worst = int(np.argmax(np.where(np.isfinite(over_mm), over_mm, np.inf)))
    if not over_mm[worst] <= 0:
        message = f"the baked pose at {times[worst]} is {error_mm[worst]:.3f} mm from that of d "
        message += f"({allowed_mm[worst]:.2f} allowed)."
        message += " Only d is keyed, the mandible is not:" if still else " Bring both together:"
        message += " bake it with `jawusd rebake`." if still else " `jawusd rebake`."
        yield _finding("error", "Mandible", mandible, message)


def _with_any_values(name: str, rule: Rule) -> Rule:
    """Return a rule that finds values of unexpected types, which any layer may hold, to be an error."""

    @functools.wraps(rule)
    def checked(prim: Usd.Prim) -> Iterator[Finding]:
        try:
            yield from rule(prim)
        except FAULTS as error:
            yield _finding("error", name, prim, fault_message(error))

    return checked


RULES: dict[str, Rule] = {
    name: _with_any_values(name, rule)
    for name, rule in {
        "Model": check_model,
        "Table": check_table,
        "Onnx": check_onnx,
        "Bounds": check_bounds,
        "Mandible": check_mandible,
    }.items()
}


def _where(prim: Usd.Prim) -> str:
    return prim.GetStage().GetRootLayer().identifier


def _finding(severity: str, rule: str, prim: Usd.Prim, message: str) -> Finding:
    return Finding(severity, rule, str(prim.GetPath()), message)


def _rig(prim: Usd.Prim) -> JawRig | None:
    """Return the evaluator, or None where `check_model` finds an error."""
    try:
        return rig_of(prim, _where(prim))
    except JawusdError:
        return None


def _at(attribute: Usd.Attribute, time: Usd.TimeCode) -> Gf.Vec3d | Gf.Quatd:
    value = attribute.Get(time)
    if value is not None:
        return value
    return Gf.Quatd(1) if attribute.GetTypeName() == Sdf.ValueTypeNames.Quatd else Gf.Vec3d(0)


def _parameters(prim: Usd.Prim, times: list[Usd.TimeCode]) -> Array:
    rows = [[prim.GetAttribute(name).Get(time) for name in PARAMETERS] for time in times]
    return np.array(rows, dtype=np.float64)
