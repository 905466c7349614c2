"""The package for viewers: one `.usdz` with everything flattened into a text layer."""

from __future__ import annotations

import os
from pathlib import Path

from pxr import Sdf, Usd, UsdUtils

from jawusd.errors import RigError
from jawusd.formats.atomic import atomic_path, scratch_folder
from jawusd.rig.layout import ACTOR, ACTOR_FILE, ONNX_ATTRIBUTES
from jawusd.rig.read import open_stage

# Archives store the times of their files. A fixed one gives equal packages: the first a zip can hold in any time zone.
_ZIP_EPOCH = 315_619_200


def write_package(out: str | os.PathLike[str], source: str | os.PathLike[str]) -> Path:
    """Flatten a stage of one actor, `actor.usda` or an animation layer on it, into a `.usdz`.

    The layer inside is text: three.js turns a whole-number translation of a binary layer into NaN. The ONNX files stay
    outside: packages may hold USD, images and sound only.

    Raises:
        RigError: The source cannot be opened or packed.
        OutputError: The package cannot be written.
    """
    out = Path(out)
    layer = _flattened(open_stage(source))
    with scratch_folder(out) as scratch:
        text = scratch / ACTOR_FILE
        if not layer.Export(str(text)):
            raise RigError("OpenUSD could not flatten the actor.", path=source)
        os.utime(text, (_ZIP_EPOCH, _ZIP_EPOCH))
        with atomic_path(out) as temporary:
            if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(text)), str(temporary)):
                raise RigError("OpenUSD could not pack the actor.", path=out)
    return out


def _flattened(stage: Usd.Stage) -> Sdf.Layer:
    layer = stage.Flatten(addSourceFileComment=False)
    actor = layer.GetPrimAtPath(ACTOR)
    for prop in actor.properties:
        # flattening drops `custom` where the schema is known, and Blender imports no other attribute
        if prop.name.startswith("jaw:"):
            prop.custom = True
    for attribute in ONNX_ATTRIBUTES:
        actor.RemoveProperty(layer.GetPropertyAtPath(f"{ACTOR}.{attribute}"))
    # the identifier is an asset path too: it would be packed
    actor.assetInfo = {key: value for key, value in dict(actor.assetInfo).items() if key != "identifier"}
    return layer
