"""Labels of crown, gum and base of a teeth scan, in an npz file beside the scan, format jawusd-scan-labels/1.

    labels (V,) uint8    0 gum, 1 crown, 2 crown at a border of interest, 3 base plate; in the order of the scan file
    meta                 JSON: scan_sha256 of the scan's vertices, source, weak_share

The hash identifies the version of the scan for which labels were made; they are rejected for any other version.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from jawusd.base.errors import FormatError
from jawusd.base.npz import TWIST_ORDER, UNITS, read_npz, take
from jawusd.formats.atomic import write_npz_atomic
from jawusd.formats.mesh import BASE, Mesh

FAMILY, VERSION = "jawusd-scan-labels", 1
SUFFIX = ".labels.npz"

LabelSource = Literal["automatic", "reviewed"]


@dataclass(frozen=True, eq=False)
class ScanLabels:
    """Crown, gum and base labels of one scan."""

    labels: NDArray[np.uint8]  # label of each vertex of the scan file, as in `formats.mesh`, shape (V,)
    source: LabelSource  # "automatic" if derived from the shape, "reviewed" if accepted by a user
    weak_share: float = 0.0  # fraction of the crown-gum border with weak geometric evidence, 0 to 1


def labels_path(scan: Path, folder: Path | None = None) -> Path:
    """Return the path of the labels of a scan: beside the scan, or in a folder of labels."""
    return (scan.parent if folder is None else folder) / f"{scan.stem}{SUFFIX}"


def scan_hash(mesh: Mesh) -> str:
    """Return the SHA-256 of the vertices of a scan, which identifies it in its labels."""
    return hashlib.sha256(mesh.vertices.tobytes()).hexdigest()


def save_scan_labels(path: str | os.PathLike[str], labels: ScanLabels, mesh: Mesh) -> None:
    """Write the labels of a scan.

    Raises:
        ValueError: the number of labels differs from the number of vertices.
        OutputError: the file cannot be written.
    """
    if labels.labels.shape != mesh.vertices.shape[:1]:
        raise ValueError(f"labels must have shape ({len(mesh.vertices)},), got {labels.labels.shape}")
    meta = {
        "format": f"{FAMILY}/{VERSION}",
        "units": UNITS,
        "twist_order": TWIST_ORDER,
        "scan_sha256": scan_hash(mesh),
        "source": labels.source,
        "weak_share": labels.weak_share,
    }
    text = json.dumps(meta, sort_keys=True)
    write_npz_atomic(path, {"labels": labels.labels.astype(np.uint8), "meta": np.array(text)})


def load_scan_labels(path: str | os.PathLike[str], mesh: Mesh) -> ScanLabels:
    """Read the labels of a scan.

    Raises:
        FormatError: the file does not contain labels, or they were made for another version of the scan.
        VersionError: the file was written by a newer version.
    """
    arrays, meta = read_npz(path, FAMILY, VERSION)
    labels = take(arrays, "labels", (None,), path)
    if meta.get("scan_sha256") != scan_hash(mesh) or len(labels) != len(mesh.vertices):
        raise FormatError(
            f"was made for another version of the scan ({len(labels)} vertices; the scan has {len(mesh.vertices)}).",
            path=path,
            hint="Create new labels with `jawusd scans --force`, or delete the file.",
        )
    if not np.isin(labels, range(BASE + 1)).all():
        raise FormatError(f'"labels" must be 0 to {BASE}, found {labels.max():g}.', path=path)
    source, weak = meta.get("source"), meta.get("weak_share", 0.0)
    if source != "automatic" and source != "reviewed":
        raise FormatError(f'source is "{source}"; it must be "automatic" or "reviewed".', path=path)
    if isinstance(weak, bool) or not isinstance(weak, int | float) or not 0 <= weak <= 1:
        raise FormatError(f'weak_share is "{weak}"; it must be a number from 0 to 1.', path=path)
    return ScanLabels(labels.astype(np.uint8), source, float(weak))
