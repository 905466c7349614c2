"""Load what a capture names and bring it into one shape: cameras, meshes, anatomy."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from jawusd.errors import CalibrationError, CaptureError, explain_missing_packages
from jawusd.formats.camera_files import calibration_files, load_cameras_file
from jawusd.formats.capture import CameraSource, Capture, load_capture
from jawusd.formats.mesh import Mesh, tooth_labels
from jawusd.formats.tracks import Tracks
from jawusd.geometry import LANDMARKS, Camera, anatomical_frame, find_landmarks
from jawusd.geometry.arrays import Array
from jawusd.pipeline.state import hash_files

BONES = ("mandible", "skull")
MESHES = ("upper_teeth", "lower_teeth", *BONES)


@dataclass(frozen=True, eq=False)
class Anatomy:
    """Place the person: axes and landmarks.

    Attributes:
        T_anatomical_skull: scan frame to anatomical frame, shape (4, 4).
        landmarks: `geometry.LANDMARKS` in the mandible frame [mm], shape (5, 3).
        inferred: what was derived from the scans instead of being given.
    """

    T_anatomical_skull: Array
    landmarks: Array
    inferred: tuple[str, ...]


def open_capture(path: str | os.PathLike[str], *, allow_outside: bool = False) -> Capture:
    """Read a capture and check that its calibration names its cameras.

    Args:
        path: capture.toml or its folder.
        allow_outside: let paths in the capture leave its folder.

    Raises:
        FormatError, CaptureError: see `formats.capture.load_capture`.
    """
    return load_capture(path, allow_outside=allow_outside)


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


@explain_missing_packages()
def rescaled_cameras(capture: Capture) -> dict[str, tuple[tuple[int, int], tuple[int, int]]]:
    """Return the sizes (width, height) [px] calibrated and recorded, by the name of each camera where they differ.

    Args:
        capture: names calibration and videos.

    Raises:
        CalibrationError, CaptureError: as `load_cameras`.
    """
    pairs = [(camera, _at_recorded_size(camera, capture, source)) for camera, source in _calibrated(capture)]
    return {a.name: (tuple(a.size_px), tuple(b.size_px)) for a, b in pairs if tuple(a.size_px) != tuple(b.size_px)}


def tracked_cameras(cameras: Sequence[Camera], tracks: Tracks) -> list[Camera]:
    """Return the cameras the poses of tracks belong to: as loaded but for what the take itself corrected."""
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
    found = load_cameras_file(capture.calibration, capture.calibration_unit_mm)
    known = {camera.name: camera for camera in found}
    missing = [source.name for source in capture.cameras if source.name not in known]
    if missing:
        raise CalibrationError(
            f"does not know camera {missing[0]} of the capture; it names {', '.join(known)}.", path=capture.calibration
        )
    return [(known[source.name], source) for source in capture.cameras]


def _at_recorded_size(camera: Camera, capture: Capture, source: CameraSource) -> Camera:
    from jawusd.imaging.masks import mask_size_px
    from jawusd.imaging.video import Video

    if source.video is not None:
        recorded, path = Video(source.video).size_px, source.video
    elif source.masks is not None:
        path = source.masks.upper
        recorded = mask_size_px(path)
    else:
        return camera
    width, height = camera.size_px
    if tuple(recorded) == (width, height):
        return camera
    # One pixel is what rounding of a scaled height makes.
    if abs(recorded[0] * height / width - recorded[1]) > 1.0:
        raise CalibrationError(
            f"calibrated for pictures of {width} x {height} px, but {path.name} has "
            f"{recorded[0]} x {recorded[1]} px, another shape.",
            camera=camera.name,
            path=capture.calibration,
            hint="Calibrate in the recording's own mode: a crop cannot be told from the sizes alone.",
        )
    return camera.scaled(recorded)


@explain_missing_packages()
def load_meshes(capture: Capture) -> dict[str, Mesh]:
    """Read the scans and bones of a capture, by the names of `MESHES`; optional ones may be absent.

    Returns:
        Meshes in the scan frame [mm].

    Raises:
        CaptureError: a mesh is damaged, or of a size that cannot be in mm.
    """
    from jawusd.imaging.meshio import load_mesh

    paths = {name: getattr(capture.scans, name) for name in MESHES}
    return {
        name: load_mesh(path, kind="scan" if name.endswith("teeth") else "bone")
        for name, path in paths.items()
        if path is not None
    }


def find_anatomy(capture: Capture, meshes: dict[str, Mesh]) -> Anatomy:
    """Return the anatomical frame and the landmarks of a capture, given ones before derived ones.

    Args:
        capture: may give axes and landmarks.
        meshes: see `load_meshes`.

    Raises:
        CaptureError: a landmark has an unknown name, or the scans are swapped or not in occlusion.
    """
    named = capture.anatomy.landmarks or {}
    unknown = sorted(set(named) - set(LANDMARKS))
    if unknown:
        raise CaptureError(
            f'[anatomy.landmarks] names "{unknown[0]}", known are {", ".join(LANDMARKS)}.',
            path=capture.folder / "capture.toml",
        )
    return measure_anatomy(meshes, capture.anatomy.T_anatomical_skull, named)


@explain_missing_packages()
def measure_anatomy(meshes: Mapping[str, Mesh], given: ArrayLike | None, named: Mapping[str, ArrayLike]) -> Anatomy:
    """Derive from the scans what is not given.

    Args:
        meshes: by the names of `MESHES`, both rows of teeth among them.
        given: T_anatomical_skull, shape (4, 4), or None.
        named: landmarks in the mandible frame [mm] by the names of `geometry.LANDMARKS`, shape (3,) each.

    Raises:
        CaptureError: the scans are swapped or not in occlusion.
    """
    crowns = {name: mesh.vertices[tooth_labels(mesh) > 0] for name, mesh in meshes.items() if "teeth" in name}
    inferred = []
    if given is None:
        T_anatomical_skull = anatomical_frame(crowns["upper_teeth"], crowns["lower_teeth"])
        inferred.append("anatomical axes, from the scans")
    else:
        T_anatomical_skull = np.array(given, dtype=np.float64)
    bone = meshes.get("mandible")
    landmarks = find_landmarks(crowns["lower_teeth"], None if bone is None else bone.vertices, T_anatomical_skull)
    for index, name in enumerate(LANDMARKS):
        if name in named:
            landmarks[index] = named[name]
        else:
            source = "from the scans"
            if name.startswith("condyle"):
                source = "from the mandible mesh" if bone is not None else "at mean adult places: there is no mandible"
            inferred.append(f"{name}, {source}")
    return Anatomy(T_anatomical_skull, landmarks, tuple(inferred))


def input_files(capture: Capture, names: Iterable[str]) -> dict[str, list[Path]]:
    """Return the files behind parts of a capture, for hashing, by the part they play.

    Args:
        capture: the capture.
        names: any of "teeth", "mandible", "skull", "boards", "calibration", "masks", "videos".
    """
    parts: dict[str, list[Path]] = {}
    for name in names:
        if name == "teeth":
            parts |= {key: [getattr(capture.scans, key)] for key in MESHES if key not in BONES}
        elif name in BONES and (path := getattr(capture.scans, name)) is not None:
            parts[name] = [path]
        elif name == "calibration" and capture.calibration is not None:
            parts[name] = calibration_files(capture.calibration)
        elif name == "boards" and capture.boards is not None:
            parts |= {f"boards {k}": _sequence_files(path) for k, path in enumerate(capture.boards.videos)}
        elif name == "videos":
            parts |= {f"video {camera.name}": [camera.video] for camera in capture.cameras if camera.video is not None}
        elif name == "masks":
            for camera in capture.cameras:
                rows = {camera.masks.upper: "upper", camera.masks.lower: "lower"} if camera.masks else {}
                parts |= {f"masks {camera.name} {row}": _sequence_files(path) for path, row in rows.items()}
    return {part: [path for path in files if path.is_file()] for part, files in parts.items()}


def input_hashes(capture: Capture, names: Iterable[str]) -> dict[str, str]:
    """Return the content hashes of parts of a capture.

    Args:
        capture, names: see `input_files`.

    Raises:
        CaptureError: a file cannot be read.
    """
    try:
        return {part: hash_files(files) for part, files in input_files(capture, names).items()}
    except OSError as error:
        raise CaptureError(f"cannot be read: {error.strerror}.", path=error.filename) from error


def _sequence_files(path: Path) -> list[Path]:
    """Return a video as it is, and the numbered files of a picture pattern; others may lie beside them."""
    head, sign, tail = path.name.partition("%")
    if not sign:
        return [path]
    tail = tail.partition("d")[2]
    numbered = re.compile(rf"{re.escape(head)}\d+{re.escape(tail)}")
    return sorted(file for file in path.parent.iterdir() if numbered.fullmatch(file.name))
