"""Read USD from untrusted sources: files outside a rig's folder stay closed, faults of a file become FormatErrors."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ParamSpec, TypeVar

from pxr import Sdf, Tf, Usd

from jawusd.errors import FormatError, RigError
from jawusd.formats.allowed_folders import is_allowed
from jawusd.rig.asset_paths import (
    asset_paths,
    clip_templates,
    escapes,
    file_of,
    has_variable_paths,
    is_layer,
    of_template,
)
from jawusd.rig.checksums import check_checksum, recorded_checksums
from jawusd.rig.nesting import MOST_LEVELS, has_deep_arc, is_too_deep
from jawusd.rig.schema import SCHEMA_NAME

# an asset path, the folder of the rig that it is part of, and the layer outside whose folder it lies
_Named = tuple[str, Path | None, str | None]

P = ParamSpec("P")
R = TypeVar("R")

#: A value in USD has whatever type its file declares; code that expects another type raises one of these.
FAULTS = (
    ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError, TypeError, ValueError, Tf.ErrorException,
)  # fmt: skip
_ALLOW = "If you trust it, allow its folder with --allow or the setting JAWUSD_ALLOW."
_TOO_DEEP = f"is nested too deeply, at most {MOST_LEVELS} levels are read."
_UNREADABLE = "is not a USD file that OpenUSD can read."
_WRITE_OUT = "Write asset paths out, without expressionVariables."
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
            except FAULTS as error:
                raise FormatError(fault_message(error), path=str(args[argument])) from error

        return wrapped

    return decorate


def fault_message(error: BaseException) -> str:
    """Return what a fault of a file's values is called."""
    found = (str(error).strip().splitlines() or [type(error).__name__])[-1]
    return f"holds values that cannot be ({found:.200})."


def open_checked(path: Path) -> Usd.Stage:
    """Open a stage that names no files but those it may.

    Raises:
        RigError: It is not USD, or names files that `check_reach` forbids.
    """
    try:
        layers = check_reach(path)
        stage = Usd.Stage.Open(str(path))
    except (Tf.ErrorException, RuntimeError, ValueError, OSError) as error:
        raise RigError(_UNREADABLE, path=path) from error
    if not layers or stage is None:
        raise RigError(_UNREADABLE, path=path)
    check_composed(stage, layers)
    return stage


def check_reach(path: Path) -> list[Sdf.Layer]:
    """Check, before a layer or package is composed, that a rig's layers name only files in their own folder or below.

    Layers that only use a rig (animation, shots) may name it outside their folder, and nothing else, in values neither:
    what values name is read (ONNX) and packed (pictures). Files that a rig's layers name must lie in the rig's folder,
    with links resolved. Any may lie in folders that were allowed, see `formats.allowed_folders`.

    Returns:
        The layers, which stay loaded as long as they are referenced.

    Raises:
        RigError: A path that is not allowed, or a layer that is damaged.
    """
    layers: list[Sdf.Layer] = []
    seen = set()
    sums: dict[Path, str] = {}
    waiting: list[_Named] = [(str(path), None, None)]
    while waiting:
        name, home, user = waiting.pop()
        if (name, home) in seen:
            continue
        seen.add((name, home))
        layer = _layer(name, sums)
        if layer is None:
            continue
        layers.append(layer)
        sums |= recorded_checksums(layer)
        if home is None and _carries_rig(layer):
            home = file_of(name).resolve().parent
        if home is None and user is not None:
            raise RigError(f"names the file {name:.200}, outside its own folder and no rig.", path=user, hint=_ALLOW)
        waiting += _layers_named(layer, home)
    if has_variable_paths(layers):
        raise RigError("names files by variables, which any layer may set.", path=path, hint=_WRITE_OUT)
    return layers


def check_composed(stage: Usd.Stage, checked: list[Sdf.Layer]) -> None:
    """Check that a stage holds no layers but those of `check_reach`.

    Raises:
        RigError: It holds another.
    """
    known = {file_of(layer.identifier).resolve() for layer in checked}
    for layer in stage.GetUsedLayers():
        if not layer.anonymous and file_of(layer.identifier).resolve() not in known:
            raise RigError(
                f"is composed of {layer.identifier:.200}, which it does not name.", path=checked[0].identifier
            )


def _layers_named(layer: Sdf.Layer, home: Path | None) -> list[_Named]:
    """Return the layers that a layer names, after checking all files that it names.

    Args:
        home: Folder of the rig that the layer is part of; None where it only uses rigs.
    """
    folder = home or file_of(layer.identifier).resolve().parent
    templates = clip_templates(layer)
    named: list[_Named] = []
    for template in templates:  # first: OpenUSD lists their folders when it is asked for asset paths
        pattern = file_of(layer.ComputeAbsolutePath(template))
        _check_inside(layer, template, pattern, folder)
        for file in of_template(pattern):
            _check_inside(layer, file.name, file, folder)
            named.append((str(file), None if is_allowed(file) else home, None))
    composed = layer.GetCompositionAssetDependencies()
    for asset in asset_paths(layer):
        target = layer.ComputeAbsolutePath(asset)
        file = file_of(target)
        is_part = asset in composed or is_layer(asset)
        if home is not None or not is_part:
            _check_inside(layer, asset, file, folder)
        if is_part:
            inside = is_allowed(file) or file.resolve().is_relative_to(folder)
            named.append((target, None if is_allowed(file) else home, None if inside else layer.identifier))
    return named


def _check_inside(layer: Sdf.Layer, asset: str, file: Path, folder: Path) -> None:
    if not is_allowed(file) and (escapes(asset) or not file.resolve().is_relative_to(folder)):
        raise RigError(f"names the file {asset:.200}, outside its own folder.", path=layer.identifier, hint=_ALLOW)


def _layer(name: str, sums: Mapping[Path, str]) -> Sdf.Layer | None:
    """Open a layer, after comparing its file with the checksum that a rig has for it; None if there is no such file.

    Raises:
        RigError: It is damaged, or no layer.
    """
    file = file_of(name)
    if not file.exists():
        return None
    if not file.is_file():
        raise RigError("is not a file.", path=file)
    if is_too_deep(file):
        raise RigError(_TOO_DEEP, path=file)
    if (wanted := sums.get(file.resolve())) is not None:
        check_checksum(file, wanted)
    try:
        layer = Sdf.Layer.FindOrOpen(name)
    except Tf.ErrorException as error:
        raise RigError(_UNREADABLE, path=file) from error
    if layer is not None and not _is_whole(layer):
        raise RigError("is damaged: it names prims or properties that it does not hold.", path=file)
    return layer


def _is_whole(layer: Sdf.Layer) -> bool:
    """Return whether a layer holds all prims and properties it names; OpenUSD ends the process where it does not.

    Raises:
        RigError: A prim lies too deep, or names one that does.
    """
    missing = []

    def visit(path: Sdf.Path) -> None:
        named = path.IsPropertyPath() or path.IsPrimPath() or path.IsPrimVariantSelectionPath()
        spec = layer.GetObjectAtPath(path) if named else None
        if path.isEmpty or (named and not spec):
            missing.append(path)
        elif path.pathElementCount > MOST_LEVELS or (isinstance(spec, Sdf.PrimSpec) and has_deep_arc(spec)):
            raise RigError(_TOO_DEEP, path=layer.identifier)

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    return not missing


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
