"""The package for viewers: one `.usdz` of an actor or a whole shot, flattened into one layer."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdUtils

from jawusd.base.errors import RigError
from jawusd.formats.atomic import atomic_path, scratch_folder
from jawusd.rig.checksums import CHECKSUMS
from jawusd.rig.layout import ONNX_ATTRIBUTES
from jawusd.rig.read import open_stage
from jawusd.rig.schema import has_jaw_api

# Archives store the times of their files. A fixed one gives equal packages: the first a zip can hold in any time zone.
_ZIP_EPOCH = 315_619_200
_OP = "xformOp:"
_INSIDE = "actor.usdc", "shot.usdc"
# Binary layers store vectors of small whole numbers in another way, which three.js (r187) reads as NaN.
_NOT_WHOLE = 1e-9


def write_package(out: str | os.PathLike[str], source: str | os.PathLike[str]) -> Path:
    """Flatten a stage, `actor.usda`, an animation layer on it or a shot with several actors, into a `.usdz`.

    The layer inside is binary: a third of the size of text, and open at once. The ONNX files stay outside: packages may
    hold USD, images and sound only.

    Raises:
        RigError: The source cannot be opened or packed, or holds no rig.
        OutputError: The package cannot be written.
    """
    out = Path(out)
    layer = _flattened(open_stage(source), source)
    with scratch_folder(out) as scratch:
        rigs = [path for path in _rigs_in(layer) if not path.IsRootPrimPath()]
        flat = scratch / _INSIDE[bool(rigs)]
        if not layer.Export(str(flat)):
            raise RigError("OpenUSD could not flatten it.", path=source)
        os.utime(flat, (_ZIP_EPOCH, _ZIP_EPOCH))
        with atomic_path(out) as temporary:
            if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(flat)), str(temporary)):
                raise RigError("OpenUSD could not pack it.", path=out)
    return out


def _flattened(stage: Usd.Stage, source: str | os.PathLike[str]) -> Sdf.Layer:
    layer = stage.Flatten(addSourceFileComment=False)
    rigs = _rigs_in(layer)
    if not rigs:
        raise RigError("holds no jaw rig.", path=source)
    layer.customLayerData = {key: value for key, value in layer.customLayerData.items() if key != CHECKSUMS}
    for path in rigs:
        actor = layer.GetPrimAtPath(path)
        for prop in actor.properties:
            # flattening drops `custom` where the schema is known, and Blender imports no other attribute
            if prop.name.startswith("jaw:"):
                prop.custom = True
        for attribute in ONNX_ATTRIBUTES:
            if attribute in actor.properties:
                actor.RemoveProperty(actor.properties[attribute])
        # the identifier is an asset path too: it would be packed
        actor.assetInfo = {key: value for key, value in dict(actor.assetInfo).items() if key != "identifier"}
    _avoid_whole(layer)
    return layer


def _rigs_in(layer: Sdf.Layer) -> list[Sdf.Path]:
    """Return the prims that carry a rig in a flat layer, not in a stage: what instances share, it holds elsewhere."""
    flat = Usd.Stage.Open(layer)
    return [prim.GetPath() for prim in flat.TraverseAll() if has_jaw_api(prim)]


def _avoid_whole(layer: Sdf.Layer) -> None:
    """Move transforms made of whole numbers by as little as they can be moved, or by a millionth of a micrometre."""
    found: list[Sdf.Path] = []
    layer.Traverse(Sdf.Path.absoluteRootPath, lambda path: found.append(path) if _OP in path.name else None)
    for path in found:
        attribute = layer.GetAttributeAtPath(path)
        if attribute is None:
            continue
        if attribute.default is not None:
            attribute.default = _moved(attribute.default)
        for time in layer.ListTimeSamplesForPath(path):
            layer.SetTimeSample(path, time, _moved(layer.QueryTimeSample(path, time)))


def _moved(value: object) -> object:
    """Return a vector that is not whole; other values as they are."""
    if not isinstance(value, Gf.Vec3d | Gf.Vec3f) or any(x != round(x) for x in value):
        return value
    first = value[0] + _NOT_WHOLE
    if isinstance(value, Gf.Vec3f):  # the next number in single precision
        first = float(np.nextafter(np.float32(value[0]), np.float32(np.inf))) if value[0] else _NOT_WHOLE
    return type(value)(first, value[1], value[2])
