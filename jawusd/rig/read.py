"""Read rigs from USD by attribute name, whether or not the schema is registered."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TypedDict

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, EvaluatorError, FormatError, RigError, UnitsError
from jawusd.base.guard import out_of_memory
from jawusd.base.inputs import check_path
from jawusd.evaluator import JawRig
from jawusd.rig.attributes import key_times, read_arrays, read_value, upgrade_rig, value_of, was_upgraded
from jawusd.rig.layout import (
    ACTOR_FILE,
    MODEL_HASH_KEY,
    ONNX_ATTRIBUTES,
    PARAMETERS,
    has_jaw_api,
    meshes_below,
    rig_prims,
)
from jawusd.rig.table import DecoderTable
from jawusd.rig.untrusted import open_checked, raises_format_error


@raises_format_error
def load_rig(path: AnyPath, prim_path: str | None = None) -> JawRig:
    """Load the evaluator of a rig from a layer or package that contains it, or any stage that references an actor.

    `prim_path` is the rig's prim, if the stage has several rigs.

    Raises:
        FormatError: No rig, several rigs, missing or malformed values.
        VersionError: The rig was written by a newer version.
        UnitsError: Other units or twist order.
        RigError: The stage cannot be opened, or refers to files outside its folder.
    """
    stage = open_stage(path)
    return rig_of(find_rig_prim(stage, path, prim_path))


def open_stage(path: AnyPath) -> Usd.Stage:
    """Open a stage.

    Raises:
        RigError: The file does not exist, is not USD, or refers to files that `check_file_access` rejects.
        ResourceError: There is not enough memory.
    """
    path = Path(path)
    if not path.is_file():
        raise RigError("there is no such file.", path=path)
    if path.suffix == ".npz":
        raise RigError("is an npz file; expected a USD file.", path=path, hint="Give the rig's actor.usda.")
    check_path(path, RigError)
    try:
        return open_checked(path)
    except MemoryError as error:
        raise out_of_memory(path) from error


def find_rig_prim(stage: Usd.Stage, path: AnyPath, prim_path: str | None = None) -> Usd.Prim:
    """Return the prim of a rig; raises FormatError if there is none, there are several, or the given one is no rig."""
    if prim_path is not None:
        prim = stage.GetPrimAtPath(prim_path) if Sdf.Path.IsValidPathString(prim_path) else None
        if not prim or not has_jaw_api(prim):
            raise FormatError(f"{prim_path} is not a jaw rig.", path=path)
        return prim
    prims = rig_prims(stage)
    if not prims:
        actor = Path(path).with_name(ACTOR_FILE)
        hint = f"Give {actor}." if actor.is_file() and actor != Path(path) else None
        raise FormatError("has no jaw rig (no prim with JawRigAPI).", path=path, hint=hint)
    if len(prims) > 1:
        names = ", ".join(str(prim.GetPath()) for prim in prims)
        raise FormatError(f"has several jaw rigs: {names}.", path=path, hint="Choose one with --prim.")
    return prims[0]


@raises_format_error
def rig_of(prim: Usd.Prim) -> JawRig:
    """Build the evaluator from a rig prim.

    Raises:
        FormatError: The metadata are not JSON or state another model kind, a package mixes files of several actors, or
            any error of `load_rig`.
    """
    upgrade_rig(prim)
    check_units(prim)
    kind = str(read_value(prim, "jaw:model:kind"))
    arrays = read_arrays(prim, kind)
    try:
        meta = json.loads(str(read_value(prim, "jaw:meta")))
    except (TypeError, ValueError) as error:
        raise FormatError(f"jaw:meta is not JSON ({error}).") from error
    if not isinstance(meta, dict):
        raise FormatError("jaw:meta must be a JSON object.")
    if meta.get("kind") != kind:
        raise FormatError(f"jaw:model:kind is {kind!r}, but jaw:meta has {meta.get('kind')!r}.")
    try:
        rig = JawRig(arrays, meta)
    except EvaluatorError as error:
        raise FormatError(error.message) from error
    # In a folder, a mismatch may come from edited thresholds; in a package, files of equal names were mixed.
    packed = prim.GetStage().GetRootLayer().identifier.endswith(".usdz")
    if packed and not set(recorded_hashes(prim)) <= {None, rig.model_hash}:
        raise FormatError(
            f"{prim.GetPath()} does not match its model (jaw:modelHash): packing mixed up files of several actors.",
            hint="Pack shots with `jawusd publish SHOT -o shot.usdz`, or publish the actors under other names first.",
        )
    return rig


def recorded_hashes(prim: Usd.Prim) -> tuple[object, object]:
    """Return the hash of a rig's model and that of the model with which its motion was made; None if not recorded.

    Both are None for a rig of an older format version, because upgraded arrays have another hash.
    """
    if was_upgraded(prim):
        return None, None
    own = prim.GetAttribute("jaw:modelHash").Get() if prim.HasAttribute("jaw:modelHash") else None
    keyed = prim.HasAttribute(PARAMETERS[0])
    return own, prim.GetAttribute(PARAMETERS[0]).GetCustomDataByKey(MODEL_HASH_KEY) if keyed else None


def check_units(prim: Usd.Prim) -> None:
    """Raise UnitsError if units or twist order of a rig prim differ from mm, rad and (omega, v)."""
    for name, wanted in (("jaw:lengthUnit", "mm"), ("jaw:angleUnit", "rad"), ("jaw:twistOrder", ["omega", "v"])):
        found = np.array(read_value(prim, name)).tolist()
        if found != wanted:
            raise UnitsError(f"{name} is {found}; expected {wanted}.")


@raises_format_error
def read_table(prim: Usd.Prim) -> DecoderTable:
    """Read the sampled decoder of a rig prim; raises FormatError for inconsistent values, VersionError if too new."""
    upgrade_rig(prim)
    stored_as = str(read_value(prim, "jaw:decoder:format"))
    d1, d2, d3 = (_numbers(prim, f"jaw:decoder:d{i}Knots") for i in (1, 2, 3))
    axes, counts = (d1, d2, d3), [len(d1), len(d2), len(d3)]
    found = _numbers(prim, "jaw:decoder:shape").tolist()
    if found != counts or min(counts) < 2 or any((np.diff(axis) <= 0).any() for axis in axes):
        raise FormatError(f"jaw:decoder:shape is {[int(n) for n in found]}; expected {counts}, the numbers of knots.")
    twists = _numbers(prim, "jaw:decoder:twists").astype(np.float32)
    shape = (*counts, 6) if stored_as == "grid" else (sum(counts), 6)
    if twists.size != math.prod(shape):
        raise FormatError(
            f"jaw:decoder:twists has {twists.size} numbers; expected {math.prod(shape)}, of shape {shape}.",
        )
    if not np.isfinite(twists).all() or not all(np.isfinite(axis).all() for axis in axes):
        raise FormatError("jaw:decoder has values that are not finite.")
    error_mm, samples = (_numbers(prim, f"jaw:decoder:{name}") for name in ("maxError", "errorSamples"))
    return DecoderTable(stored_as, axes, twists.reshape(shape), float(error_mm), int(samples))


def _numbers(prim: Usd.Prim, name: str) -> Array:
    return np.array(read_value(prim, name), dtype=np.float64)


class TableDescription(TypedDict):
    """Sampled decoder of a rig; see `DecoderTable`."""

    format: str
    shape: list[int]
    max_error_mm: float


class Description(TypedDict):
    """Contents of a rig file, as plain JSON values."""

    file: str
    prim: str
    format_version: int
    actor: str
    model: dict[str, str | None]
    model_hash: str
    units: dict[str, str]
    twist_order: list[str]
    ranges_mm: dict[str, list[float]]
    landmarks_mm: dict[str, list[float]]
    thresholds_mm: dict[str, float]
    held_out: dict[str, float] | None
    table: TableDescription
    onnx: list[str]
    fps: float
    animation: dict[str, float] | None
    meshes: dict[str, int]
    placeholders: list[str]
    estimated_condyles: dict[str, str | float | None] | None
    contact: object
    joints: object
    speeds: dict[str, list[float]] | None
    errors: object


@raises_format_error
def describe(path: AnyPath, prim_path: str | None = None) -> Description:
    """Return the contents of a rig file, for `jawusd info`; arguments and errors as for `load_rig`."""
    stage = open_stage(path)
    prim = find_rig_prim(stage, path, prim_path)
    rig = rig_of(prim)
    table = read_table(prim)
    speeds = rig.speeds
    names = np.array(read_value(prim, "jaw:landmarks:names")).tolist()
    samples = key_times(prim.GetAttribute(PARAMETERS[0]))
    animation = {"samples": len(samples), "first": samples[0], "last": samples[-1]} if samples else None
    onnx = [prim.GetAttribute(name).Get() for name in ONNX_ATTRIBUTES]
    placeholders = [p for p in meshes_below(prim) if p.GetAttribute("jaw:placeholder").Get()]
    return {
        "file": str(path),
        "prim": str(prim.GetPath()),
        "format_version": int(_numbers(prim, "jaw:formatVersion")),
        "actor": str(read_value(prim, "jaw:actor")),
        "model": {"kind": rig.kind, "method": rig.method or None},
        "model_hash": str(read_value(prim, "jaw:modelHash")),
        "units": {"length": "mm", "angle": "rad"},
        "twist_order": ["omega", "v"],
        "ranges_mm": {name.removeprefix("jaw:"): row.tolist() for name, row in zip(PARAMETERS, rig.d_range)},
        "landmarks_mm": dict(zip(names, rig.landmarks.tolist(), strict=True)),
        "thresholds_mm": {"residual": rig.limits.residual_mm, "tolerance": rig.tolerance_mm},
        "held_out": rig.held_out and rig.held_out._asdict(),
        "table": {
            "format": table.format,
            "shape": [len(axis) for axis in table.axes],
            "max_error_mm": table.max_error_mm,
        },
        "onnx": [asset.path for asset in onnx if asset is not None],
        "fps": stage.GetTimeCodesPerSecond(),
        "animation": animation,
        "meshes": _meshes(prim),
        "placeholders": [mesh.GetName() for mesh in placeholders],
        "estimated_condyles": _estimated_condyles(placeholders),
        "contact": rig.meta.get("contact"),
        "joints": rig.meta.get("joints"),
        "speeds": None
        if speeds is None
        else {"rms_mm_s": speeds.rms_mm_s.tolist(), "rms_mm_s2": speeds.rms_mm_s2.tolist()},
        "errors": rig.meta.get("errors"),
    }


def _estimated_condyles(placeholders: list[Usd.Prim]) -> dict[str, str | float | None] | None:
    """Return source and expected error [mm] of the condyles of placeholders; None without placeholders."""
    if not placeholders:
        return None
    source, error = (
        placeholders[0].GetAttribute(f"jaw:placeholder:{name}").Get() for name in ("condyles", "condyleError")
    )
    return {"source": source, "error_mm": error}


def _meshes(prim: Usd.Prim) -> dict[str, int]:
    """Return the number of points of every mesh below a prim, by name."""
    meshes = [UsdGeom.Mesh(p) for p in meshes_below(prim)]
    return {mesh.GetPrim().GetName(): len(np.array(value_of(mesh.GetPointsAttr()) or [])) for mesh in meshes}
