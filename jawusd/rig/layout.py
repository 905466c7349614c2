"""Prim paths and file names of a rig; `jawusd.evaluator.schema` has the attributes of the model arrays."""

from __future__ import annotations

from pathlib import Path

from jawusd.errors import RigError

FORMAT_VERSION = 2

ACTOR, GEO, MATERIALS = "/Actor", "/Actor/geo", "/Actor/mtl"
SKULL, MANDIBLE = "/Actor/geo/Skull", "/Actor/geo/Mandible"

ACTOR_FILE, RIG_FILE, GEO_FILE = "actor.usda", "rig.usdc", "geo.usdc"
ONNX_FILE, ENCODE_FILE = "actor.onnx", "actor_encode.onnx"
SKEL_FILE, PACKAGE_FILE = "actor_skel.usdc", "actor.usdz"
PROXY_FILE = "proxy.usdc"

DETAIL, SCAN, PROXY, BOTH = "detail", "scan", "proxy", "both"  # a variant set and its variants
MOTION, TRANSFORMS, SKELETON = "motion", "transforms", "skeleton"  # the one of the captured motion

PARAMETERS = ("jaw:d1", "jaw:d2", "jaw:d3")
ONNX_ATTRIBUTES = ("jaw:onnx", "jaw:onnx:encode")
MADE_FOR = "modelHash"  # key of the custom data of sampled parameters: the model that they are meant for
SIDECAR_HASH = "sha256"  # key of the custom data of these attributes


def actor_in_folder(path: Path) -> Path:
    """Return the actor of a rig's folder, as built or as published under another name; other paths as they are.

    Raises:
        RigError: a folder without one.
    """
    if not path.is_dir():
        return path
    actor = path / ACTOR_FILE
    published = [file for file in path.glob("*.usda") if file.with_name(f"{file.stem}_{RIG_FILE}").is_file()]
    if not actor.exists() and len(published) == 1:
        return published[0]
    if not actor.exists():
        hint = "Name the folder of a build (jawusd build ... -o FOLDER), or a file of it."
        if (path / "capture.toml").exists():
            hint = f"It is a capture; build a rig from it with: jawusd build {path} -o out"
        raise RigError(f"is a folder without {ACTOR_FILE}.", path=path, hint=hint)
    return actor
