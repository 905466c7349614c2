"""Files that a layer refers to, and the checksums that `actor.usda` records for the binary layers of a rig.

Only the file of an asset path counts, without format arguments and paths inside packages. Checksums are compared before
OpenUSD parses a file, which may crash on a damaged one.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from pxr import Ar, Sdf, UsdUtils

from jawusd.base.errors import RigError


def file_of(identifier: str) -> Path:
    """Return the file of an asset path, without format arguments; for a layer inside a package, return the package."""
    path = Sdf.Layer.SplitIdentifier(identifier)[0]
    return Path(Ar.SplitPackageRelativePathOuter(path)[0] if Ar.IsPackageRelativePath(path) else path)


def file_of_layer(layer: Sdf.Layer) -> Path:
    """Return the file that a layer was read from; its identifier may be a search path instead of a full path."""
    return file_of(layer.realPath or layer.identifier)


def is_layer(asset: str) -> bool:
    """Return whether OpenUSD reads an asset as a layer."""
    return Sdf.FileFormat.FindByExtension(Sdf.Layer.SplitIdentifier(asset)[0]) is not None


def target_of(layer: Sdf.Layer, asset: str) -> str | None:
    """Return the full path of an asset of a layer, as resolved by OpenUSD, or the expected path of a missing file.

    Return None for paths of another operating system and URLs whose scheme no resolver supports. The resolver context
    of the stage must be bound.
    """
    path, arguments = Sdf.Layer.SplitIdentifier(layer.ComputeAbsolutePath(asset))
    found = str(Ar.GetResolver().Resolve(path))
    if not found and not os.path.isabs(path):
        path = path.replace("\\", "/")
        if ":" in path.split("/")[0]:
            return None
        found = os.path.normpath(file_of_layer(layer).parent / path)
    return Sdf.Layer.CreateIdentifier(found or path, arguments)


def with_variables(layer: Sdf.Layer, variables: Mapping[str, object]) -> Sdf.Layer:
    """Return a copy of a layer with the given expression variables, or the layer itself without any."""
    if not variables:
        return layer
    copy = Sdf.Layer.CreateAnonymous(".usda")
    copy.TransferContent(layer)
    copy.expressionVariables = dict(variables)
    return copy


def asset_paths(layer: Sdf.Layer) -> list[str]:
    """Return every asset path in a layer: layers, values, clips and other metadata, with expressions evaluated."""
    found: list[str] = []

    def note(asset: str) -> str:
        found.append(asset)
        return asset

    edited = layer.dirty
    silent = UsdUtils.CoalescingDiagnosticDelegate()  # hides the warning that an anonymous copy has no folder
    UsdUtils.ModifyAssetPaths(layer, note)
    del silent
    if layer.dirty and not edited and not layer.anonymous:
        layer.Reload(force=True)  # restores the expressions, which were replaced by their values
    return [asset for asset in dict.fromkeys(found) if asset]


def clip_templates(layer: Sdf.Layer) -> list[str]:
    """Return the value clip templates of a layer: asset paths with # in place of digits."""
    specs = [spec for path in paths_in(layer) if (spec := prim_spec_at(layer, path)) and spec.HasInfo("clips")]
    sets = [values for spec in specs for values in spec.GetInfo("clips").values() if isinstance(values, dict)]
    return [_evaluated_text(layer, str(each["templateAssetPath"])) for each in sets if "templateAssetPath" in each]


def paths_in(layer: Sdf.Layer) -> list[Sdf.Path]:
    """Return the paths of everything in a layer, those inside variants included."""
    found: list[Sdf.Path] = []
    layer.Traverse(Sdf.Path.absoluteRootPath, found.append)
    return found


def prim_spec_at(layer: Sdf.Layer, path: Sdf.Path) -> Sdf.PrimSpec | None:
    """Return the spec of a prim or of a variant; None for other paths."""
    return layer.GetPrimAtPath(path) if path.IsPrimPath() or path.IsPrimVariantSelectionPath() else None


def _evaluated_text(layer: Sdf.Layer, text: str) -> str:
    """Return a string, evaluated with the layer's variables if it is an expression."""
    if not Sdf.VariableExpression.IsExpression(text):
        return text
    return str(Sdf.VariableExpression(text).Evaluate(layer.expressionVariables).value or "")


def files_of_template(template: Path) -> list[Path]:
    """Return the existing files that match a value clip template."""
    pattern = re.compile(re.sub(r"(\\#)+", "[-0-9.]+", re.escape(template.name)))
    if not template.parent.is_dir():
        return []
    return sorted(file for file in template.parent.iterdir() if pattern.fullmatch(file.name))


#: Key in `customLayerData` of `actor.usda`: a dictionary from names of neighbouring files to SHA-256 checksums.
CHECKSUMS = "sha256"


def record_checksums(layer: Sdf.Layer, folder: Path, names: Iterable[str]) -> None:
    """Write the checksums of files in a folder to an anonymous layer that will be saved in this folder."""
    sums = {name: sha256_of(folder / name) for name in names}
    layer.customLayerData = {**layer.customLayerData, CHECKSUMS: sums}


def recorded_checksums(layer: Sdf.Layer) -> dict[Path, str]:
    """Return the checksums that a layer records, by file. Old rigs record none."""
    sums = layer.customLayerData.get(CHECKSUMS)
    folder = file_of_layer(layer).resolve().parent
    return {folder / name: str(value) for name, value in sums.items()} if isinstance(sums, dict) else {}


def check_checksum(file: Path, wanted: str) -> None:
    """Raise RigError if the checksum of a file is not the wanted one."""
    if sha256_of(file) != wanted:
        raise RigError(
            "is damaged, or was changed after the rig was written: its checksum differs from the one in the rig.",
            path=file,
            hint="Restore it from an intact copy, or build the rig again. If it was changed on purpose, remove "
            f"{CHECKSUMS} from customLayerData in the rig's text layer.",
        )


def sha256_of(file: Path) -> str:
    """Return the SHA-256 of a file."""
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()
