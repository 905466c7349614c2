"""Write the complete folder of a rig from a model and the actor's meshes, and the layers that define the rig."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pxr import Gf, Kind, Sdf, UsdGeom, Vt

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, RigError
from jawusd.evaluator import JawRig
from jawusd.formats.mesh import Mesh
from jawusd.geometry.anatomy import LANDMARKS
from jawusd.geometry.se3 import transform_points
from jawusd.rig import layers, layout
from jawusd.rig.animation import write_animation
from jawusd.rig.asset_paths import record_checksums, sha256_of
from jawusd.rig.attributes import write_arrays
from jawusd.rig.geo import MESH_PATHS, build_geometry, check_meshes, extent, hide_look
from jawusd.rig.onnx_sidecar import check_written, decode_model, encode_model, write_onnx
from jawusd.rig.placeholder import Estimate, with_estimated_bones
from jawusd.rig.publish import write_package
from jawusd.rig.skel import write_skel
from jawusd.rig.table import DEFAULT_SIZE, DecoderTable, build_table, grid_points, sample_valid

_TYPES = Sdf.ValueTypeNames
_PROXY_CLASS = layout.ACTOR + layout.PROXY_SUFFIX
# Prefixes of the attributes in the text layer, which stays short; long arrays go to the binary layer.
_INTERFACE_ARRAYS = ("jaw:landmarks:", "jaw:thresholds:")
_DECODER_ARRAYS = ("jaw:model:", "jaw:bounds:", "jaw:contact:", "jaw:joints:", "jaw:motion:")


def proxy_layer(
    proxies: Mapping[str, Mesh], meshes: Mapping[str, Mesh], T_rest: Array, estimate: Estimate | None
) -> Sdf.Layer:
    """Build `proxy.usdc`, as `build_geometry` does with proxies in place of some meshes, and a class that adds them."""
    layer = build_geometry({**meshes, **proxies}, T_rest, estimate)
    _define_proxy_class(layer, proxies)
    stage = layers.stage_of(layer)
    for name, proxy in proxies.items():
        hide_look(UsdGeom.Mesh(stage.GetPrimAtPath(MESH_PATHS[name])), proxy, meshes[name])
    return _with_ordered_fields(layer)


def _with_ordered_fields(layer: Sdf.Layer) -> Sdf.Layer:
    """Return a layer read from the text of another; CopySpec orders fields by memory address, so files would differ."""
    ordered = Sdf.Layer.CreateAnonymous(".usda")
    ordered.ImportFromString(layer.ExportToString())
    return ordered


def _define_proxy_class(layer: Sdf.Layer, proxies: Iterable[str]) -> None:
    """Define the class with the proxies under new names; binary layers store the equal arrays only once."""
    # the copy includes the materials to which the meshes are bound
    Sdf.CopySpec(layer, layout.ACTOR, layer, _PROXY_CLASS)
    layer.GetPrimAtPath(_PROXY_CLASS).specifier = Sdf.SpecifierClass
    mandible = layer.GetPrimAtPath(layout.MANDIBLE.replace(layout.ACTOR, _PROXY_CLASS))
    for attribute in list(mandible.properties):
        mandible.RemoveProperty(attribute)
    for name, path in MESH_PATHS.items():
        mesh = layer.GetPrimAtPath(path.replace(layout.ACTOR, _PROXY_CLASS))
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
    """Add the variants `scan` (selected, empty), `proxy` and `both` to an actor; `proxies` names meshes with one."""
    variants = layers.add_variants(actor, layout.DETAIL, layout.SCAN, layout.PROXY, layout.BOTH).variants
    file = f"./{layout.PROXY_FILE}"
    for name, payload in ((layout.PROXY, Sdf.Payload(file)), (layout.BOTH, Sdf.Payload(file, _PROXY_CLASS))):
        variants[name].primSpec.payloadList.prependedItems = [payload]
    both = actor.path.AppendVariantSelection(layout.DETAIL, layout.BOTH)
    for name in proxies:
        scan = Sdf.CreatePrimInLayer(actor.layer, Sdf.Path(MESH_PATHS[name]).ReplacePrefix(actor.path, both))
        _set_purpose(scan, UsdGeom.Tokens.render)
        layers.set_relationship(scan, "proxyPrim", _proxy_path(name), custom=False)


def _proxy_path(name: str) -> str:
    return f"{MESH_PATHS[name].removesuffix('Mesh')}Proxy"


def _set_purpose(prim: Sdf.PrimSpec, purpose: str) -> None:
    layers.set_attribute(prim, "purpose", _TYPES.Token, purpose, custom=False)


def interface_layer(
    rig: JawRig, name: str, meshes: Mapping[str, Mesh], fps: float, proxies: Iterable[str] = ()
) -> Sdf.Layer:
    """Build `actor.usda`, the interface for users and tools; `proxies` are the names of the meshes in `proxy.usdc`."""
    layer = layers.new_layer(fps)
    layer.subLayerPaths.append(f"./{layout.RIG_FILE}")
    actor = layers.define_prim(layer, layout.ACTOR, "Xform")
    actor.kind = Kind.Tokens.component
    actor.assetInfo = {
        "identifier": Sdf.AssetPath(f"./{layout.ACTOR_FILE}"),
        "name": name,
        "version": str(layout.FORMAT_VERSION),
    }
    layers.apply_schemas(actor, layout.SCHEMA_NAME, "GeomModelAPI")
    actor.payloadList.prependedItems = [Sdf.Payload(f"./{layout.GEO_FILE}")]
    if names := list(proxies):
        add_detail_variants(actor, names)
    box = layers.vec3f_array(motion_extent(rig, meshes))
    layers.set_attribute(actor, "extentsHint", _TYPES.Float3Array, box, animated=True, custom=False)
    for parameter, limits in zip(layout.PARAMETERS, rig.d_range, strict=True):
        layers.set_attribute(actor, parameter, _TYPES.Double, 0.0, animated=True)
        layers.set_attribute(actor, f"{parameter}:range", _TYPES.Double2, Gf.Vec2d(*limits.tolist()))
    layers.set_attribute(actor, "jaw:formatVersion", _TYPES.Int, layout.FORMAT_VERSION)
    layers.set_attribute(actor, "jaw:actor", _TYPES.String, name)
    layers.set_attribute(actor, "jaw:lengthUnit", _TYPES.Token, "mm")
    layers.set_attribute(actor, "jaw:angleUnit", _TYPES.Token, "rad")
    layers.set_attribute(actor, "jaw:twistOrder", _TYPES.TokenArray, Vt.TokenArray(["omega", "v"]))
    layers.set_attribute(actor, "jaw:modelHash", _TYPES.String, rig.model_hash)
    for attribute, file in zip(layout.ONNX_ATTRIBUTES, (layout.ONNX_FILE, layout.ENCODE_FILE), strict=True):
        layers.set_attribute(actor, attribute, _TYPES.Asset, Sdf.AssetPath(f"./{file}"))
    layers.set_attribute(actor, "jaw:landmarks:names", _TYPES.TokenArray, Vt.TokenArray(list(LANDMARKS)))
    write_arrays(actor, rig, _INTERFACE_ARRAYS)
    layers.set_relationship(actor, "jaw:skull", layout.SKULL)
    layers.set_relationship(actor, "jaw:mandible", layout.MANDIBLE)
    return layer


def record_sidecars(layer: Sdf.Layer, folder: Path) -> None:
    """Record the SHA-256 checksums of the ONNX files in `actor.usda`, as custom data."""
    for attribute, file in zip(layout.ONNX_ATTRIBUTES, (layout.ONNX_FILE, layout.ENCODE_FILE), strict=True):
        hashes = {layout.SIDECAR_HASH_KEY: sha256_of(folder / file)}
        layer.GetAttributeAtPath(f"{layout.ACTOR}.{attribute}").customData = hashes


def decoder_layer(rig: JawRig, table: DecoderTable) -> Sdf.Layer:
    """Build `rig.usdc`, without JawRigAPI: the exact model, the bounds, and the sampled table with its error."""
    layer = layers.new_layer()
    actor = layers.define_prim(layer, layout.ACTOR, "Xform")
    layers.set_attribute(actor, "jaw:meta", _TYPES.String, json.dumps(rig.meta, sort_keys=True))
    layers.set_attribute(actor, "jaw:model:kind", _TYPES.Token, rig.kind)
    write_arrays(actor, rig, _DECODER_ARRAYS)
    layers.set_attribute(actor, "jaw:decoder:format", _TYPES.Token, table.format)
    layers.set_attribute(
        actor, "jaw:decoder:shape", _TYPES.IntArray, layers.int_array([len(axis) for axis in table.axes])
    )
    for i, axis in enumerate(table.axes, start=1):
        layers.set_attribute(actor, f"jaw:decoder:d{i}Knots", _TYPES.DoubleArray, layers.double_array(axis))
    layers.set_attribute(actor, "jaw:decoder:twists", _TYPES.FloatArray, layers.float_array(table.twists))
    layers.set_attribute(actor, "jaw:decoder:maxError", _TYPES.Double, float(table.max_error_mm))
    layers.set_attribute(actor, "jaw:decoder:errorSamples", _TYPES.Int, int(table.error_samples))
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


def bake_rig(
    folder: AnyPath,
    rig: JawRig,
    meshes: Mapping[str, Mesh],
    *,
    name: str,
    fps: float,
    frames: ArrayLike | None = None,
    d: ArrayLike | None = None,
    table_size: int = DEFAULT_SIZE,
    proxies: Mapping[str, Mesh] | None = None,
    prim_name: str = Sdf.Path(layout.ACTOR).name,
) -> list[Path]:
    """Write a rig: interface, decoder, geometry, ONNX graphs, captured motion if there is one, skeleton, package.

    A missing mandible mesh, and a missing skull with it, are replaced by estimated bones, which are marked as
    placeholders. Every file is written atomically, `actor.usda` after the files it refers to. The files are returned in
    the order written.

    Args:
        folder: Output folder; created if missing.
        meshes: `upper_teeth` and optionally `skull` in the skull frame, `lower_teeth` and optionally `mandible` in the
            mandible frame [mm].
        fps: Frame rate of the captured motion [frames per second].
        frames: Increasing numbers of the captured frames (F,).
        d: Parameters of the captured frames (F, 3) [mm], NaN where lost.
        table_size: Knots per axis of the sampled decoder: 17, 33 or 65.
        proxies: Low-polygon proxies of some of the meshes, with the same names; each adds variants.
        prim_name: Name of the actor's prim, and prefix of the joint names.

    Raises:
        RigError: Invalid meshes, bounds, frames, frame rate or prim name.
        OutputError: A file cannot be written.
        ValueError: Frames without d, or d without frames.
    """
    folder = Path(folder)
    if (frames is None) != (d is None):
        raise ValueError("frames and d belong together: give both or neither")
    if not fps > 0:
        raise RigError(f"the frame rate is {fps}; it must be greater than 0.", path=folder)
    check_meshes(meshes)
    layout.check_prim_name(prim_name)
    meshes, estimate = with_estimated_bones(rig, meshes)
    geometry = build_geometry(meshes, rig.T_rest, estimate)
    moving = np.concatenate([meshes[key].vertices for key in ("mandible", "lower_teeth")])
    table = build_table(rig, moving, table_size)
    written = [layers.write_layer(layers.rename_actor(geometry, prim_name), folder / layout.GEO_FILE)]
    if proxies:
        thinned = proxy_layer(proxies, meshes, rig.T_rest, estimate)
        written.append(layers.write_layer(layers.rename_actor(thinned, prim_name), folder / layout.PROXY_FILE))
    written += [
        layers.write_layer(layers.rename_actor(decoder_layer(rig, table), prim_name), folder / layout.RIG_FILE),
        write_onnx(folder / layout.ONNX_FILE, decode_model(rig)),
        write_onnx(folder / layout.ENCODE_FILE, encode_model(rig)),
    ]
    for sidecar in (layout.ONNX_FILE, layout.ENCODE_FILE):
        check_written(folder / sidecar, rig)
    interface = interface_layer(rig, name, meshes, fps, proxies or ())
    record_sidecars(interface, folder)
    record_checksums(interface, folder, [path.name for path in written if path.suffix == ".usdc"])
    written.append(layers.write_layer(layers.rename_actor(interface, prim_name), folder / layout.ACTOR_FILE))
    written.append(write_skel(folder / layout.SKEL_FILE, rig, list(meshes), fps, frames, d, prim_name))
    shown = folder / layout.ACTOR_FILE
    if frames is not None and d is not None:
        skinned = [MESH_PATHS[key] for key in meshes]
        shown = write_animation(
            folder / layout.CAPTURED_FILE, folder / layout.ACTOR_FILE, frames, d, fps, rig=rig, skinned=skinned
        )
        written.append(shown)
    written.append(write_package(folder / layout.PACKAGE_FILE, shown))
    return written
