"""Read USD from untrusted sources: files outside a rig's folder stay closed, faults of a file become FormatErrors."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar

from pxr import Sdf, Tf, UsdUtils

from jawusd.errors import FormatError, RigError
from jawusd.formats.allowed_folders import is_allowed
from jawusd.rig.schema import SCHEMA_NAME

P = ParamSpec("P")
R = TypeVar("R")

# A value in USD has whatever type its file declares; code that expects another type raises one of these.
_FAULTS = (
    ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError, TypeError, ValueError, Tf.ErrorException,
)  # fmt: skip
# OpenUSD's text parser recurses for every bracket and ends the process when its stack overflows.
_NESTED = re.compile(rb"(?:[(\[{]\s*){500}")
_ALLOW = "If you trust it, allow its folder with --allow or the setting JAWUSD_ALLOW."
_OF_A_RIG = ("jaw:formatVersion", "jaw:model", "jaw:bounds", "jaw:decoder")


def raises_format_error(argument: int) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that makes a reader raise FormatError where values of a file have unexpected types.

    Args:
        argument: Index of the reader's positional argument that names the file.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def wrapped(*args: P.args, **named: P.kwargs) -> R:
            try:
                return function(*args, **named)
            except _FAULTS as error:
                found = (str(error).strip().splitlines() or [type(error).__name__])[-1]
                raise FormatError(f"holds values that cannot be ({found:.200}).", path=str(args[argument])) from error

        return wrapped

    return decorate


def check_reach(path: Path) -> list[Sdf.Layer]:
    """Check, before a layer or package is composed, that a rig's layers name only files in their own folder or below.

    Layers that only use a rig (animation, shots) may name it outside their folder, and nothing else. Files that a rig's
    layers name must lie in the rig's folder, with links resolved. Any may lie in folders that were allowed, see
    `formats.allowed_folders`.

    Returns:
        The layers, which stay loaded as long as they are referenced.

    Raises:
        RigError: A path that is not allowed.
    """
    layers, seen = [], set()
    waiting: list[tuple[str, Path | None, str | None]] = [(str(path), None, None)]
    while waiting:
        name, home, user = waiting.pop()
        if (name, home) in seen:
            continue
        seen.add((name, home))
        layer = _layer(name)
        if layer is None:
            continue
        layers.append(layer)
        if home is None and _carries_rig(layer):
            home = _file(name).resolve().parent
        if home is None and user is not None:
            raise RigError(f"names the file {name:.200}, outside its own folder and no rig.", path=user, hint=_ALLOW)
        for asset in _assets(layer):
            target = layer.ComputeAbsolutePath(asset)
            allowed = is_allowed(_file(target))
            inside = allowed or _file(target).resolve().is_relative_to(home or _file(name).resolve().parent)
            if home is not None and not allowed and (escapes(asset) or not inside):
                raise RigError(
                    f"names the file {asset:.200}, outside its own folder.", path=layer.identifier, hint=_ALLOW
                )
            if asset in layer.GetCompositionAssetDependencies() or Path(asset).suffix.startswith(".usd"):
                waiting.append((target, None if allowed else home, None if inside else layer.identifier))
    return layers


def escapes(asset: str) -> bool:
    """Return whether an asset path leaves the folder of the layer that names it."""
    parts = asset.replace("\\", "/").split("/")
    depth = 0
    for part in parts:
        depth += {"..": -1, ".": 0, "": 0}.get(part, 1)
        if depth < 0:
            return True
    return asset.startswith(("/", "\\")) or ":" in parts[0]


def _file(name: str) -> Path:
    """Return the file of a layer's name: that of the package for a layer inside one."""
    return Path(name.split("[")[0])


def _layer(name: str) -> Sdf.Layer | None:
    """Open a layer; None if it cannot be opened, which its reader reports later."""
    file = _file(name)
    if not file.exists():
        return None
    if not file.is_file():
        raise RigError("is not a file.", path=file)
    if _NESTED.search(file.read_bytes()):
        raise RigError("is nested too deeply.", path=file)
    try:
        layer = Sdf.Layer.FindOrOpen(name)
    except Tf.ErrorException:
        return None
    if layer is not None and not _is_whole(layer):
        raise RigError("is damaged: it names prims or properties that it does not hold.", path=file)
    return layer


def _is_whole(layer: Sdf.Layer) -> bool:
    """Return whether a layer holds all prims and properties it names; OpenUSD ends the process where it does not."""
    missing = []

    def visit(path: Sdf.Path) -> None:
        named = path.IsPropertyPath() or path.IsPrimPath() or path.IsPrimVariantSelectionPath()
        if path.isEmpty or (named and not layer.GetObjectAtPath(path)):
            missing.append(path)

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    return not missing


def _assets(layer: Sdf.Layer) -> list[str]:
    """Return every file path in a layer: of layers, values, clips and other metadata."""
    found: list[str] = []

    def note(asset: str) -> str:
        found.append(asset)
        return asset

    UsdUtils.ModifyAssetPaths(layer, note)
    return [asset for asset in dict.fromkeys(found) if asset]


def _carries_rig(layer: Sdf.Layer) -> bool:
    found = []

    def visit(path: Sdf.Path) -> None:
        if path.IsPropertyPath():
            found.append(path.name.startswith(_OF_A_RIG))
        elif path.IsPrimPath() or path.IsPrimVariantSelectionPath():
            spec = layer.GetPrimAtPath(path)
            schemas = spec.GetInfo("apiSchemas") if spec else None
            found.append(schemas is not None and SCHEMA_NAME in schemas.GetAddedOrExplicitItems())

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    return any(found)
