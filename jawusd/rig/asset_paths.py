"""What the asset paths of a layer name: files, without format arguments and places inside packages."""

from __future__ import annotations

import re
from pathlib import Path

from pxr import Ar, Sdf, UsdUtils


def file_of(identifier: str) -> Path:
    """Return the file that an asset path names: without format arguments, of a layer inside a package the package."""
    path = Sdf.Layer.SplitIdentifier(identifier)[0]
    return Path(Ar.SplitPackageRelativePathOuter(path)[0] if Ar.IsPackageRelativePath(path) else path)


def is_layer(asset: str) -> bool:
    """Return whether OpenUSD reads what an asset path names as a layer."""
    return Sdf.FileFormat.FindByExtension(Sdf.Layer.SplitIdentifier(asset)[0]) is not None


def escapes(asset: str) -> bool:
    """Return whether an asset path leaves the folder of the layer that names it."""
    parts = Sdf.Layer.SplitIdentifier(asset)[0].replace("\\", "/").split("/")
    depth = 0
    for part in parts:
        depth += {"..": -1, ".": 0, "": 0}.get(part, 1)
        if depth < 0:
            return True
    return parts[0] == "" or ":" in parts[0]


def asset_paths(layer: Sdf.Layer) -> list[str]:
    """Return every asset path in a layer: of layers, values, clips and other metadata; expressions as paths."""
    found: list[str] = []

    def note(asset: str) -> str:
        found.append(asset)
        return asset

    edited = layer.dirty
    UsdUtils.ModifyAssetPaths(layer, note)
    if layer.dirty and not edited:
        layer.Reload(force=True)  # it had expressions, which are now replaced by what they gave
    return [asset for asset in dict.fromkeys(found) if asset]


def has_variable_paths(layers: list[Sdf.Layer]) -> bool:
    """Return whether a layer sets variables while one has expressions for paths: which files these name, is open."""
    if not any(layer.HasExpressionVariables() for layer in layers):
        return False  # as nearly always; then expressions with variables name nothing
    return any("@`" in layer.ExportToString() for layer in layers)


def clip_templates(layer: Sdf.Layer) -> list[str]:
    """Return the templates of value clips in a layer, asset paths with # in place of digits."""
    found: list[str] = []

    def visit(path: Sdf.Path) -> None:
        spec = layer.GetPrimAtPath(path) if path.IsPrimPath() or path.IsPrimVariantSelectionPath() else None
        clips = spec.GetInfo("clips") if spec and spec.HasInfo("clips") else {}
        sets = [values for values in clips.values() if isinstance(values, dict)]
        found.extend(str(values["templateAssetPath"]) for values in sets if "templateAssetPath" in values)

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    return found


def of_template(template: Path) -> list[Path]:
    """Return the files there are for the path of a template of value clips."""
    pattern = re.compile(re.sub(r"(\\#)+", "[-0-9.]+", re.escape(template.name)))
    if not template.parent.is_dir():
        return []
    return sorted(file for file in template.parent.iterdir() if pattern.fullmatch(file.name))
