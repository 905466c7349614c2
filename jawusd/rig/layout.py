"""Prim paths and file names of a rig; `jawusd.evaluator.schema` has the attributes of the model arrays.

Layers are built with the paths below, and renamed after the actor as they are written, see `layers.named_after`.
"""

from __future__ import annotations

import re
import unicodedata
from pathlib import Path

from pxr import Sdf

from jawusd.base.errors import RigError

FORMAT_VERSION = 2

ACTOR, GEO, MATERIALS = "/Actor", "/Actor/geo", "/Actor/mtl"
BESIDE = "WithProxies"  # ends the name of the class with the proxies beside the scans
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


def prim_name_of(actor: str) -> str:
    """Return the name of an actor's prim: letters, digits and "_" of the actor's name, from a letter on."""
    plain = unicodedata.normalize("NFKD", actor).encode("ascii", "ignore").decode()
    found = re.sub(r"\W+", "_", plain).strip("_")
    return found if found[:1].isalpha() else "_".join(filter(None, ("Actor", found)))


def check_prim_name(name: str) -> str:
    """Return the name that an actor's prim shall have.

    Raises:
        RigError: It is no identifier that all versions of OpenUSD read.
    """
    if not (name.isascii() and Sdf.Path.IsValidIdentifier(name)):
        hint = "Letters, digits and _ do, from a letter on, as hero_2. Give another one with --prim-name."
        raise RigError(f'"{name}" cannot be the name of a prim.', hint=hint)
    return name


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
