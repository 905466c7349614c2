"""The subject of a capture, of loose scans or of a build: labelled scans, bones, axes and landmarks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, CaptureError, explain_missing_packages
from jawusd.formats.capture import Capture
from jawusd.formats.finding import Finding
from jawusd.formats.landmarks import load_landmarks
from jawusd.formats.mesh import GUM, Mesh, ScanLabels, labels_path, load_scan_labels, painted_labels, tooth_labels
from jawusd.formats.model import load_model
from jawusd.geometry import LANDMARKS, anatomical_frame, find_landmarks, landmark_frame, transform_points
from jawusd.geometry.anatomy import MEAN_CONDYLES

TEETH = {"upper": "upper_teeth", "lower": "lower_teeth"}

# Fraction of the crown border that follows no crease, above which the labels need review. Of 58 synthetic scans, the 51
# with a mean border error below 0.3 mm are below it; plaster casts reach 0.07 to 0.11, a cast without teeth 0.77.
_WEAK_SHARE = 0.15
# Facial landmarks that place the condyles of a subject without a mandible mesh.
_TRAGIONS = ("tragion_left", "tragion_right")

Origin = Literal["file", "paint", "shape"]


@dataclass(frozen=True, eq=False)
class LabelledScan:
    """A teeth scan with the origin of its labels."""

    arch: str  # "upper" or "lower"
    path: Path  # File of the scan.
    mesh: Mesh  # With labels, unless painted.
    origin: Origin
    labels: ScanLabels | None  # None if the scan is painted
    findings: tuple[Finding, ...]


def label_teeth(
    meshes: Mapping[str, Mesh], files: Mapping[str, Path], folder: Path | None, *, ignore_files: bool = False
) -> dict[str, LabelledScan]:
    """Return the teeth scans among the meshes, with their labels, by arch.

    Args:
        meshes, files: meshes and their files by the names in `MESHES`.
        folder: folder of the label files; None: the folder of each scan.
        ignore_files: ignore existing label files.

    Raises:
        FormatError: labels are corrupt, or belong to another version of the scan.
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
        of = "reviewed" if stored.source == "reviewed" else "found by shape"
        over = "; its paint is ignored" if painted is not None else ""
        message = f"crown and gum of the {arch} scan are labelled by {file.name} ({of}){over}."
        note = Finding("scan_labels_from_file", "note", message, path=str(path))
        labelled = replace(mesh, labels=stored.labels)
        return LabelledScan(arch, path, labelled, "file", stored, (note, *_weak_border(arch, stored, path)))
    if painted is not None:
        return LabelledScan(arch, path, mesh, "paint", None, ())
    return _by_shape(arch, mesh, path, other)


def _by_shape(arch: str, mesh: Mesh, path: Path, other: Array | None) -> LabelledScan:
    from jawusd.meshes.scan_labels import label_scan

    shape = label_scan(mesh, other)
    found = ScanLabels(shape.labels, "automatic", shape.weak_share)
    if (found.labels == GUM).any():
        kind, crown = "scan_labels_from_shape", 100 * np.mean(found.labels != GUM)
        message = f"the {arch} scan is not painted; by its shape, {crown:.0f} % of it is crown."
        hint = "Inspect it with `jawusd scans`."
    else:
        kind, message = "scan_crowns_only", f"the {arch} scan has no paint and no gum; all of it counts as crown."
        hint = "If it has gum, paint it with the brush in `jawusd view`."
    findings = (Finding(kind, "note", message, path=str(path), hint=hint), *_weak_border(arch, found, path))
    return LabelledScan(arch, path, replace(mesh, labels=found.labels), "shape", found, findings)


def _weak_border(arch: str, labels: ScanLabels, path: Path) -> tuple[Finding, ...]:
    """Return a warning if much of the crown border follows no crease and the labels were not reviewed."""
    if labels.source == "reviewed" or labels.weak_share <= _WEAK_SHARE:
        return ()
    message = (
        f"{100 * labels.weak_share:.0f} % of the crown border of the {arch} scan has no crease; at most "
        f"{100 * _WEAK_SHARE:.0f} % is usual."
    )
    hint = "Inspect the image that `jawusd scans` writes, and correct the labels in `jawusd view`."
    kind, share = "scan_border_unclear", labels.weak_share
    return (Finding(kind, "warning", message, share, _WEAK_SHARE, path=str(path), hint=hint),)


BONES = ("mandible", "skull")
MESHES = ("upper_teeth", "lower_teeth", *BONES)


def load_meshes(capture: Capture, meta: Mapping[str, object] | None = None) -> dict[str, Mesh]:
    """Read the scans and bones of a capture [mm, scan frame], by the names in `MESHES`; bones may be missing.

    The returned teeth scans have labels, unless they are painted. With the metadata of tracks or a model, the scans are
    registered as in these; see `registered_meshes`.

    Raises:
        CaptureError: a mesh is corrupt, or its size is implausible in mm.
        FormatError: a label file is corrupt, or belongs to another version of its scan.
    """
    return load_labelled(capture, meta)[0]


def load_labelled(capture: Capture, meta: Mapping[str, object] | None = None) -> tuple[dict[str, Mesh], list[Finding]]:
    """Return the meshes of `load_meshes`, and findings on the labels of the teeth scans."""
    paths = {name: getattr(capture.scans, name) for name in MESHES}
    files = {name: path for name, path in paths.items() if path is not None}
    meshes, findings = _read_labelled(files, capture.scans.labels)
    return registered_meshes(meshes, meta or {}), findings


def _read_labelled(files: Mapping[str, Path], labels: Path | None) -> tuple[dict[str, Mesh], list[Finding]]:
    meshes = read_files(files)
    teeth = label_teeth(meshes, files, labels)
    labelled = {TEETH[arch]: scan.mesh for arch, scan in teeth.items()}
    return meshes | labelled, [finding for scan in teeth.values() for finding in scan.findings]


@explain_missing_packages()
def read_files(files: Mapping[str, Path]) -> dict[str, Mesh]:
    """Read mesh files by the names in `MESHES` without labelling; raises CaptureError like `load_meshes`."""
    from jawusd.meshes.meshio import load_mesh

    return {name: load_mesh(path, kind="bone" if name in BONES else "scan") for name, path in files.items()}


def labelled_teeth(capture: Capture, folder: Path | None, *, ignore_files: bool = False) -> list[LabelledScan]:
    """Return the upper and the lower scan with labels; see `label_teeth`; raises like `load_meshes`."""
    files = {name: getattr(capture.scans, name) for name in TEETH.values()}
    return list(label_teeth(read_files(files), files, folder, ignore_files=ignore_files).values())


def registered_meshes(meshes: Mapping[str, Mesh], meta: Mapping[str, object]) -> dict[str, Mesh]:
    """Return the meshes, with the lower scan moved by the registration in the metadata of tracks or a model, if any."""
    T, lower = registration_of(meta), meshes.get("lower_teeth")
    if T is None or lower is None:
        return dict(meshes)
    return {**meshes, "lower_teeth": replace(lower, vertices=transform_points(T, lower.vertices))}


def registration_of(meta: Mapping[str, object]) -> Array | None:
    """Return the registration (4, 4) of the lower scan from the metadata of tracks or a model, None if missing."""
    found = meta.get("registration")
    if not isinstance(found, dict) or not found.get("applied"):
        return None
    return np.array(found["T"], np.float64)


@dataclass(frozen=True, eq=False)
class Subject:
    """A subject for fitting and reports: anatomical axes, landmarks and meshes."""

    name: str  # name of the subject or the capture
    T_anatomical_skull: Array  # transform from the scan frame to the anatomical frame, shape (4, 4)
    landmarks: Array  # `geometry.LANDMARKS` in the mandible frame [mm], shape (5, 3)
    meshes: Mapping[str, Mesh]  # meshes by the names in `MESHES`, in the scan frame [mm]; may be empty
    fps: float | None = None  # frame rate of the poses [1/s]; None if unknown
    T_rest: Array = field(default_factory=lambda: np.eye(4))  # T_skull_mandible with the teeth closed, shape (4, 4)
    inferred: tuple[str, ...] = ()  # descriptions of quantities that were derived from the meshes, not given

    def measured_points(self) -> Array | None:
        """Return the vertices (V, 3) [mm] at which errors are measured: the mandible's or else the lower teeth's."""
        found = self.meshes.get("mandible") or self.meshes.get("lower_teeth")
        return None if found is None else found.vertices


def registered_subject(subject: Subject, meta: Mapping[str, object]) -> Subject:
    """Return the subject with the take's registration of the scans applied; see `registered_meshes`."""
    T = registration_of(meta)
    if T is None:
        return subject
    lower = np.array([not name.startswith("condyle") for name in LANDMARKS])
    landmarks = np.where(lower[:, None], transform_points(T, subject.landmarks), subject.landmarks)
    return replace(subject, meshes=registered_meshes(subject.meshes, meta), landmarks=landmarks)


def subject_of_capture(capture: Capture, meshes: Mapping[str, Mesh] | None = None) -> Subject:
    """Return the subject of a capture; missing axes and landmarks are derived from the scans.

    Args:
        meshes: result of `load_meshes`; None: load them.

    Raises:
        CaptureError: a landmark has an unknown name, one tragion is missing, or the scans are corrupt, swapped or not
            in occlusion.
    """
    named = capture.anatomy.landmarks or {}
    known = (*LANDMARKS, *_TRAGIONS)
    if unknown := sorted(set(named) - set(known)):
        message = f'has the unknown landmark "{unknown[0]}"; must be one of {", ".join(known)}.'
        raise CaptureError(f"[anatomy.landmarks] {message}", path=capture.file)
    if len(set(named) & set(_TRAGIONS)) == 1:
        message = "has only one of tragion_left and tragion_right. Give both or neither."
        raise CaptureError(f"[anatomy.landmarks] {message}", path=capture.file)
    meshes = load_meshes(capture) if meshes is None else meshes
    return _measured(capture.name, meshes, capture.fps, capture.anatomy.T_anatomical_skull, named)


def subject_of_scans(files: Mapping[str, Path], name: str) -> Subject:
    """Return the subject of mesh files that share one coordinate frame, with the teeth in occlusion.

    The files are named as in `MESHES`; both teeth scans are required. Raises CaptureError if a mesh is corrupt or not
    in mm, or if the scans are swapped or not in occlusion.
    """
    return _measured(name, _read_labelled(files, None)[0], None, None, {})


def _measured(
    name: str, meshes: Mapping[str, Mesh], fps: float | None, axes: ArrayLike | None, named: Mapping[str, ArrayLike]
) -> Subject:
    """Return T_anatomical_skull and all landmarks, deriving from the scans what `axes` and `named` do not give."""
    crowns = {key: mesh.vertices[tooth_labels(mesh) > 0] for key, mesh in meshes.items() if "teeth" in key}
    inferred = []
    if axes is None:
        T_anatomical_skull = anatomical_frame(crowns["upper_teeth"], crowns["lower_teeth"])
        inferred.append("anatomical axes, from the scans")
    else:
        T_anatomical_skull = np.array(axes, dtype=np.float64)
    bone = meshes.get("mandible")
    tragions = np.array([named[name] for name in _TRAGIONS]) if _TRAGIONS[0] in named else None
    vertices = None if bone is None else bone.vertices
    landmarks = find_landmarks(crowns["lower_teeth"], vertices, T_anatomical_skull, tragions)
    for index, landmark in enumerate(LANDMARKS):
        if landmark in named:
            landmarks[index] = named[landmark]
        else:
            source = "from the scans"
            if landmark.startswith("condyle"):
                means = MEAN_CONDYLES + ("" if tragions is None else " from the tragions")
                source = f"{means}, as there is no mandible mesh" if bone is None else "from the mandible mesh"
            inferred.append(f"{landmark}, {source}")
    return Subject(name, T_anatomical_skull, landmarks, meshes, fps, inferred=tuple(inferred))


def subject_of_landmarks(path: AnyPath, name: str) -> Subject:
    """Return the subject described by a landmarks file (jawusd-landmarks/1); errors are measured at landmarks.

    Raises like `formats.landmarks.load_landmarks`.
    """
    given = load_landmarks(path)
    if given.T_anatomical_skull is not None:
        return Subject(name, given.T_anatomical_skull, given.landmarks, {})
    inferred = ("anatomical axes, from the landmarks",)
    return Subject(name, landmark_frame(given.landmarks), given.landmarks, {}, inferred=inferred)


@explain_missing_packages()
def subject_of_build(folder: Path) -> Subject:
    """Return the subject of a finished build, from its model and the meshes of its rig.

    Raises FormatError or RigError if one of them is missing.
    """
    from jawusd.rig.geo import read_geometry

    model = load_model(folder / "model.npz")
    fps = model.meta.get("fps")
    return Subject(
        str(model.meta.get("actor") or folder.resolve().name),
        np.asarray(model.arrays["T_anatomical_skull"], dtype=np.float64),
        np.asarray(model.arrays["landmarks"], dtype=np.float64),
        read_geometry(folder / "geo.usdc"),
        float(fps) if isinstance(fps, int | float) else None,
        np.asarray(model.arrays["T_rest"], dtype=np.float64),
    )
