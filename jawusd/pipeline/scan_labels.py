"""Decide which vertices of the teeth scans are crown: by a file of labels, else by paint, else by the shape."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.finding import Finding
from jawusd.formats.mesh import GUM, Mesh, painted_labels
from jawusd.formats.scan_labels import ScanLabels, labels_path, load_scan_labels

if TYPE_CHECKING:
    from jawusd.meshes.scan_labels import Labelling

TEETH = {"upper": "upper_teeth", "lower": "lower_teeth"}

# Share of the border between crown and gum without a crease, above which a person should look. Of 58 scans of synthetic
# persons with gum on the crowns' surface, none of the 51 whose border is found within 0.3 mm (mean) lies above; plaster
# casts of patients have 0.07 to 0.11, one without teeth 0.77.
_WEAK_SHARE = 0.15

Origin = Literal["file", "paint", "shape"]


@dataclass(frozen=True, eq=False)
class LabelledScan:
    """Hold one teeth scan and how its labels came about."""

    arch: str  # "upper" or "lower"
    path: Path  # of the scan
    mesh: Mesh  # with labels, unless they are its paint
    origin: Origin
    labels: ScanLabels | None  # None for paint
    shape: Labelling | None  # what the shape says, where that was asked
    findings: tuple[Finding, ...]


def label_teeth(
    meshes: Mapping[str, Mesh], files: Mapping[str, Path], folder: Path | None, *, ignore_files: bool = False
) -> dict[str, LabelledScan]:
    """Return the teeth scans among meshes with their labels, by arch.

    Args:
        meshes: by the names of `meshes.MESHES`.
        files: where they were read.
        folder: of the labels; None: beside the scans.
        ignore_files: as if there were no files of labels.

    Raises:
        FormatError: labels are damaged, or of another version of the scan.
    """
    middles = {arch: meshes[name].vertices.mean(axis=0) for arch, name in TEETH.items() if name in meshes}
    other = {"upper": middles.get("lower"), "lower": middles.get("upper")}
    return {
        arch: _labelled(
            arch, meshes[name], files[name], None if ignore_files else labels_path(files[name], folder), other[arch]
        )
        for arch, name in TEETH.items()
        if name in meshes
    }


def _labelled(arch: str, mesh: Mesh, path: Path, file: Path | None, other: Array | None) -> LabelledScan:
    painted = painted_labels(mesh)
    if file is not None and file.is_file():
        stored = load_scan_labels(file, mesh)
        of = "accepted by a person" if stored.source == "reviewed" else "found from the shape"
        over = ", not by its paint" if painted is not None else ""
        note = Finding(
            "scan_labels_from_file",
            "note",
            f"crown and gum of the {arch} scan are told apart by {file.name} ({of}){over}.",
            path=str(path),
        )
        labelled = replace(mesh, labels=stored.labels)
        return LabelledScan(arch, path, labelled, "file", stored, None, (note, *_doubt(arch, stored, path)))
    if painted is not None:
        return LabelledScan(arch, path, mesh, "paint", None, None, ())
    return _by_shape(arch, mesh, path, other)


def _by_shape(arch: str, mesh: Mesh, path: Path, other: Array | None) -> LabelledScan:
    from jawusd.meshes.scan_labels import label_scan

    shape = label_scan(mesh, other)
    found = ScanLabels(shape.labels, "automatic", shape.weak_share)
    if (found.labels == GUM).any():
        message = (
            f"the {arch} scan is not painted; by its shape {100 * np.mean(found.labels != GUM):.0f} % of it is crown."
        )
        note = Finding("scan_labels_from_shape", "note", message, path=str(path), hint="See it with jawusd scans.")
    else:
        message = f"the {arch} scan has no paint and no gum: it counts as crown all over."
        hint = "If it has gum, mark it with the brush of jawusd view."
        note = Finding("scan_crowns_only", "note", message, path=str(path), hint=hint)
    findings = (note, *_doubt(arch, found, path))
    return LabelledScan(arch, path, replace(mesh, labels=found.labels), "shape", found, shape, findings)


def _doubt(arch: str, labels: ScanLabels, path: Path) -> tuple[Finding, ...]:
    """Return a warning where much of the border has little to show for it and nobody has accepted it."""
    if labels.source == "reviewed" or labels.weak_share <= _WEAK_SHARE:
        return ()
    message = (
        f"the shape of the {arch} scan hardly shows {100 * labels.weak_share:.0f} % of the line between crown and gum, "
        f"at most {100 * _WEAK_SHARE:.0f} % are usual."
    )
    hint = "Look at the picture of jawusd scans and correct the labels in jawusd view."
    return (
        Finding("scan_border_unclear", "warning", message, labels.weak_share, _WEAK_SHARE, path=str(path), hint=hint),
    )
