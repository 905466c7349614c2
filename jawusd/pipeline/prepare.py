"""Load what a capture names and bring it into one shape: cameras, meshes, and the person with axes and landmarks."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from jawusd.errors import CalibrationError, CaptureError, JawusdError, explain_missing_packages
from jawusd.formats.camera_files import calibration_files
from jawusd.formats.capture import CameraSource, Capture, load_capture
from jawusd.formats.finding import Finding
from jawusd.formats.landmarks import load_landmarks
from jawusd.formats.mesh import Mesh, tooth_labels
from jawusd.formats.model import load_model
from jawusd.formats.numbered import is_pattern, numbered_files
from jawusd.formats.scan_labels import labels_path
from jawusd.formats.tracks import Tracks
from jawusd.geometry import (
    LANDMARKS,
    Camera,
    anatomical_frame,
    find_landmarks,
    landmark_frame,
    transform_points,
)
from jawusd.geometry.arrays import Array
from jawusd.pipeline.camera_convert import read_calibration
from jawusd.pipeline.scan_labels import TEETH, LabelledScan, label_teeth
from jawusd.pipeline.state import hash_files, hash_value

BONES = ("mandible", "skull")
MESHES = ("upper_teeth", "lower_teeth", *BONES)

Size = tuple[int, int]


@contextlib.contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Name a file in the errors of stages that know only its content."""
    try:
        yield
    except JawusdError as error:
        if error.path is None:
            error.path = str(path)
        raise


def open_capture(capture: Capture | str | os.PathLike[str], *, allow_outside: bool = False) -> Capture:
    """Return a capture, read if it is given as capture.toml or its folder; see `formats.capture.load_capture`.

    Args:
        allow_outside: let paths in the capture leave its folder.
    """
    return capture if isinstance(capture, Capture) else load_capture(capture, allow_outside=allow_outside)


@explain_missing_packages()
def load_cameras(capture: Capture) -> list[Camera]:
    """Return the calibrated cameras in the capture's order, at the size the pictures were recorded in.

    A calibration made at another size of the same shape is scaled; `rescaled_cameras` says of which cameras.

    Raises:
        CalibrationError: there is no calibration, it does not know a camera of the capture, or the pictures have
            another shape than those it was made from.
        CaptureError: a video or mask cannot be read.
    """
    return [_at_recorded_size(camera, capture, source) for camera, source in _calibrated(capture)]


def rescaled_cameras(capture: Capture) -> dict[str, tuple[Size, Size]]:
    """Return the sizes (width, height) [px] calibrated and recorded, by the name of each camera where they differ.

    Raises:
        CalibrationError, CaptureError: as `load_cameras`.
    """
    sizes = {
        camera.name: (_size(camera), _size(recorded))
        for (camera, _), recorded in zip(_calibrated(capture), load_cameras(capture), strict=True)
    }
    return {name: (was, now) for name, (was, now) in sizes.items() if was != now}


def _size(camera: Camera) -> Size:
    width, height = camera.size_px
    return int(width), int(height)


def tracked_cameras(cameras: Sequence[Camera], tracks: Tracks) -> list[Camera]:
    """Return the cameras that the poses of tracks belong to: the calibrated ones with the take's own corrections."""
    from jawusd.tracking.sequence.extrinsics import corrected_cameras

    return corrected_cameras(cameras, tracks.meta)


def _calibrated(capture: Capture) -> list[tuple[Camera, CameraSource]]:
    """Return the cameras as calibrated, each with its source."""
    if capture.calibration is None:
        raise CalibrationError(
            'has no "calibration".',
            path=capture.folder / "capture.toml",
            hint="Name a calibration file there; jawusd calibrate makes one from [boards].",
        )
    found = read_calibration(capture.calibration, capture.calibration_unit_mm, lambda: _recorded_sizes(capture))
    known = {camera.name: camera for camera in found}
    missing = [source.name for source in capture.cameras if source.name not in known]
    if missing:
        raise CalibrationError(
            f"does not know camera {missing[0]} of the capture; it names {', '.join(known)}.", path=capture.calibration
        )
    return [(known[source.name], source) for source in capture.cameras]


def _recorded_sizes(capture: Capture) -> dict[str, Size]:
    from jawusd.imaging.footage import open_clip

    return {camera.name: open_clip(camera.clip).size_px for camera in capture.cameras if camera.clip is not None}


def _at_recorded_size(camera: Camera, capture: Capture, source: CameraSource) -> Camera:
    from jawusd.imaging.footage import open_clip
    from jawusd.imaging.masks import mask_size_px

    aspect = 1.0
    if source.clip is not None:
        opened = open_clip(source.clip)
        recorded, aspect, path = opened.size_px, opened.pixel_aspect, opened.path
    elif source.masks is not None:
        path = source.masks.upper
        recorded = mask_size_px(path)
    else:
        return camera
    width, height = _size(camera)
    if tuple(recorded) == (width, height):
        return camera
    # One pixel is what rounding of a scaled height makes.
    # An anamorphic picture is stored narrower (or, as DV, wider) than it is shown, and may be calibrated either way.
    if min(abs(recorded[0] * share * height / width - recorded[1]) for share in (1.0, aspect)) > 1.0:
        raise CalibrationError(
            f"calibrated for pictures of {width} x {height} px, but {path.name} has "
            f"{recorded[0]} x {recorded[1]} px, another shape.",
            camera=camera.name,
            path=capture.calibration,
            hint="Calibrate in the recording's own mode: a crop cannot be told from the sizes alone.",
        )
    return camera.scaled(recorded)


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


def registered_meshes(meshes: Mapping[str, Mesh], meta: Mapping[str, object]) -> dict[str, Mesh]:
    """Return meshes with the lower scan where the take shows it, if the meta data of tracks or model say so."""
    T = registration_of(meta)
    out = dict(meshes)
    if T is not None and "lower_teeth" in meshes:
        out["lower_teeth"] = replace(
            meshes["lower_teeth"], vertices=transform_points(T, meshes["lower_teeth"].vertices)
        )
    return out


def registered_subject(subject: Subject, meta: Mapping[str, object]) -> Subject:
    """Return a person with lower scan and lower teeth landmarks where the take shows them; see `registered_meshes`."""
    T = registration_of(meta)
    if T is None:
        return subject
    lower = np.array([not name.startswith("condyle") for name in LANDMARKS])
    landmarks = np.where(lower[:, None], transform_points(T, subject.landmarks), subject.landmarks)
    return replace(subject, meshes=registered_meshes(subject.meshes, meta), landmarks=landmarks)


def registration_of(meta: Mapping[str, object]) -> Array | None:
    """Return what moves the lower scan, by the meta data of tracks or model, shape (4, 4); None if it stays."""
    found = meta.get("registration")
    if not isinstance(found, dict) or not found.get("applied"):
        return None
    return np.array(found["T"], np.float64)


def read_meshes(files: Mapping[str, Path]) -> dict[str, Mesh]:
    """Read mesh files by the names of `MESHES`; raises as `load_meshes`."""
    meshes = read_files(files)
    return meshes | {TEETH[arch]: scan.mesh for arch, scan in label_teeth(meshes, files, None).items()}


@explain_missing_packages()
def read_files(files: Mapping[str, Path]) -> dict[str, Mesh]:
    """Read mesh files by the names of `MESHES` as they are, without labels; raises CaptureError as `load_meshes`."""
    from jawusd.imaging.meshio import load_mesh

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


@dataclass(frozen=True, eq=False)
class Subject:
    """Hold what fitting and reports need to know of a person."""

    name: str  # of the person or the capture
    T_anatomical_skull: Array  # scan frame to anatomical frame, shape (4, 4)
    landmarks: Array  # `geometry.LANDMARKS` in the mandible frame [mm], shape (5, 3)
    meshes: Mapping[str, Mesh]  # by the names of `MESHES`, scan frame [mm]; may be empty
    fps: float | None = None  # frames per second of the poses, None if not known
    T_rest: Array = field(default_factory=lambda: np.eye(4))  # T_skull_mandible of the closed bite, shape (4, 4)
    inferred: tuple[str, ...] = ()  # what was derived instead of being given

    def measured_points(self) -> Array | None:
        """Return the points whose motion is measured [mm], shape (V, 3): mandible, else lower teeth, else None."""
        for name in ("mandible", "lower_teeth"):
            if name in self.meshes:
                return self.meshes[name].vertices
        return None


def subject_of_capture(capture: Capture, meshes: Mapping[str, Mesh] | None = None) -> Subject:
    """Return the person of a capture; axes and landmarks that it does not give are derived from the scans.

    Args:
        meshes: what `load_meshes` returned, if they are loaded already.

    Raises:
        CaptureError: a landmark has an unknown name, or the scans are damaged, swapped or not in occlusion.
    """
    named = capture.anatomy.landmarks or {}
    unknown = sorted(set(named) - set(LANDMARKS))
    if unknown:
        raise CaptureError(
            f'[anatomy.landmarks] names "{unknown[0]}", known are {", ".join(LANDMARKS)}.',
            path=capture.folder / "capture.toml",
        )
    meshes = load_meshes(capture) if meshes is None else meshes
    return _measured(capture.name, meshes, capture.fps, capture.anatomy.T_anatomical_skull, named)


def subject_of_scans(files: Mapping[str, Path], name: str) -> Subject:
    """Return the person of loose scans in one frame, teeth in occlusion.

    Args:
        files: mesh files by the names of `MESHES`; both teeth scans are needed.

    Raises:
        CaptureError: a mesh is damaged or not in mm, or the scans are swapped or not in occlusion.
    """
    return _measured(name, read_meshes(files), None, None, {})


def _measured(
    name: str, meshes: Mapping[str, Mesh], fps: float | None, axes: ArrayLike | None, named: Mapping[str, ArrayLike]
) -> Subject:
    """Derive T_anatomical_skull from the scans unless `axes` gives it, and the landmarks that are not in `named`."""
    crowns = {key: mesh.vertices[tooth_labels(mesh) > 0] for key, mesh in meshes.items() if "teeth" in key}
    inferred = []
    if axes is None:
        T_anatomical_skull = anatomical_frame(crowns["upper_teeth"], crowns["lower_teeth"])
        inferred.append("anatomical axes, from the scans")
    else:
        T_anatomical_skull = np.array(axes, dtype=np.float64)
    bone = meshes.get("mandible")
    landmarks = find_landmarks(crowns["lower_teeth"], None if bone is None else bone.vertices, T_anatomical_skull)
    for index, landmark in enumerate(LANDMARKS):
        if landmark in named:
            landmarks[index] = named[landmark]
        else:
            source = "from the scans"
            if landmark.startswith("condyle"):
                source = "from the mandible mesh" if bone is not None else "at mean adult places: there is no mandible"
            inferred.append(f"{landmark}, {source}")
    return Subject(name, T_anatomical_skull, landmarks, meshes, fps, inferred=tuple(inferred))


def subject_of_landmarks(path: str | os.PathLike[str], name: str) -> Subject:
    """Return the person of a file of format jawusd-landmarks/1; errors are measured at the landmarks then.

    Raises:
        FormatError: see `formats.landmarks.load_landmarks`.
    """
    given = load_landmarks(path)
    if given.T_anatomical_skull is not None:
        return Subject(name, given.T_anatomical_skull, given.landmarks, {})
    inferred = ("anatomical axes, from the landmarks",)
    return Subject(name, landmark_frame(given.landmarks), given.landmarks, {}, inferred=inferred)


@explain_missing_packages()
def subject_of_build(folder: Path) -> Subject:
    """Return the person of a finished build: its model, and the meshes of its rig.

    Raises:
        FormatError: there is no model.
        RigError: there is no geometry.
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


def input_files(capture: Capture, names: Iterable[str]) -> dict[str, list[Path]]:
    """Return the files behind parts of a capture, for hashing, by the part they play.

    Args:
        names: any of "teeth", "mandible", "skull", "boards", "calibration", "masks", "videos".
    """
    parts: dict[str, list[Path]] = {}
    for name in names:
        if name == "teeth":
            scans = {key: getattr(capture.scans, key) for key in TEETH.values()}
            parts |= {key: [path] for key, path in scans.items()}
            parts |= {f"{key} labels": [labels_path(path, capture.scans.labels)] for key, path in scans.items()}
        elif name in BONES and (path := getattr(capture.scans, name)) is not None:
            parts[name] = [path]
        elif name == "calibration" and capture.calibration is not None:
            parts[name] = calibration_files(capture.calibration)
        elif name == "boards" and capture.boards is not None:
            parts |= {f"boards {k}": _sequence_files(path) for k, path in enumerate(capture.boards.videos)}
        elif name == "videos":
            clips = {camera.name: camera.video for camera in capture.cameras if camera.video is not None}
            parts |= {f"video {camera}": _sequence_files(path) for camera, path in clips.items()}
        elif name == "masks":
            for camera in capture.cameras:
                arches = {camera.masks.upper: "upper", camera.masks.lower: "lower"} if camera.masks else {}
                parts |= {f"masks {camera.name} {arch}": _sequence_files(path) for path, arch in arches.items()}
    return {part: [path for path in files if path.is_file()] for part, files in parts.items()}


def input_hashes(capture: Capture, names: Iterable[str]) -> dict[str, str]:
    """Return the content hashes of parts of a capture; see `input_files`.

    Raises:
        CaptureError: a file cannot be read.
    """
    try:
        names = list(names)
        found = {part: hash_files(files) for part, files in input_files(capture, names).items()}
    except OSError as error:
        raise CaptureError(f"cannot be read: {error.strerror}.", path=error.filename) from error
    if "videos" in names:  # how footage is read is part of what it shows
        keys = {"timecode", "start_frame", "fps", "colour_space", "pixel_aspect"}
        found["footage as read"] = hash_value([camera.model_dump(include=keys) for camera in capture.cameras])
        if capture.colour_config is not None:
            found["colour config"] = hash_files([capture.colour_config])
    return found


def _sequence_files(path: Path) -> list[Path]:
    """Return a video as it is, and the numbered files of a picture pattern; others may lie beside them."""
    if not is_pattern(path):
        return [path]
    try:
        return list(numbered_files(path).values())
    except CaptureError:  # its reader says so
        return []
