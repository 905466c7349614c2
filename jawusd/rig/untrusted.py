"""Open USD from untrusted sources: only permitted files are read, and malformed values raise FormatError."""

from __future__ import annotations

import contextlib
import functools
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple, ParamSpec, TypeVar

from pxr import Ar, Sdf, Tf, Usd

from jawusd.base.errors import FormatError, RigError, naming_file
from jawusd.base.guard import most_cpu, note_input, out_of_memory
from jawusd.base.inputs import is_allowed
from jawusd.rig.asset_paths import (
    asset_paths,
    check_checksum,
    clip_templates,
    file_of,
    file_of_layer,
    files_of_template,
    is_layer,
    paths_in,
    prim_spec_at,
    recorded_checksums,
    target_of,
    with_variables,
)
from jawusd.rig.layout import SCHEMA_NAME


class _LayerRef(NamedTuple):
    """A layer that another layer refers to."""

    target: str  # full path of the layer
    rig_folder: Path | None  # folder of the rig that the layer is part of; None if it is not part of a rig
    user: str | None  # a layer in another folder that refers to this layer, if any
    variables: Mapping[str, object]  # expression variables of the layers that refer to this layer
    is_sublayer: bool = False  # whether the layer is a sublayer; a sublayer's own variables are ignored


P = ParamSpec("P")
R = TypeVar("R")

#: Exceptions that values of an unexpected type may raise; values in USD have whatever type their file declares.
VALUE_ERRORS = (
    ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError, Tf.ErrorException,
)  # fmt: skip
#: Maximum processor time [s] for opening a stage in a guarded process. Rigs take 0.02 s, a million prims about 5 s.
MAX_CPU_S = 20
_ALLOW = "If you trust it, allow its folder with --allow or the environment variable JAWUSD_ALLOW."
_UNREADABLE = "is not a USD file that OpenUSD can read"
_SUFFIXES = (".usda", ".usdc", ".usd", ".usdz")
#: Maximum number of prims and properties in a layer, and of samples of an attribute.
MAX_SPECS, MAX_SAMPLES = 2_000_000, 1_000_000
_MAX_LAYER_READS = 20_000  # maximum number of reads; a layer is read once for each set of variables
_RIG_ATTRIBUTES = ("jaw:formatVersion", "jaw:model", "jaw:bounds", "jaw:decoder")


def raises_format_error(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a reader of a stage: values of unexpected types raise FormatError.

    If its first argument is the `path` of a file, errors without a path get that one.
    """

    @functools.wraps(function)
    def wrapped(*args: P.args, **named: P.kwargs) -> R:
        first = args[0] if args else named.get("path")
        path = first if isinstance(first, str | os.PathLike) else None
        with contextlib.nullcontext() if path is None else naming_file(path):
            try:
                return function(*args, **named)
            except MemoryError as error:
                raise out_of_memory(path) from error
            except VALUE_ERRORS as error:
                raise FormatError(value_error_message(error)) from error

    return wrapped


def value_error_message(error: BaseException) -> str:
    """Return the message for an error caused by a malformed value."""
    found = (str(error).strip().splitlines() or [type(error).__name__])[-1]
    return f"has malformed values ({found:.200})."


def open_checked(path: Path) -> Usd.Stage:
    """Open a stage; raises RigError if it is not USD, or refers to files that `check_file_access` rejects."""
    note_input(path)
    try:
        with most_cpu(MAX_CPU_S):
            layers = check_file_access(path)
            stage = Usd.Stage.Open(str(path))
    except (Tf.ErrorException, RuntimeError, ValueError, OSError) as error:
        raise RigError(_unreadable(path, error), path=path) from error
    if not layers or stage is None:
        raise RigError(_unreadable(path), path=path)
    check_composed(stage, layers)
    return stage


def _unreadable(file: Path, error: BaseException | None = None) -> str:
    """Return the message for an unreadable file, with OpenUSD's reason, such as the line of a syntax error."""
    if file.suffix.lower() not in _SUFFIXES:
        return f"is not a USD file; the name of a USD file ends in {', '.join(_SUFFIXES)}."
    details = error.args if isinstance(error, Tf.ErrorException) else ()
    reason = next((str(each.commentary).strip() for each in details if getattr(each, "commentary", "")), "")
    reason = reason.replace(f"{file.absolute()}:", "line ", 1)
    reason = re.sub(r": parse error matching [^ ]*pegtl.*", ": the text is wrong here, or ends too early", reason)
    return f"{_UNREADABLE}: {reason:.300}" if reason else f"{_UNREADABLE}."


def check_file_access(path: Path) -> list[Sdf.Layer]:
    """Return the layers of a stage after checking, before it is composed, which files they refer to.

    Layers of a rig may refer only to files in the rig's folder or below, with links resolved. Layers that use a rig
    (animations, shots) may refer to rigs outside their folder, but not to other files outside. Asset paths in attribute
    values are checked too, because their files are read (ONNX) or packed (images). Files in allowed folders are always
    accepted; see `base.inputs`. Paths are resolved as OpenUSD does.

    Raises:
        RigError: A path is not allowed, or a layer is damaged.
    """
    resolver = Ar.GetResolver()
    with Ar.ResolverContextBinder(resolver.CreateDefaultContextForAsset(str(path))):
        return _checked_layers(path)


def _checked_layers(path: Path) -> list[Sdf.Layer]:
    layers: list[Sdf.Layer] = []
    seen: set[tuple[str, Path | None, bool, str]] = set()
    sums: dict[Path, str] = {}
    waiting = [_LayerRef(str(path), None, None, {})]
    while waiting:
        ref = waiting.pop()
        name, rig_folder = ref.target, ref.rig_folder
        key = (name, rig_folder, ref.is_sublayer, str(sorted(ref.variables.items())))
        if key in seen:
            continue
        if len(seen) == _MAX_LAYER_READS:
            raise RigError(f"uses variables to refer to layers in more than {_MAX_LAYER_READS} ways.", path=path)
        seen.add(key)
        layer = _layer(name, sums)
        if layer is None:
            continue
        layers.append(layer)
        sums |= recorded_checksums(layer)
        if rig_folder is None and _is_rig_layer(layer):
            rig_folder = file_of(name).resolve().parent
        if rig_folder is None and ref.user is not None:
            raise RigError(
                f"refers to the file {name:.200}, which is outside the folder of this file and not a rig.",
                path=ref.user,
                hint=_ALLOW,
            )
        own = {} if ref.is_sublayer else layer.expressionVariables
        waiting += _referenced_layers(layer, rig_folder, {**own, **ref.variables})
    return layers


def check_composed(stage: Usd.Stage, checked: list[Sdf.Layer]) -> None:
    """Raise RigError if a stage is composed of layers that `check_file_access` did not return."""
    known = {file_of_layer(layer).resolve() for layer in checked}
    for layer in stage.GetUsedLayers():
        if not layer.anonymous and file_of_layer(layer).resolve() not in known:
            raise RigError(
                f"is composed of {layer.identifier:.200}, but does not refer to it.", path=checked[0].identifier
            )


def _referenced_layers(layer: Sdf.Layer, rig_folder: Path | None, variables: Mapping[str, object]) -> list[_LayerRef]:
    """Check all files that a layer with expression variables refers to, and return the layers among them."""
    folder = rig_folder or file_of_layer(layer).resolve().parent
    read = with_variables(layer, variables)
    found: list[_LayerRef] = []
    # checked before `asset_paths` runs, because OpenUSD lists the folders of clips there
    for template in clip_templates(read):
        pattern = _checked_file(layer, template, folder)
        for file in files_of_template(pattern):
            _checked_file(layer, str(file), folder)
            found.append(_LayerRef(str(file), None if is_allowed(file) else rig_folder, None, variables))
    assets = asset_paths(read)
    composed, sublayers = read.GetCompositionAssetDependencies(), set(read.subLayerPaths)
    for asset in assets:
        is_part = asset in composed or is_layer(asset)
        if rig_folder is not None or not is_part:
            _checked_file(layer, asset, folder)
        target = target_of(layer, asset) if is_part else None
        if target is None:
            continue
        allowed = is_allowed(file_of(target))
        user = None if allowed or file_of(target).resolve().is_relative_to(folder) else layer.identifier
        ref = _LayerRef(target, None if allowed else rig_folder, user, variables)
        found += [ref, ref._replace(is_sublayer=True)] if asset in sublayers else [ref]
    return found


def _checked_file(layer: Sdf.Layer, asset: str, folder: Path) -> Path:
    """Return an asset path's file; raises RigError if it is outside the folder, links resolved, and not allowed."""
    target = target_of(layer, asset)
    if target is None or not (is_allowed(file_of(target)) or file_of(target).resolve().is_relative_to(folder)):
        found = f"refers to the file {asset:.200}, outside the folder of this file."
        raise RigError(found, path=layer.identifier, hint=_ALLOW)
    return file_of(target)


def _layer(name: str, sums: Mapping[Path, str]) -> Sdf.Layer | None:
    """Open a layer after comparing its file with the checksum that the rig records; None if the file is missing."""
    file = file_of(name)
    if not file.exists():
        return None
    if not file.is_file():
        raise RigError("is not a file.", path=file)
    if (wanted := sums.get(file.resolve())) is not None:
        check_checksum(file, wanted)
    try:
        layer = Sdf.Layer.FindOrOpen(name)
    except Tf.ErrorException as error:
        raise RigError(_unreadable(file, error), path=file) from error
    if layer is not None and not _is_intact(layer):
        raise RigError("is damaged: it lists prims or properties that it does not contain.", path=file)
    return layer


def _is_intact(layer: Sdf.Layer) -> bool:
    """Return whether a layer contains all it lists; OpenUSD aborts the process if a prim or property is missing."""
    missing, count = [], 0

    def visit(path: Sdf.Path) -> None:
        named = path.IsPropertyPath() or path.IsPrimPath() or path.IsPrimVariantSelectionPath()
        spec = layer.GetObjectAtPath(path) if named else None
        if path.isEmpty or (named and not spec):
            missing.append(path)
        nonlocal count
        count += 1
        samples = layer.GetNumTimeSamplesForPath(path) if path.IsPropertyPath() else 0
        if count > MAX_SPECS or samples > MAX_SAMPLES:
            found = f"{MAX_SPECS} prims and properties" if count > MAX_SPECS else f"{MAX_SAMPLES} samples of {path}"
            raise RigError(f"has more than {found:.200}, which is the maximum.", path=layer.identifier)

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    return not missing


def _is_rig_layer(layer: Sdf.Layer) -> bool:
    for path in paths_in(layer):
        if path.IsPropertyPath() and path.name.startswith(_RIG_ATTRIBUTES):
            return True
        spec = prim_spec_at(layer, path)
        schemas = spec.GetInfo("apiSchemas") if spec else None
        if schemas is not None and SCHEMA_NAME in schemas.GetAddedOrExplicitItems():
            return True
    return False
