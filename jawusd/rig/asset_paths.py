"""What the asset paths of a layer name: files, without format arguments and places inside packages."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path

from pxr import Ar, Sdf, UsdUtils


def file_of(identifier: str) -> Path:
    """Return the file that an asset path names: without format arguments, of a layer inside a package the package."""
    path = Sdf.Layer.SplitIdentifier(identifier)[0]
    return Path(Ar.SplitPackageRelativePathOuter(path)[0] if Ar.IsPackageRelativePath(path) else path)


def file_of_layer(layer: Sdf.Layer) -> Path:
    """Return the file that a layer was read from; by a search path, it is identified by less."""
    return file_of(layer.realPath or layer.identifier)


def is_layer(asset: str) -> bool:
    """Return whether OpenUSD reads what an asset path names as a layer."""
    return Sdf.FileFormat.FindByExtension(Sdf.Layer.SplitIdentifier(asset)[0]) is not None


def target_of(layer: Sdf.Layer, asset: str) -> str | None:
    """Return what an asset path of a layer names: what OpenUSD finds, by search paths too, else where it would lie.

    None for what is no path of this machine, as a drive letter or the scheme of a URL that no resolver knows. The
    resolver context of the stage has to be bound.
    """
    path, arguments = Sdf.Layer.SplitIdentifier(layer.ComputeAbsolutePath(asset))
    found = str(Ar.GetResolver().Resolve(path))
    if not found and not os.path.isabs(path):
        path = path.replace("\\", "/")
        if ":" in path.split("/")[0]:
            return None
        found = os.path.normpath(file_of_layer(layer).parent / path)
    return Sdf.Layer.CreateIdentifier(found or path, arguments)


def evaluated(layer: Sdf.Layer, variables: Mapping[str, object]) -> Sdf.Layer:
    """Return a layer whose expressions have the values that these variables give; without variables the layer itself.

    Where a layer is found by reference, its own variables count below those of the layers that refer to it.
    """
    if not variables:
        return layer
    copy = Sdf.Layer.CreateAnonymous(".usda")
    copy.TransferContent(layer)
    copy.expressionVariables = dict(variables)
    asset_paths(copy)
    return copy


def asset_paths(layer: Sdf.Layer) -> list[str]:
    """Return every asset path in a layer: of layers, values, clips and other metadata; expressions as paths."""
    found: list[str] = []

    def note(asset: str) -> str:
        found.append(asset)
        return asset

    edited = layer.dirty
    silent = UsdUtils.CoalescingDiagnosticDelegate()  # a copy in memory has no folder that templates could lie in
    UsdUtils.ModifyAssetPaths(layer, note)
    del silent
    if layer.dirty and not edited and not layer.anonymous:
        layer.Reload(force=True)  # it had expressions, which are now replaced by what they gave
    return [asset for asset in dict.fromkeys(found) if asset]


def clip_templates(layer: Sdf.Layer) -> list[str]:
    """Return the templates of value clips in a layer, asset paths with # in place of digits."""
    found: list[str] = []

    def visit(path: Sdf.Path) -> None:
        spec = layer.GetPrimAtPath(path) if path.IsPrimPath() or path.IsPrimVariantSelectionPath() else None
        clips = spec.GetInfo("clips") if spec and spec.HasInfo("clips") else {}
        sets = [values for values in clips.values() if isinstance(values, dict)]
        found.extend(
            _value(layer, str(values["templateAssetPath"])) for values in sets if "templateAssetPath" in values
        )

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    return found


def _value(layer: Sdf.Layer, text: str) -> str:
    """Return the value of a text that may be an expression, by the layer's variables."""
    if not Sdf.VariableExpression.IsExpression(text):
        return text
    return str(Sdf.VariableExpression(text).Evaluate(layer.expressionVariables).value or "")


def of_template(template: Path) -> list[Path]:
    """Return the files there are for the path of a template of value clips."""
    pattern = re.compile(re.sub(r"(\\#)+", "[-0-9.]+", re.escape(template.name)))
    if not template.parent.is_dir():
        return []
    return sorted(file for file in template.parent.iterdir() if pattern.fullmatch(file.name))
