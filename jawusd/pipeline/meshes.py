"""Load scans and bones, with crown and gum told apart, where the capture or the take shows them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import explain_missing_packages
from jawusd.formats.capture import Capture
from jawusd.formats.finding import Finding
from jawusd.formats.mesh import Mesh
from jawusd.geometry import transform_points
from jawusd.pipeline.scan_labels import TEETH, LabelledScan, label_teeth

BONES = ("mandible", "skull")
MESHES = ("upper_teeth", "lower_teeth", *BONES)


def load_meshes(capture: Capture) -> dict[str, Mesh]:
    """Read the scans and bones of a capture, by the names of `MESHES` [mm, scan frame]; bones may be absent.

    The teeth scans carry labels unless they are painted.

    Raises:
        CaptureError: a mesh is damaged, or of a size that cannot be in mm.
        FormatError: a file of labels is damaged, or of another version of its scan.
    """
    return load_labelled(capture)[0]


def load_labelled(capture: Capture) -> tuple[dict[str, Mesh], list[Finding]]:
    """Return `load_meshes`, and what there is to say about the labels of the teeth scans."""
    paths = {name: getattr(capture.scans, name) for name in MESHES}
    files = {name: path for name, path in paths.items() if path is not None}
    meshes = read_files(files)
    teeth = label_teeth(meshes, files, capture.scans.labels)
    labelled = {TEETH[arch]: scan.mesh for arch, scan in teeth.items()}
    return meshes | labelled, [finding for scan in teeth.values() for finding in scan.findings]


def read_meshes(files: Mapping[str, Path]) -> dict[str, Mesh]:
    """Read mesh files by the names of `MESHES`; raises as `load_meshes`."""
    meshes = read_files(files)
    return meshes | {TEETH[arch]: scan.mesh for arch, scan in label_teeth(meshes, files, None).items()}


@explain_missing_packages()
def read_files(files: Mapping[str, Path]) -> dict[str, Mesh]:
    """Read mesh files by the names of `MESHES` as they are, without labels; raises CaptureError as `load_meshes`."""
    from jawusd.meshes.meshio import load_mesh

    return {name: load_mesh(path, kind="bone" if name in BONES else "scan") for name, path in files.items()}


def labelled_teeth(capture: Capture, folder: Path | None, *, ignore_files: bool = False) -> list[LabelledScan]:
    """Return the upper and the lower scan with their labels, taken from a folder (None: beside the scans).

    Args:
        ignore_files: as if there were no files of labels.

    Raises:
        CaptureError, FormatError: as `load_meshes`.
    """
    files = {name: getattr(capture.scans, name) for name in TEETH.values()}
    return list(label_teeth(read_files(files), files, folder, ignore_files=ignore_files).values())


def registered_meshes(meshes: Mapping[str, Mesh], meta: Mapping[str, object]) -> dict[str, Mesh]:
    """Return meshes with the lower scan where the take shows it, if the meta data of tracks or model say so."""
    T = registration_of(meta)
    out = dict(meshes)
    if T is not None and "lower_teeth" in meshes:
        out["lower_teeth"] = replace(
            meshes["lower_teeth"], vertices=transform_points(T, meshes["lower_teeth"].vertices)
        )
    return out


def registration_of(meta: Mapping[str, object]) -> Array | None:
    """Return what moves the lower scan, by the meta data of tracks or model, shape (4, 4); None if it stays."""
    found = meta.get("registration")
    if not isinstance(found, dict) or not found.get("applied"):
        return None
    return np.array(found["T"], np.float64)
