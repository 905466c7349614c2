"""Names of a rig in USD: prim paths, files, attributes and the codeless schema JawRigAPI.

Layers are built with the prim paths below and renamed after the actor when they are written (`layers.rename_actor`).
Rigs are read and written without the schema plugin: attributes are found by name, and the applied schema in the raw
`apiSchemas` metadata.
"""

from __future__ import annotations

import re
import unicodedata
import warnings
from pathlib import Path

from pxr import Plug, Sdf, Usd, UsdGeom

from jawusd.base.errors import RigError
from jawusd.base.plugin_path import schema_folder

FORMAT_VERSION = 2
SCHEMA_NAME = "JawRigAPI"

ACTOR, GEO, MATERIALS = "/Actor", "/Actor/geo", "/Actor/mtl"
PROXY_SUFFIX = "WithProxies"  # suffix of the class prim that adds the proxies next to the scans
SKULL, MANDIBLE = "/Actor/geo/Skull", "/Actor/geo/Mandible"

ACTOR_FILE, RIG_FILE, GEO_FILE = "actor.usda", "rig.usdc", "geo.usdc"
ONNX_FILE, ENCODE_FILE = "actor.onnx", "actor_encode.onnx"
SKEL_FILE, PACKAGE_FILE = "actor_skel.usdc", "actor.usdz"
PROXY_FILE, CAPTURED_FILE = "proxy.usdc", "anim_capture.usdc"
#: A finished rig that ships with the package, made by `docs/make_example_rig.py` from `examples/capture`.
EXAMPLE_RIG = Path(__file__).with_name("example") / ACTOR_FILE

DETAIL, SCAN, PROXY, BOTH = "detail", "scan", "proxy", "both"  # variant set for the level of detail, and its variants
MOTION, TRANSFORMS, SKELETON = "motion", "transforms", "skeleton"  # variant set for captured motion, and its variants

PARAMETERS = ("jaw:d1", "jaw:d2", "jaw:d3")
ONNX_ATTRIBUTES = ("jaw:onnx", "jaw:onnx:encode")
MODEL_HASH_KEY = "modelHash"  # custom data key of animated parameters: hash of the model with which they were made
SIDECAR_HASH_KEY = "sha256"  # custom data key of the ONNX attributes: checksum of the file


def prim_name_of(actor: str) -> str:
    """Return a valid prim name made from an actor's name: ASCII letters, digits and "_", starting with a letter."""
    plain = unicodedata.normalize("NFKD", actor).encode("ascii", "ignore").decode()
    found = re.sub(r"\W+", "_", plain).strip("_")
    return found if found[:1].isalpha() else "_".join(filter(None, ("Actor", found)))


def check_prim_name(name: str) -> str:
    """Return a name for an actor's prim; raises RigError if it is not an identifier in all versions of OpenUSD."""
    if not (name.isascii() and Sdf.Path.IsValidIdentifier(name)):
        hint = "Use letters, digits and _, starting with a letter, as in hero_2. Set the name with --prim-name."
        raise RigError(f'"{name}" is not a valid prim name.', hint=hint)
    return name


def actor_in_folder(path: Path) -> Path:
    """Return the actor file in the folder of a rig, and other paths unchanged; raises RigError without one."""
    build = f"This is a capture. Build a rig from it: jawusd build {path} -o out"
    if path.suffix == ".toml" and path.is_file():
        raise RigError("is not a rig.", path=path, hint=build)
    if not path.is_dir():
        return path
    actor = path / ACTOR_FILE
    published = [file for file in path.glob("*.usda") if file.with_name(f"{file.stem}_{RIG_FILE}").is_file()]
    if not actor.exists() and len(published) == 1:
        return published[0]
    if not actor.exists():
        hint = "Give the folder of a build (jawusd build ... -o FOLDER), or a file in it."
        if (path / "capture.toml").exists():
            hint = build
        raise RigError(f"is a folder without {ACTOR_FILE}.", path=path, hint=hint)
    return actor


def register_schema() -> bool:
    """Register the schema with OpenUSD and return whether that succeeded; may be called repeatedly.

    Plugins registered after a process first opened a stage are ignored (OpenUSD issue 3596); a warning is then issued.
    """
    folder = schema_folder()
    if folder is not None:
        Plug.Registry().RegisterPlugins(str(folder))
    live = schema_is_live()
    if folder is not None and not live:
        message = f"OpenUSD does not know {SCHEMA_NAME}: a stage was opened before it was registered. "
        message += f"Import jawusd first, or set PXR_PLUGINPATH_NAME={folder}. Rigs can be read and written without it."
        warnings.warn(message, stacklevel=2)
    return live


def schema_is_live() -> bool:
    """Return whether JawRigAPI is registered in this process. The call freezes the process's schema registry."""
    return Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(SCHEMA_NAME) is not None


def has_jaw_api(prim: Usd.Prim) -> bool:
    """Return whether JawRigAPI is applied to a prim, even if the schema is not registered in this process."""
    applied = prim.GetMetadata("apiSchemas")
    return applied is not None and SCHEMA_NAME in applied.GetAddedOrExplicitItems()


def rig_prims(stage: Usd.Stage) -> list[Usd.Prim]:
    """Return the active prims with JawRigAPI in a stage, including unloaded ones and those inside instances."""
    found = Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsDefined & ~Usd.PrimIsAbstract)
    return [prim for prim in stage.Traverse(found) if has_jaw_api(prim)]


def meshes_below(prim: Usd.Prim) -> list[Usd.Prim]:
    """Return the active meshes at and below a prim, including those inside instances."""
    return [mesh for mesh in Usd.PrimRange(prim, Usd.TraverseInstanceProxies()) if mesh.IsA(UsdGeom.Mesh)]
