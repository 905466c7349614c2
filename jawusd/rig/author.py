"""Build the layers that define a rig: the interface `actor.usda`, the decoder `rig.usdc` and proxies `proxy.usdc`.

Proxies are meshes of few faces for crowds, selected by the variant set `detail`. The scans are in the actor's own
payload, so that tools without variant support display them. The variant `proxy` adds a stronger payload that replaces
the scans. The variant `both` adds the proxies next to the scans, with purposes, so that viewports can draw proxies and
renderers scans.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from pxr import Kind, Sdf, UsdGeom, Vt

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.formats.mesh import Mesh
from jawusd.geometry.anatomy import LANDMARKS
from jawusd.geometry.se3 import transform_points
from jawusd.rig import _gf, layout
from jawusd.rig.attributes import write_arrays
from jawusd.rig.geo import MESH_PATHS, build_geometry, extent, hide_look
from jawusd.rig.layers import apply_jaw_api, define_prim, new_layer, set_attribute, set_relationship, stage_of
from jawusd.rig.layout import ACTOR, BOTH, DETAIL, MANDIBLE, PROXY, PROXY_FILE, PROXY_SUFFIX, SCAN
from jawusd.rig.placeholder import Estimate
from jawusd.rig.table import DecoderTable, grid_points, sample_valid

_TYPES = Sdf.ValueTypeNames
_PROXY_CLASS = ACTOR + PROXY_SUFFIX
# Prefixes of the attributes in the text layer, which stays short; long arrays go to the binary layer.
_INTERFACE_ARRAYS = ("jaw:landmarks:", "jaw:thresholds:")
_DECODER_ARRAYS = ("jaw:model:", "jaw:bounds:", "jaw:contact:", "jaw:joints:", "jaw:motion:")


def proxy_layer(
    proxies: Mapping[str, Mesh], meshes: Mapping[str, Mesh], T_rest: Array, estimate: Estimate | None
) -> Sdf.Layer:
    """Build `proxy.usdc`: the content of `geo.usdc` with proxies in place of meshes, and a class that adds them.

    Args:
        proxies: Proxies for some of the meshes, with the same names and coordinate frames [mm].
        meshes, T_rest, estimate: As for `build_geometry`.

    Raises:
        RigError: A mesh without faces or with values that are not finite.
    """
    layer = build_geometry({**meshes, **proxies}, T_rest, estimate)
    _define_proxy_class(layer, proxies)
    stage = stage_of(layer)
    for name, proxy in proxies.items():
        hide_look(UsdGeom.Mesh(stage.GetPrimAtPath(MESH_PATHS[name])), proxy, meshes[name])
    return _with_ordered_fields(layer)


def _with_ordered_fields(layer: Sdf.Layer) -> Sdf.Layer:
    """Return a layer read from the text of another.

    Copies made by CopySpec have their fields in the order of memory addresses, so binary layers would differ between
    runs.
    """
    ordered = Sdf.Layer.CreateAnonymous(".usda")
    ordered.ImportFromString(layer.ExportToString())
    return ordered


def _define_proxy_class(layer: Sdf.Layer, proxies: Iterable[str]) -> None:
    """Define the class with the proxies under new names; binary layers store the equal arrays only once."""
    Sdf.CopySpec(layer, ACTOR, layer, _PROXY_CLASS)  # the copy includes the materials to which the meshes are bound
    layer.GetPrimAtPath(_PROXY_CLASS).specifier = Sdf.SpecifierClass
    mandible = layer.GetPrimAtPath(MANDIBLE.replace(ACTOR, _PROXY_CLASS))
    for attribute in list(mandible.properties):
        mandible.RemoveProperty(attribute)
    for name, path in MESH_PATHS.items():
        mesh = layer.GetPrimAtPath(path.replace(ACTOR, _PROXY_CLASS))
        if mesh is not None and name not in proxies:
            del mesh.nameParent.nameChildren[mesh.name]
        elif mesh is not None:
            _rename(mesh, Sdf.Path(_proxy_path(name)).name)
            _set_purpose(mesh, UsdGeom.Tokens.proxy)


def _rename(mesh: Sdf.PrimSpec, name: str) -> None:
    for subset in list(mesh.nameChildren):
        subset.name = subset.name.replace(mesh.name, name)
    mesh.name = name


def add_detail_variants(actor: Sdf.PrimSpec, proxies: Iterable[str]) -> None:
    """Add the variants `scan` (selected, empty), `proxy` and `both` to an actor.

    Args:
        proxies: Names of the meshes that have a proxy.
    """
    variants = Sdf.VariantSetSpec(actor, DETAIL)
    Sdf.VariantSpec(variants, SCAN)
    file = f"./{PROXY_FILE}"
    for name, payload in ((PROXY, Sdf.Payload(file)), (BOTH, Sdf.Payload(file, _PROXY_CLASS))):
        Sdf.VariantSpec(variants, name).primSpec.payloadList.prependedItems = [payload]
    actor.variantSetNameList.prependedItems = [DETAIL]
    actor.variantSelections[DETAIL] = SCAN
    both = actor.path.AppendVariantSelection(DETAIL, BOTH)
    for name in proxies:
        scan = Sdf.CreatePrimInLayer(actor.layer, Sdf.Path(MESH_PATHS[name]).ReplacePrefix(actor.path, both))
        _set_purpose(scan, UsdGeom.Tokens.render)
        relationship = Sdf.RelationshipSpec(scan, "proxyPrim", custom=False)
        relationship.targetPathList.explicitItems = [Sdf.Path(_proxy_path(name))]


def _proxy_path(name: str) -> str:
    """Return the path of a mesh's proxy, next to the mesh."""
    return f"{MESH_PATHS[name].removesuffix('Mesh')}Proxy"


def _set_purpose(prim: Sdf.PrimSpec, purpose: str) -> None:
    attribute = Sdf.AttributeSpec(prim, "purpose", Sdf.ValueTypeNames.Token, Sdf.VariabilityUniform)
    attribute.default = purpose


def interface_layer(
    rig: JawRig, name: str, meshes: Mapping[str, Mesh], fps: float, proxies: Iterable[str] = ()
) -> Sdf.Layer:
    """Build `actor.usda`, the interface for users and tools.

    Args:
        meshes: As for `build_geometry`.
        fps: Time codes per second.
        proxies: Names of the meshes that have a proxy in `proxy.usdc`; they add variants.
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
        add_detail_variants(actor, names)
    hint = Sdf.AttributeSpec(actor, "extentsHint", _TYPES.Float3Array, Sdf.VariabilityVarying)
    hint.default = _gf.vec3f_array(motion_extent(rig, meshes))

    for parameter, limits in zip(layout.PARAMETERS, rig.d_range, strict=True):
        set_attribute(actor, parameter, _TYPES.Double, 0.0, animated=True)
        set_attribute(actor, f"{parameter}:range", _TYPES.Double2, _gf.vec2d(limits))
    set_attribute(actor, "jaw:formatVersion", _TYPES.Int, layout.FORMAT_VERSION)
    set_attribute(actor, "jaw:actor", _TYPES.String, name)
    set_attribute(actor, "jaw:lengthUnit", _TYPES.Token, "mm")
    set_attribute(actor, "jaw:angleUnit", _TYPES.Token, "rad")
    set_attribute(actor, "jaw:twistOrder", _TYPES.TokenArray, Vt.TokenArray(["omega", "v"]))
    set_attribute(actor, "jaw:modelHash", _TYPES.String, rig.model_hash)
    for attribute, file in zip(layout.ONNX_ATTRIBUTES, (layout.ONNX_FILE, layout.ENCODE_FILE), strict=True):
        set_attribute(actor, attribute, _TYPES.Asset, Sdf.AssetPath(f"./{file}"))
    set_attribute(actor, "jaw:landmarks:names", _TYPES.TokenArray, Vt.TokenArray(list(LANDMARKS)))
    write_arrays(actor, rig, _INTERFACE_ARRAYS)
    set_relationship(actor, "jaw:skull", [layout.SKULL])
    set_relationship(actor, "jaw:mandible", [layout.MANDIBLE])
    return layer


def record_sidecars(layer: Sdf.Layer, folder: Path) -> None:
    """Record the SHA-256 checksums of the ONNX files in `actor.usda`, as custom data."""
    for attribute, file in zip(layout.ONNX_ATTRIBUTES, (layout.ONNX_FILE, layout.ENCODE_FILE), strict=True):
        found = hashlib.sha256((folder / file).read_bytes()).hexdigest()
        layer.GetAttributeAtPath(f"{layout.ACTOR}.{attribute}").customData = {layout.SIDECAR_HASH_KEY: found}


def decoder_layer(rig: JawRig, table: DecoderTable) -> Sdf.Layer:
    """Build `rig.usdc`: the exact model, the bounds, and the sampled table with its error.

    JawRigAPI is not applied in this layer: only the interface that sublayers it is a rig.
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


def motion_extent(rig: JawRig, meshes: Mapping[str, Mesh]) -> Array:
    """Return a box (2, 3) [mm] that contains all meshes at rest, and the mandible's meshes at 500 random valid d."""
    fixed = [extent(meshes[name].vertices) for name in ("skull", "upper_teeth") if name in meshes]
    moving = [meshes[name].vertices for name in ("mandible", "lower_teeth") if name in meshes]
    low, high = extent(np.concatenate(moving))
    corners = grid_points(np.stack([low, high], axis=1))
    d = np.concatenate([np.zeros((1, 3)), sample_valid(rig, 500)])
    moved = transform_points(rig.pose(d), corners).reshape(-1, 3)
    return extent(np.concatenate([*fixed, moved]))
