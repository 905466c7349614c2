"""Build the two layers that carry the rig: the interface `actor.usda` and the decoder `rig.usdc`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from pxr import Kind, Sdf, Vt

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.formats.mesh import Mesh
from jawusd.geometry.anatomy import LANDMARKS
from jawusd.geometry.se3 import transform_points
from jawusd.rig import _gf, layout
from jawusd.rig.arrays import model_hash, write_arrays
from jawusd.rig.detail import offer_detail
from jawusd.rig.geo import extent
from jawusd.rig.layers import apply_jaw_api, define_prim, new_layer, set_attribute, set_relationship
from jawusd.rig.sampling import grid_points, sample_valid
from jawusd.rig.table import DecoderTable

_TYPES = Sdf.ValueTypeNames

# The interface is text and stays short; long arrays go to the binary layer.
_INTERFACE_ARRAYS = ("jaw:landmarks:", "jaw:thresholds:")
_DECODER_ARRAYS = ("jaw:model:", "jaw:bounds:", "jaw:contact:", "jaw:joints:", "jaw:motion:")


def interface_layer(
    rig: JawRig, name: str, meshes: Mapping[str, Mesh], fps: float, proxies: Iterable[str] = ()
) -> Sdf.Layer:
    """Build `actor.usda`, the prim that users and tools see.

    Args:
        meshes: As for `build_geometry`.
        fps: Time codes per second.
        proxies: Names of the meshes that have one in `proxy.usdc`, which makes variants.
    """
    layer = new_layer(fps)
    layer.subLayerPaths.append(f"./{layout.RIG_FILE}")
    actor = define_prim(layer, layout.ACTOR, "Xform")
    actor.kind = Kind.Tokens.component
    actor.assetInfo = {
        "identifier": Sdf.AssetPath(f"./{layout.ACTOR_FILE}"),
        "name": name,
        "version": str(layout.FORMAT_VERSION),
    }
    apply_jaw_api(actor, "GeomModelAPI")
    actor.payloadList.prependedItems = [Sdf.Payload(f"./{layout.GEO_FILE}")]
    if names := list(proxies):
        offer_detail(actor, names)
    hint = Sdf.AttributeSpec(actor, "extentsHint", _TYPES.Float3Array, Sdf.VariabilityVarying)
    hint.default = _gf.vec3f_array(reach(rig, meshes))

    for parameter, limits in zip(layout.PARAMETERS, rig.d_range, strict=True):
        set_attribute(actor, parameter, _TYPES.Double, 0.0, animated=True)
        set_attribute(actor, f"{parameter}:range", _TYPES.Double2, _gf.vec2d(limits))
    set_attribute(actor, "jaw:formatVersion", _TYPES.Int, layout.FORMAT_VERSION)
    set_attribute(actor, "jaw:actor", _TYPES.String, name)
    set_attribute(actor, "jaw:lengthUnit", _TYPES.Token, "mm")
    set_attribute(actor, "jaw:angleUnit", _TYPES.Token, "rad")
    set_attribute(actor, "jaw:twistOrder", _TYPES.TokenArray, Vt.TokenArray(["omega", "v"]))
    set_attribute(actor, "jaw:modelHash", _TYPES.String, model_hash(rig))
    for attribute, file in zip(layout.ONNX_ATTRIBUTES, (layout.ONNX_FILE, layout.ENCODE_FILE), strict=True):
        set_attribute(actor, attribute, _TYPES.Asset, Sdf.AssetPath(f"./{file}"))
    set_attribute(actor, "jaw:landmarks:names", _TYPES.TokenArray, Vt.TokenArray(list(LANDMARKS)))
    write_arrays(actor, rig, _INTERFACE_ARRAYS)
    set_relationship(actor, "jaw:skull", [layout.SKULL])
    set_relationship(actor, "jaw:mandible", [layout.MANDIBLE])
    return layer


def record_sidecars(layer: Sdf.Layer, folder: Path) -> None:
    """Record in `actor.usda` the SHA-256 of its ONNX files, as custom data."""
    for attribute, file in zip(layout.ONNX_ATTRIBUTES, (layout.ONNX_FILE, layout.ENCODE_FILE), strict=True):
        found = hashlib.sha256((folder / file).read_bytes()).hexdigest()
        layer.GetAttributeAtPath(f"{layout.ACTOR}.{attribute}").customData = {layout.SIDECAR_HASH: found}


def decoder_layer(rig: JawRig, table: DecoderTable) -> Sdf.Layer:
    """Build `rig.usdc`: the exact model, the bounds, and the sampled table with its error.

    It does not apply JawRigAPI: only the interface that sublayers it is a rig.
    """
    layer = new_layer()
    actor = define_prim(layer, layout.ACTOR, "Xform")
    set_attribute(actor, "jaw:meta", _TYPES.String, json.dumps(rig.meta, sort_keys=True))
    set_attribute(actor, "jaw:model:kind", _TYPES.Token, rig.kind)
    write_arrays(actor, rig, _DECODER_ARRAYS)
    set_attribute(actor, "jaw:decoder:format", _TYPES.Token, table.format)
    set_attribute(actor, "jaw:decoder:shape", _TYPES.IntArray, _gf.int_array([len(axis) for axis in table.axes]))
    for i, axis in enumerate(table.axes, start=1):
        set_attribute(actor, f"jaw:decoder:d{i}Knots", _TYPES.DoubleArray, _gf.double_array(axis))
    set_attribute(actor, "jaw:decoder:twists", _TYPES.FloatArray, _gf.float_array(table.twists))
    set_attribute(actor, "jaw:decoder:maxError", _TYPES.Double, float(table.max_error_mm))
    set_attribute(actor, "jaw:decoder:errorSamples", _TYPES.Int, int(table.error_samples))
    return layer


def reach(rig: JawRig, meshes: Mapping[str, Mesh]) -> Array:
    """Return the box (2, 3) [mm] that holds all meshes at rest and, at 500 valid parameters, the mandible's own box."""
    fixed = [extent(meshes[name].vertices) for name in ("skull", "upper_teeth") if name in meshes]
    moving = [meshes[name].vertices for name in ("mandible", "lower_teeth") if name in meshes]
    low, high = extent(np.concatenate(moving))
    corners = grid_points(np.stack([low, high], axis=1))
    d = np.concatenate([np.zeros((1, 3)), sample_valid(rig, 500)])
    moved = transform_points(rig.pose(d), corners).reshape(-1, 3)
    return extent(np.concatenate([*fixed, moved]))
