"""Label the teeth scans of a capture, store the labels, and draw an image of them for review."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from jawusd.base.errors import AnyPath, explain_missing_packages
from jawusd.formats.atomic import refuse_existing
from jawusd.formats.capture import Capture, Scans
from jawusd.formats.mesh import Mesh, ScanLabels, labels_path, painted_labels, save_scan_labels, tooth_labels
from jawusd.geometry import anatomical_frame
from jawusd.pipeline.state import Progress, no_progress
from jawusd.pipeline.subject import TEETH, LabelledScan, labelled_teeth, read_files
from jawusd.pipeline.workspace import open_capture

PICTURE = "scan_labels.png"


class ScanSummary(TypedDict):
    """Key figures of one scan and its labels."""

    arch: str
    scan: str
    labels_by: str  # origin of the labels: "file", "paint" or "shape"
    labels_file: str | None  # None if no label file was read or written
    faces: int
    pieces: int
    merged_vertices: int  # number of vertices that coincide with another vertex
    empty_faces: int
    repeated_faces: int
    crown_percent: float  # percentage of vertices labelled as crown
    weak_border_percent: float | None  # percentage of the crown border without a crease
    findings: list[dict[str, str | float | int]]


class ScansSummary(TypedDict):
    """Summaries of both scans, and the path of the image of their labels."""

    picture: str
    scans: list[ScanSummary]


@explain_missing_packages()
def label_scans(
    capture: Capture | AnyPath,
    out: AnyPath | None = None,
    *,
    force: bool = False,
    allow_outside: bool = False,
    progress: Progress = no_progress,
) -> ScansSummary:
    """Label both teeth scans of a capture by shape unless they have paint or labels, store these, and draw an image.

    Args:
        out: folder of labels and image; None: labels are written to the labels folder of the capture or beside the
            scans, and the image to the capture's folder.
        force: label again, and overwrite existing labels.

    Raises:
        FormatError, CaptureError: the capture, a scan or its labels cannot be read.
        OutputError: files exist already, or cannot be written.
    """
    opened = open_capture(capture, allow_outside=allow_outside)
    folder = opened.scans.labels if out is None else Path(out)
    picture = (opened.folder if out is None else Path(out)) / PICTURE
    refuse_existing(picture, force)
    progress("scans", 0, 2)
    scans = labelled_teeth(opened, folder, ignore_files=force)
    progress("scans", 1, 2)
    summaries = [_stored(scan, folder) for scan in scans]
    _draw(scans, summaries, opened, picture)
    progress("scans", 2, 2)
    return {"picture": str(picture), "scans": summaries}


def all_labelled(capture: Capture) -> bool:
    """Return whether both teeth scans are labelled by paint or files; raises like `load_meshes`."""
    files = {name: getattr(capture.scans, name) for name in TEETH.values()}
    unlabelled = {name: path for name, path in files.items() if not labels_path(path, capture.scans.labels).is_file()}
    return all(painted_labels(mesh) is not None for mesh in read_files(unlabelled).values())


def store_labels(capture: Capture, folder: Path) -> list[Path]:
    """Write the labels of both teeth scans to a folder if either is labelled by shape; return the files written.

    Labels written by an earlier call are deleted. Raises like `labelled_teeth`, and OutputError.
    """
    scans = labelled_teeth(capture, capture.scans.labels)
    written = []
    for scan in scans:
        file = labels_path(scan.path, folder)
        if scan.labels is not None and any(other.origin == "shape" for other in scans):
            save_scan_labels(file, scan.labels, scan.mesh)
            written.append(file)
        else:
            file.unlink(missing_ok=True)
    return written


def with_stored_labels(capture: Capture, folder: Path) -> Capture:
    """Return the capture with the labels that `store_labels` wrote to a folder, unless it has its own label files."""
    scans = capture.scans
    teeth = (scans.upper_teeth, scans.lower_teeth)
    own = any(labels_path(path, scans.labels).is_file() for path in teeth)
    if own or not any(labels_path(path, folder).is_file() for path in teeth):
        return capture
    return capture.model_copy(update={"scans": scans.model_copy(update={"labels": folder})})


def save_reviewed(scans: Scans, meshes: Mapping[str, Mesh], arch: str, labels: NDArray[np.uint8]) -> Path:
    """Write the reviewed labels (V,) of one of the scans (by arch) to its label file; return it; raises OutputError."""
    path = labels_path(getattr(scans, TEETH[arch]), scans.labels)
    save_scan_labels(path, ScanLabels(labels, "reviewed"), meshes[arch])
    return path


def _stored(scan: LabelledScan, folder: Path | None) -> ScanSummary:
    """Store labels found by shape, and return the summary of the scan."""
    from jawusd.meshes.scan_surface import ScanSurface

    file = labels_path(scan.path, folder)
    if scan.origin == "shape" and scan.labels is not None:
        save_scan_labels(file, scan.labels, scan.mesh)
    surface = ScanSurface.of(scan.mesh)
    return {
        "arch": scan.arch,
        "scan": str(scan.path),
        "labels_by": scan.origin,
        "labels_file": None if scan.origin == "paint" else str(file),
        "faces": len(scan.mesh.faces),
        "pieces": int(surface.piece.max()) + 1,
        "merged_vertices": surface.merged,
        "empty_faces": surface.empty,
        "repeated_faces": surface.repeated,
        "crown_percent": round(100 * float(np.mean(tooth_labels(scan.mesh) > 0)), 1),
        "weak_border_percent": None if scan.labels is None else round(100 * scan.labels.weak_share, 1),
        "findings": [finding.as_json() for finding in scan.findings],
    }


def _draw(scans: Sequence[LabelledScan], summaries: Sequence[ScanSummary], capture: Capture, picture: Path) -> None:
    from jawusd.media.overlay import label_sheet, save_png

    given = capture.anatomy.T_anatomical_skull
    crowns = [scan.mesh.vertices[tooth_labels(scan.mesh) > 0] for scan in scans]
    T = anatomical_frame(*crowns) if given is None else np.array(given)
    shown = [
        (scan.arch, scan.mesh, tooth_labels(scan.mesh) if scan.mesh.labels is None else scan.mesh.labels)
        for scan in scans
    ]
    captions = [
        f"{s['arch']}: {s['faces']} faces, {s['pieces']} pieces, {s['crown_percent']:.0f} % crown, by {s['labels_by']}"
        for s in summaries
    ]
    save_png(picture, label_sheet(shown, T, captions))
