"""The package for viewers: one `.usdz` with everything flattened into one layer."""

from __future__ import annotations

import os
from pathlib import Path

from pxr import Gf, Sdf, Usd, UsdUtils

from jawusd.errors import RigError
from jawusd.formats.atomic import atomic_path, scratch_folder
from jawusd.rig.checksums import CHECKSUMS
from jawusd.rig.layout import ACTOR, MANDIBLE, ONNX_ATTRIBUTES
from jawusd.rig.read import open_stage

# Archives store the times of their files. A fixed one gives equal packages: the first a zip can hold in any time zone.
_ZIP_EPOCH = 315_619_200
_INSIDE = "actor.usdc"
# Binary layers store vectors of small whole numbers in another way, which three.js (r187) reads as NaN.
_NOT_WHOLE_MM = 1e-9


def write_package(out: str | os.PathLike[str], source: str | os.PathLike[str]) -> Path:
    """Flatten a stage of one actor, `actor.usda` or an animation layer on it, into a `.usdz`.

    The layer inside is binary: a third of the size of text, and open at once. The ONNX files stay outside: packages may
    hold USD, images and sound only.

    Raises:
        RigError: The source cannot be opened or packed.
        OutputError: The package cannot be written.
    """
    out = Path(out)
    layer = _flattened(open_stage(source))
    with scratch_folder(out) as scratch:
        flat = scratch / _INSIDE
        if not layer.Export(str(flat)):
            raise RigError("OpenUSD could not flatten the actor.", path=source)
        os.utime(flat, (_ZIP_EPOCH, _ZIP_EPOCH))
        with atomic_path(out) as temporary:
            if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(flat)), str(temporary)):
                raise RigError("OpenUSD could not pack the actor.", path=out)
    return out


def _flattened(stage: Usd.Stage) -> Sdf.Layer:
    layer = stage.Flatten(addSourceFileComment=False)
    layer.customLayerData = {key: value for key, value in layer.customLayerData.items() if key != CHECKSUMS}
    actor = layer.GetPrimAtPath(ACTOR)
    for prop in actor.properties:
        # flattening drops `custom` where the schema is known, and Blender imports no other attribute
        if prop.name.startswith("jaw:"):
            prop.custom = True
    for attribute in ONNX_ATTRIBUTES:
        actor.RemoveProperty(layer.GetPropertyAtPath(f"{ACTOR}.{attribute}"))
    _avoid_whole(layer, Sdf.Path(MANDIBLE).AppendProperty("xformOp:translate"))
    # the identifier is an asset path too: it would be packed
    actor.assetInfo = {key: value for key, value in dict(actor.assetInfo).items() if key != "identifier"}
    return layer


def _avoid_whole(layer: Sdf.Layer, path: Sdf.Path) -> None:
    """Move translations of whole numbers by a millionth of a micrometre."""

    def moved(value: Gf.Vec3d) -> Gf.Vec3d:
        return value + Gf.Vec3d(_NOT_WHOLE_MM, 0, 0) if all(x == round(x) for x in value) else value

    attribute = layer.GetAttributeAtPath(path)
    if attribute is None:
        return
    if attribute.default is not None:
        attribute.default = moved(attribute.default)
    for time in layer.ListTimeSamplesForPath(path):
        layer.SetTimeSample(path, time, moved(layer.QueryTimeSample(path, time)))
