"""Packages for viewers (`.usdz`), flattened into one layer, and copies of a rig with unique file names.

Some tools collect the files of several actors in one folder and confuse files of equal names.
"""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdUtils

from jawusd.base.errors import AnyPath, RigError
from jawusd.base.inputs import check_input, is_allowed
from jawusd.formats.atomic import atomic_path, scratch_folder
from jawusd.rig import layers, layout
from jawusd.rig.asset_paths import CHECKSUMS, paths_in, record_checksums
from jawusd.rig.read import describe, open_stage

_ZIP_EPOCH = 315_619_200  # fixed file time in packages [s since 1970], the earliest in a zip of any time zone
_OP = "xformOp:"
_PREFIX = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,63}")
_LAYERS, _COPIED = (".usda", ".usdc", ".usd"), (".onnx",)
# Files of a rig, each before the files that refer to it.
_FIRST = (layout.GEO_FILE, layout.PROXY_FILE, layout.RIG_FILE, layout.ONNX_FILE, layout.ENCODE_FILE, layout.ACTOR_FILE)
_NAMES_INSIDE = "actor.usdc", "shot.usdc"
_OFFSET = 1e-9  # makes integers non-integer: three.js (r187) decodes compressed vectors of integers as NaN


def write_package(out: AnyPath, source: AnyPath) -> Path:
    """Flatten `actor.usda`, an animation layer on it, or a shot with several actors into a `.usdz`, without ONNX files.

    Raises:
        RigError: The source cannot be opened or packed, or has no rig.
        OutputError: The package cannot be written.
    """
    out = Path(out)
    layer = _flattened(open_stage(source), source)
    with scratch_folder(out) as scratch:
        rigs = [path for path in _rigs_in(layer) if not path.IsRootPrimPath()]
        flat = scratch / _NAMES_INSIDE[bool(rigs)]
        if not layer.Export(str(flat)):
            raise RigError("OpenUSD could not flatten it.", path=source)
        os.utime(flat, (_ZIP_EPOCH, _ZIP_EPOCH))
        with atomic_path(out) as temporary:
            if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(flat)), str(temporary)):
                raise RigError("OpenUSD could not pack it.", path=out)
    return out


def _flattened(stage: Usd.Stage, source: AnyPath) -> Sdf.Layer:
    layer = stage.Flatten(addSourceFileComment=False)
    rigs = _rigs_in(layer)
    if not rigs:
        raise RigError("has no jaw rig.", path=source)
    layer.customLayerData = {key: value for key, value in layer.customLayerData.items() if key != CHECKSUMS}
    for path in rigs:
        actor = layer.GetPrimAtPath(path)
        for prop in actor.properties:
            # flattening drops `custom` if the schema is known, and Blender imports only custom attributes
            if prop.name.startswith("jaw:"):
                prop.custom = True
        for attribute in layout.ONNX_ATTRIBUTES:
            if attribute in actor.properties:
                actor.RemoveProperty(actor.properties[attribute])
        # the identifier is an asset path, so its file would be packed
        actor.assetInfo = {key: value for key, value in dict(actor.assetInfo).items() if key != "identifier"}
    _avoid_integers(layer)
    return layer


def _rigs_in(layer: Sdf.Layer) -> list[Sdf.Path]:
    """Return the rig prims of a flattened layer; its prototypes have other paths than those of the stage."""
    flat = Usd.Stage.Open(layer)
    return [prim.GetPath() for prim in flat.TraverseAll() if layout.has_jaw_api(prim)]


def _avoid_integers(layer: Sdf.Layer) -> None:
    """Offset integer-valued transforms by `_OFFSET` or, in single precision, to the next representable number."""
    for path in paths_in(layer):
        attribute = layer.GetAttributeAtPath(path) if _OP in path.name else None
        if attribute is None:
            continue
        if attribute.default is not None:
            attribute.default = _offset(attribute.default)
        for time in layer.ListTimeSamplesForPath(path):
            layer.SetTimeSample(path, time, _offset(layer.QueryTimeSample(path, time)))


def _offset(value: object) -> object:
    """Return a vector of integers with a small offset, and other values unchanged."""
    if not isinstance(value, Gf.Vec3d | Gf.Vec3f) or any(x != round(x) for x in value):
        return value
    first = value[0] + _OFFSET
    if isinstance(value, Gf.Vec3f):  # the next single-precision number
        first = float(np.nextafter(np.float32(value[0]), np.float32(np.inf))) if value[0] else _OFFSET
    return type(value)(first, value[1], value[2])


def publish_rig(folder: AnyPath, out: AnyPath, prefix: str | None = None, prim_name: str | None = None) -> list[Path]:
    """Copy the layers and ONNX graphs of a rig to another folder under prefixed names, and write a new package.

    `actor.usda` becomes `hero.usda`, `rig.usdc` becomes `hero_rig.usdc`. References in the layers are updated. The
    files are returned in the order written.

    Args:
        folder: The rig's folder.
        out: The folder to write.
        prefix: Prefix of all file names; None: the actor's name, in which characters not allowed in file names are
            replaced.
        prim_name: Name of the actor's prim and prefix of its joints; None: derived from the actor's name.

    Raises:
        RigError: There is no rig, the prefix is invalid, or the output is the rig's own folder.
        OutputError: A file cannot be written.
    """
    folder, out = Path(folder), Path(out)
    actor = folder / layout.ACTOR_FILE
    described = describe(actor)
    if prefix is None:
        prefix = re.sub(r"[^A-Za-z0-9_-]", "_", described["actor"])
    if not _PREFIX.fullmatch(prefix):
        raise RigError(
            f'"{prefix}" is not a valid prefix: use letters, digits, "_" and "-", starting with a letter.',
            path=actor,
            hint="Set another one with --prefix.",
        )
    if out.resolve() == folder.resolve():
        raise RigError("is the rig's own folder; publish to another folder.", path=out)
    found = [path.name for path in sorted(folder.iterdir()) if path.suffix in (*_LAYERS, *_COPIED)]
    ordered = [*(name for name in _FIRST if name in found), *(name for name in found if name not in _FIRST)]
    names = {name: _prefixed(prefix, name) for name in ordered}
    for name in names:
        _check_own(folder / name)
    out.mkdir(parents=True, exist_ok=True)
    prims = (
        Sdf.Path(described["prim"]).name,
        layout.check_prim_name(prim_name or layout.prim_name_of(described["actor"])),
    )
    written = [_copy(folder / name, out / new, names, prims) for name, new in names.items()]
    shown = names.get(layout.CAPTURED_FILE, names[layout.ACTOR_FILE])
    return [*written, write_package(out / _prefixed(prefix, layout.PACKAGE_FILE), out / shown)]


def _check_own(path: Path) -> None:
    """Raise RigError if a file to be copied is not a regular file, or links to another folder."""
    check_input(path, RigError)
    if not is_allowed(path) and not path.resolve().is_relative_to(path.parent.resolve()):
        raise RigError("links to a file outside its own folder.", path=path, hint="Replace the link with a copy.")


def _prefixed(prefix: str, name: str) -> str:
    """Return a file name with the prefix, which replaces "actor" at its start."""
    return prefix + (name.removeprefix("actor") if name.startswith("actor") else f"_{name}")


def _copy(source: Path, target: Path, names: dict[str, str], prims: tuple[str, str]) -> Path:
    """Copy a file; rename the files it refers to (`names`) and the actor's prim (`prims`: before, after)."""
    if source.suffix in _COPIED:
        with atomic_path(target) as temporary:
            shutil.copyfile(source, temporary)
        return target
    open_stage(source)  # rejects references to files outside the rig's folder
    layer = Sdf.Layer.OpenAsAnonymous(str(source))

    def renamed(asset: str) -> str:
        parts = asset.removeprefix("./").split("/")
        return f"./{names[parts[0]]}" if len(parts) == 1 and parts[0] in names else asset

    UsdUtils.ModifyAssetPaths(layer, renamed)
    layers.rename_actor(layer, prims[1], prims[0], "|".join(["", *(rf"\./{re.escape(new)}" for new in names.values())]))
    if source.name == layout.ACTOR_FILE:
        record_checksums(
            layer,
            target.parent,
            [names[name] for name in (layout.GEO_FILE, layout.PROXY_FILE, layout.RIG_FILE) if name in names],
        )
    return layers.write_layer(layer, target)
