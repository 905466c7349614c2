"""Read USD from untrusted sources: files outside a rig's folder stay closed, faults of a file become FormatErrors."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple, ParamSpec, TypeVar

from pxr import Ar, Sdf, Tf, Usd

from jawusd.base.errors import FormatError, RigError
from jawusd.base.guard import most_cpu, note_input, out_of_memory
from jawusd.base.inputs import is_allowed
from jawusd.rig.asset_paths import (
    asset_paths,
    clip_templates,
    evaluated,
    file_of,
    file_of_layer,
    is_layer,
    of_template,
    target_of,
)
from jawusd.rig.checksums import check_checksum, recorded_checksums
from jawusd.rig.schema import SCHEMA_NAME


class _Named(NamedTuple):
    """A layer that is named by another: where, in which rig's folder, from outside of whose folder, and variables."""

    target: str
    home: Path | None
    user: str | None
    variables: Mapping[str, object]  # of the layers that refer to it
    is_sublayer: bool = False  # its own variables do not count then


P = ParamSpec("P")
R = TypeVar("R")

#: A value in USD has whatever type its file declares; code that expects another type raises one of these.
FAULTS = (
    ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError, Tf.ErrorException,
)  # fmt: skip
#: Processor time [s] for opening a stage in a guarded process. Rigs take 0.02 s, stages of a million prims some five.
MOST_CPU_S = 20
_ALLOW = "If you trust it, allow its folder with --allow or the setting JAWUSD_ALLOW."
_UNREADABLE = "is not a USD file that OpenUSD can read"
#: Prims and properties in a layer, and samples of an attribute, that are read.
MOST_SPECS, MOST_SAMPLES = 2_000_000, 1_000_000
_MOST_READINGS = 20_000  # of layers, one for each set of variables
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
            except MemoryError as error:
                raise out_of_memory(str(args[argument])) from error
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
    note_input(path)
    try:
        with most_cpu(MOST_CPU_S):
            layers = check_reach(path)
            stage = Usd.Stage.Open(str(path))
    except (Tf.ErrorException, RuntimeError, ValueError, OSError) as error:
        raise RigError(_unreadable(path, error), path=path) from error
    if not layers or stage is None:
        raise RigError(_unreadable(path), path=path)
    check_composed(stage, layers)
    return stage


def _unreadable(file: Path, error: BaseException | None = None) -> str:
    """Return what is wrong with a file, with what OpenUSD says of it, such as the line of a syntax error."""
    said = error.args if isinstance(error, Tf.ErrorException) else ()
    words = next((str(one.commentary).strip() for one in said if getattr(one, "commentary", "")), "")
    words = words.replace(f"{file.absolute()}:", "line ", 1)
    return f"{_UNREADABLE}: {words:.300}" if words else f"{_UNREADABLE}."


def check_reach(path: Path) -> list[Sdf.Layer]:
    """Check, before a layer or package is composed, that a rig's layers name only files in their own folder or below.

    Paths count as OpenUSD finds them: absolute ones, by search paths, and by expressions with variables.
    Layers that only use a rig (animation, shots) may name it outside their folder, and nothing else, in values neither:
    what values name is read (ONNX) and packed (pictures). Files that a rig's layers name must lie in the rig's folder,
    with links resolved. Any may lie in folders that were allowed, see `base.inputs`.

    Returns:
        The layers, which stay loaded as long as they are referenced.

    Raises:
        RigError: A path that is not allowed, or a layer that is damaged.
    """
    resolver = Ar.GetResolver()
    with Ar.ResolverContextBinder(resolver.CreateDefaultContextForAsset(str(path))):
        return _reached(path)


def _reached(path: Path) -> list[Sdf.Layer]:
    layers: list[Sdf.Layer] = []
    seen: set[tuple[str, Path | None, bool, str]] = set()
    sums: dict[Path, str] = {}
    waiting = [_Named(str(path), None, None, {})]
    while waiting:
        one = waiting.pop()
        name, home = one.target, one.home
        key = (name, home, one.is_sublayer, str(sorted(one.variables.items())))
        if key in seen:
            continue
        if len(seen) == _MOST_READINGS:
            raise RigError(f"names layers in more than {_MOST_READINGS} ways, by variables.", path=path)
        seen.add(key)
        layer = _layer(name, sums)
        if layer is None:
            continue
        layers.append(layer)
        sums |= recorded_checksums(layer)
        if home is None and _carries_rig(layer):
            home = file_of(name).resolve().parent
        if home is None and one.user is not None:
            raise RigError(
                f"names the file {name:.200}, outside its own folder and no rig.", path=one.user, hint=_ALLOW
            )
        own = {} if one.is_sublayer else layer.expressionVariables
        waiting += _layers_named(layer, home, {**own, **one.variables})
    return layers


def check_composed(stage: Usd.Stage, checked: list[Sdf.Layer]) -> None:
    """Check that a stage holds no layers but those of `check_reach`.

    Raises:
        RigError: It holds another.
    """
    known = {file_of_layer(layer).resolve() for layer in checked}
    for layer in stage.GetUsedLayers():
        if not layer.anonymous and file_of_layer(layer).resolve() not in known:
            raise RigError(
                f"is composed of {layer.identifier:.200}, which it does not name.", path=checked[0].identifier
            )


def _layers_named(layer: Sdf.Layer, home: Path | None, variables: Mapping[str, object]) -> list[_Named]:
    """Return the layers that a layer names, after checking all files that it names.

    Args:
        home: Folder of the rig that the layer is part of; None where it only uses rigs.
        variables: Those that expressions have in the layer.
    """
    folder = home or file_of_layer(layer).resolve().parent
    read = evaluated(layer, variables)
    named: list[_Named] = []
    for template in clip_templates(read):  # first: OpenUSD lists their folders when it is asked for asset paths
        pattern = _inside(layer, template, folder)
        for file in of_template(pattern):
            _inside(layer, str(file), folder)
            named.append(_Named(str(file), None if is_allowed(file) else home, None, variables))
    assets = asset_paths(read)
    composed, sublayers = read.GetCompositionAssetDependencies(), set(read.subLayerPaths)
    for asset in assets:
        is_part = asset in composed or is_layer(asset)
        if home is not None or not is_part:
            _inside(layer, asset, folder)
        target = target_of(layer, asset) if is_part else None
        if target is None:
            continue
        allowed = is_allowed(file_of(target))
        user = None if allowed or file_of(target).resolve().is_relative_to(folder) else layer.identifier
        one = _Named(target, None if allowed else home, user, variables)
        named += [one, one._replace(is_sublayer=True)] if asset in sublayers else [one]
    return named


def _inside(layer: Sdf.Layer, asset: str, folder: Path) -> Path:
    """Return the file that a layer names.

    Raises:
        RigError: It lies outside a folder, links resolved, and was not allowed.
    """
    target = target_of(layer, asset)
    if target is None or not (is_allowed(file_of(target)) or file_of(target).resolve().is_relative_to(folder)):
        raise RigError(f"names the file {asset:.200}, outside its own folder.", path=layer.identifier, hint=_ALLOW)
    return file_of(target)


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
    if (wanted := sums.get(file.resolve())) is not None:
        check_checksum(file, wanted)
    try:
        layer = Sdf.Layer.FindOrOpen(name)
    except Tf.ErrorException as error:
        raise RigError(_unreadable(file, error), path=file) from error
    if layer is not None and not _is_whole(layer):
        raise RigError("is damaged: it names prims or properties that it does not hold.", path=file)
    return layer


def _is_whole(layer: Sdf.Layer) -> bool:
    """Return whether a layer holds all prims and properties it names; OpenUSD ends the process where it does not.

    Raises:
        RigError: It holds more than is read.
    """
    missing, count = [], 0

    def visit(path: Sdf.Path) -> None:
        named = path.IsPropertyPath() or path.IsPrimPath() or path.IsPrimVariantSelectionPath()
        spec = layer.GetObjectAtPath(path) if named else None
        if path.isEmpty or (named and not spec):
            missing.append(path)
        nonlocal count
        count += 1
        samples = layer.GetNumTimeSamplesForPath(path) if path.IsPropertyPath() else 0
        if count > MOST_SPECS or samples > MOST_SAMPLES:
            found = f"{MOST_SPECS} prims and properties" if count > MOST_SPECS else f"{MOST_SAMPLES} samples of {path}"
            raise RigError(f"holds more than {found:.200}, the most that is read.", path=layer.identifier)

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
