"""The person of a capture, of loose scans or of a finished build: anatomical axes, landmarks and meshes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.base.errors import CaptureError, explain_missing_packages
from jawusd.formats.capture import Capture
from jawusd.formats.landmarks import load_landmarks
from jawusd.formats.mesh import Mesh, tooth_labels
from jawusd.formats.model import load_model
from jawusd.geometry import LANDMARKS, anatomical_frame, find_landmarks, landmark_frame, transform_points
from jawusd.pipeline.meshes import load_meshes, read_meshes, registered_meshes, registration_of


@dataclass(frozen=True, eq=False)
class Subject:
    """Hold what fitting and reports need to know of a person."""

    name: str  # of the person or the capture
    T_anatomical_skull: Array  # scan frame to anatomical frame, shape (4, 4)
    landmarks: Array  # `geometry.LANDMARKS` in the mandible frame [mm], shape (5, 3)
    meshes: Mapping[str, Mesh]  # by the names of `meshes.MESHES`, scan frame [mm]; may be empty
    fps: float | None = None  # frames per second of the poses, None if not known
    T_rest: Array = field(default_factory=lambda: np.eye(4))  # T_skull_mandible of the closed bite, shape (4, 4)
    inferred: tuple[str, ...] = ()  # what was derived instead of being given

    def measured_points(self) -> Array | None:
        """Return the points whose motion is measured [mm], shape (V, 3): mandible, else lower teeth, else None."""
        for name in ("mandible", "lower_teeth"):
            if name in self.meshes:
                return self.meshes[name].vertices
        return None


def registered_subject(subject: Subject, meta: Mapping[str, object]) -> Subject:
    """Return a person with lower scan and landmarks where the take shows them; see `meshes.registered_meshes`."""
    T = registration_of(meta)
    if T is None:
        return subject
    lower = np.array([not name.startswith("condyle") for name in LANDMARKS])
    landmarks = np.where(lower[:, None], transform_points(T, subject.landmarks), subject.landmarks)
    return replace(subject, meshes=registered_meshes(subject.meshes, meta), landmarks=landmarks)


def subject_of_capture(capture: Capture, meshes: Mapping[str, Mesh] | None = None) -> Subject:
    """Return the person of a capture; axes and landmarks that it does not give are derived from the scans.

    Args:
        meshes: what `meshes.load_meshes` returned, if they are loaded already.

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
        files: mesh files by the names of `meshes.MESHES`; both teeth scans are needed.

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
