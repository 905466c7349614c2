"""Validation rules for rigs: functions of a rig prim, independent of UsdValidation and of the schema plugin."""

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
from jawusd.rig.assembly import faults_of_assembly
from jawusd.rig.attributes import key_and_frame_times, time_codes
from jawusd.rig.layout import ONNX_ATTRIBUTES, PARAMETERS, SIDECAR_HASH_KEY
from jawusd.rig.motion_read import (
    BAKED_MM,
    comparison_times,
    mandible_of,
    moving_attributes,
    poses_at,
    skull_displacement_mm,
)
from jawusd.rig.read import read_table, recorded_hashes, rig_of
from jawusd.rig.skel import bones_of
from jawusd.rig.table import landmark_distance, sample_valid
from jawusd.rig.untrusted import VALUE_ERRORS, value_error_message

_TABLE_SLACK_MM = 0.01  # tolerance on the stated error of the table [mm], which was measured at other parameters
_OPS = [("xformOp:translate", "double3"), ("xformOp:orient", "quatd")]
_PROBES = 500  # number of random valid d at which the table is compared with the model


@dataclass(frozen=True)
class Finding:
    """A violation of a rule, or a note."""

    severity: str  # "error", "warning" or "info"
    rule: str  # name of the rule
    path: str  # path of the prim or attribute
    message: str  # the value that was found, and the allowed values


Rule = Callable[[Usd.Prim], Iterator[Finding]]


def check_model(prim: Usd.Prim) -> Iterator[Finding]:
    """Check that version, units and model arrays can be read, and that the motion was made with this model."""
    rig = rig_of(prim, _where(prim))
    own, made_for = recorded_hashes(prim)
    if own not in (None, rig.model_hash):
        message = "the rig was baked from another model (jaw:modelHash): files of several actors were mixed, "
        message += "or model values such as ranges were edited. `jawusd publish` gives each actor unique file names."
        yield _finding("error", "Model", prim, message)
    if made_for not in (None, rig.model_hash):
        message = f"the motion was made with another model (see {PARAMETERS[0]}). "
        message += "Either files of several actors were mixed: run `jawusd publish` on them first. "
        message += "Or the rig was rebuilt since: run `jawusd rebake` on the motion."
        yield _finding("error", "Model", prim, message)


def check_table(prim: Usd.Prim) -> Iterator[Finding]:
    """Check that the sampled table is complete and within its stated error of the exact model."""
    table = read_table(prim, _where(prim))
    rig = _rig(prim)
    if rig is None:
        return
    d = sample_valid(rig, _PROBES)
    read = table.pose(d, rig.T_rest)
    error_mm = landmark_distance(rig, read, rig.pose(d)).max()
    if error_mm > table.max_error_mm + _TABLE_SLACK_MM:
        message = f"the table is {error_mm:.3f} mm from the model; maxError is {table.max_error_mm:.3f} mm."
        yield _finding("error", "Table", prim, message)


def check_onnx(prim: Usd.Prim) -> Iterator[Finding]:
    """Check that the ONNX files of the rig were made from this model and reproduce its results."""
    rig = _rig(prim)
    attributes = [prim.GetAttribute(name) for name in ONNX_ATTRIBUTES]
    assets = {a.Get(): a.GetCustomDataByKey(SIDECAR_HASH_KEY) for a in attributes if isinstance(a.Get(), Sdf.AssetPath)}
    if rig is None or not assets:
        return
    try:
        from jawusd.rig.onnx_sidecar import ALLOWED_MM, PROBES, onnx_error_mm
    except ImportError:
        yield _finding("info", "Onnx", prim, "not checked: the package onnx is not installed (jawusd[build]).")
        return
    d = sample_valid(rig, PROBES)
    for asset, recorded in assets.items():
        if not asset.resolvedPath:
            yield _finding("error", "Onnx", prim, f"{asset.path} does not exist.")
            continue
        try:
            error_mm = onnx_error_mm(asset.resolvedPath, rig, d, recorded)
        except JawusdError as error:
            yield _finding("error", "Onnx", prim, f"{asset.path} {error.message}")
            continue
        if not error_mm <= ALLOWED_MM:
            message = f"{asset.path} is {error_mm:.3f} mm from the model; the maximum is {ALLOWED_MM} mm."
            yield _finding("error", "Onnx", prim, message)


def check_bounds(prim: Usd.Prim) -> Iterator[Finding]:
    """Check that d1, d2, d3 are inside the bound at every time; deviations within the tolerance are only noted."""
    rig = _rig(prim)
    if rig is None:
        return
    times = time_codes(key_and_frame_times(prim.GetAttribute(name) for name in PARAMETERS)[0])
    d = _parameters(prim, times)
    margin = rig.margin(d)
    worst = int(np.argmin(np.where(np.isfinite(margin), margin, -np.inf)))
    outside = ~rig.is_inside(d)
    if outside.any():
        values = ", ".join(f"{x:.2f}" for x in d[worst])
        verdict = place(float(margin[worst]), rig.tolerance_mm)
        message = f"{outside.sum()} of {len(d)} samples are outside; worst at {times[worst]}: d = ({values}) mm, "
        message += f"margin {margin[worst]:.2f} mm, {verdict}."
        yield _finding("warning" if verdict == OUTSIDE else "info", "Bounds", prim, message)


def check_mandible(prim: Usd.Prim) -> Iterator[Finding]:
    """Check that the mandible moves like the model, and only by translate (double3) and orient (quatd) or by bones."""
    if not prim.IsLoaded():
        yield _finding("error", "Mandible", prim, "the geometry (payload) is not loaded and cannot be checked.")
        return
    mandible = mandible_of(prim, _where(prim))
    bones, body = bones_of(mandible), UsdGeom.Xformable(mandible)
    names = [(op.GetOpName(), op.GetTypeName()) for op in body.GetOrderedXformOps()]
    if bones is None and (names != _OPS or body.GetResetXformStack()):
        message = f"the ops are {names}; expected translate (double3) and orient (quatd)."
        if body.GetResetXformStack():
            message = "!resetXformStack! detaches it from the actor: it does not move with the actor."
        yield _finding("error", "Mandible", mandible, message)
        return
    rig = _rig(prim)
    if rig is None:
        return
    moving = moving_attributes(mandible, prim)
    at, allowed_mm = comparison_times(prim, moving, bones is not None)
    times = time_codes(at)
    try:
        baked = poses_at(mandible, prim, at, _where(prim))
        away_mm = skull_displacement_mm(prim, rig, _where(prim))
    except FormatError as error:
        yield _finding("error", "Mandible", mandible, error.message)
        return
    if not away_mm <= BAKED_MM:
        message = f"the skull is moved in the actor by {away_mm:.3f} mm; the maximum is {BAKED_MM} mm. "
        message += "Move the actor instead."
        yield _finding("error", "Mandible", prim, message)
        return
    error_mm = landmark_distance(rig, baked, rig.pose(_parameters(prim, times)))
    over_mm = error_mm - allowed_mm
    worst = int(np.argmax(np.where(np.isfinite(over_mm), over_mm, np.inf)))
    if not over_mm[worst] <= 0:
        message = f"the baked pose at {times[worst]} is {error_mm[worst]:.3f} mm from the pose of d; "
        message += f"the maximum is {allowed_mm[worst]:.2f} mm."
        keyed = any(attribute.GetNumTimeSamples() for attribute in moving)
        message += " To make them agree, run" if keyed else " Only d is keyed, not the mandible: bake it with"
        yield _finding("error", "Mandible", mandible, f"{message} `jawusd rebake`.")


def check_assembly(prim: Usd.Prim) -> Iterator[Finding]:
    """Check that a shot does not hide, deform, detach or rescale the jaw of an actor."""
    for severity, at, message in faults_of_assembly(prim):
        yield _finding(severity, "Assembly", at, message)


def _reporting_errors(name: str, rule: Rule) -> Rule:
    """Return a rule that reports what cannot be read, and values of unexpected types, as an error."""

    @functools.wraps(rule)
    def checked(prim: Usd.Prim) -> Iterator[Finding]:
        try:
            yield from rule(prim)
        except JawusdError as error:
            yield _finding("error", name, prim, error.message)
        except VALUE_ERRORS as error:
            yield _finding("error", name, prim, value_error_message(error))

    return checked


RULES: dict[str, Rule] = {
    name: _reporting_errors(name, rule)
    for name, rule in {
        "Model": check_model,
        "Table": check_table,
        "Onnx": check_onnx,
        "Bounds": check_bounds,
        "Mandible": check_mandible,
        "Assembly": check_assembly,
    }.items()
}


def _where(prim: Usd.Prim) -> str:
    return prim.GetStage().GetRootLayer().identifier


def _finding(severity: str, rule: str, prim: Usd.Prim, message: str) -> Finding:
    return Finding(severity, rule, str(prim.GetPath()), message)


def _rig(prim: Usd.Prim) -> JawRig | None:
    """Return the evaluator; None if `check_model` finds an error."""
    try:
        return rig_of(prim, _where(prim))
    except JawusdError:
        return None


def _parameters(prim: Usd.Prim, times: list[Usd.TimeCode]) -> Array:
    rows = [[prim.GetAttribute(name).Get(time) for name in PARAMETERS] for time in times]
    return np.array(rows, dtype=np.float64)
