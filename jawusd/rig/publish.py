"""Copy a rig under names of its own: tools that gather files from several actors into one folder mix up equal names."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

from pxr import Sdf, UsdUtils

from jawusd.base.errors import RigError
from jawusd.base.inputs import check_input, is_allowed
from jawusd.formats.atomic import atomic_path
from jawusd.rig.checksums import record_checksums
from jawusd.rig.layers import named_after, write_layer
from jawusd.rig.layout import (
    ACTOR_FILE,
    ENCODE_FILE,
    GEO_FILE,
    ONNX_FILE,
    PACKAGE_FILE,
    PROXY_FILE,
    RIG_FILE,
    check_prim_name,
    prim_name_of,
)
from jawusd.rig.package import write_package
from jawusd.rig.read import describe, open_stage

_PREFIX = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,63}")
_LAYERS, _COPIED = (".usda", ".usdc", ".usd"), (".onnx",)
_FIRST = (GEO_FILE, PROXY_FILE, RIG_FILE, ONNX_FILE, ENCODE_FILE, ACTOR_FILE)  # written before what refers to them
_CAPTURED = "anim_capture.usdc"


def publish_rig(
    folder: str | os.PathLike[str], out: str | os.PathLike[str], prefix: str | None = None, prim_name: str | None = None
) -> list[Path]:
    """Copy the layers and graphs of a rig's folder to another one, with a prefix to every name, and pack it anew.

    `actor.usda` becomes `hero.usda`, `rig.usdc` `hero_rig.usdc`; what the layers name is renamed in them.

    Args:
        prefix: Starts every name; None: the actor's name, as far as it makes file names.
        prim_name: Of the actor's prim, and in front of joints; None: after the actor.

    Returns:
        The files, in the order written.

    Raises:
        RigError: No rig, a prefix that makes no file names, or a folder that would be written over.
        OutputError: A file cannot be written.
    """
    folder, out = Path(folder), Path(out)
    actor = folder / ACTOR_FILE
    described = describe(actor)
    if prefix is None:
        prefix = re.sub(r"[^A-Za-z0-9_-]", "_", described["actor"])
    if not _PREFIX.fullmatch(prefix):
        raise RigError(
            f'"{prefix}" starts no file names; letters, digits, "_" and "-" do, from a letter on.',
            path=actor,
            hint="Give another one with --prefix.",
        )
    if out.resolve() == folder.resolve():
        raise RigError("is the rig's own folder; publish to another one.", path=out)
    found = [path.name for path in sorted(folder.iterdir()) if path.suffix in (*_LAYERS, *_COPIED)]
    ordered = [*(name for name in _FIRST if name in found), *(name for name in found if name not in _FIRST)]
    names = {name: _named(prefix, name) for name in ordered}
    for name in names:
        _check_own(folder / name)
    out.mkdir(parents=True, exist_ok=True)
    prims = Sdf.Path(described["prim"]).name, check_prim_name(prim_name or prim_name_of(described["actor"]))
    written = [_copy(folder / name, out / new, names, prims) for name, new in names.items()]
    shown = names.get(_CAPTURED, names[ACTOR_FILE])
    return [*written, write_package(out / _named(prefix, PACKAGE_FILE), out / shown)]


def _check_own(path: Path) -> None:
    """Check that a file that is copied is one, and that no link brings it from elsewhere.

    Raises:
        RigError: It is not.
    """
    check_input(path, RigError)
    if not is_allowed(path) and not path.resolve().is_relative_to(path.parent.resolve()):
        raise RigError("links to a file outside its own folder.", path=path, hint="Put a copy in its place.")


def _named(prefix: str, name: str) -> str:
    """Return a name with the prefix, which takes the place of "actor"."""
    return prefix + (name.removeprefix("actor") if name.startswith("actor") else f"_{name}")


def _copy(source: Path, target: Path, names: dict[str, str], prims: tuple[str, str]) -> Path:
    """Copy a file with the names of files and of the actor's prim, before and after, changed in it."""
    if source.suffix in _COPIED:
        with atomic_path(target) as temporary:
            shutil.copyfile(source, temporary)
        return target
    open_stage(source)  # refuses what reaches out of its folder
    layer = Sdf.Layer.OpenAsAnonymous(str(source))

    def renamed(asset: str) -> str:
        parts = asset.removeprefix("./").split("/")
        return f"./{names[parts[0]]}" if len(parts) == 1 and parts[0] in names else asset

    UsdUtils.ModifyAssetPaths(layer, renamed)
    named_after(layer, prims[1], prims[0], "|".join(["", *(rf"\./{re.escape(new)}" for new in names.values())]))
    if source.name == ACTOR_FILE:
        record_checksums(
            layer, target.parent, [names[name] for name in (GEO_FILE, PROXY_FILE, RIG_FILE) if name in names]
        )
    return write_layer(layer, target)
