"""Whose jaw it is: axes, landmarks and bones, from a capture, from scans, from landmarks alone or from a build."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from jawusd.errors import RigError, explain_missing_packages
from jawusd.formats.capture import Capture
from jawusd.formats.landmarks import load_landmarks
from jawusd.formats.mesh import Mesh
from jawusd.formats.model import JawModel, load_model
from jawusd.geometry import LANDMARKS, landmark_frame
from jawusd.geometry.arrays import Array
from jawusd.pipeline.prepare import find_anatomy, load_meshes, measure_anatomy

_TEETH_APART_MM = 15.0  # molars are picked by hand here, found by rule there


@dataclass(frozen=True, eq=False)
class Subject:
    """Hold what fitting and reports need to know of a person.

    Attributes:
        name: of the person or the capture.
        T_anatomical_skull: scan frame to anatomical frame, shape (4, 4).
        landmarks: `geometry.LANDMARKS` in the mandible frame [mm], shape (5, 3).
        bones: meshes by the names of `prepare.MESHES`, scan frame [mm]; may be empty.
        fps: frames per second of the poses, None if not known.
        T_rest: T_skull_mandible of the closed bite, shape (4, 4).
        inferred: what was derived instead of being given.
    """

    name: str
    T_anatomical_skull: Array
    landmarks: Array
    bones: Mapping[str, Mesh]
    fps: float | None = None
    T_rest: Array = field(default_factory=lambda: np.eye(4))
    inferred: tuple[str, ...] = ()

    def measured_points(self) -> Array | None:
        """Return the points whose motion is measured [mm], shape (V, 3): mandible, else lower teeth, else None."""
        for name in ("mandible", "lower_teeth"):
            if name in self.bones:
                return self.bones[name].vertices
        return None


@explain_missing_packages()
def subject_of_capture(capture: Capture) -> Subject:
    """Return the person of a capture.

    Raises:
        CaptureError: see `prepare.find_anatomy`.
    """
    meshes = load_meshes(capture)
    anatomy = find_anatomy(capture, meshes)
    return Subject(
        capture.name, anatomy.T_anatomical_skull, anatomy.landmarks, meshes, capture.fps, inferred=anatomy.inferred
    )


@explain_missing_packages()
def subject_of_scans(files: Mapping[str, Path], name: str) -> Subject:
    """Return the person of loose scans in one frame, teeth in occlusion.

    Args:
        files: mesh files by the names of `prepare.MESHES`; both rows of teeth are needed.
        name: of the person.

    Raises:
        CaptureError: a mesh is damaged or not in mm, or the scans are swapped or not in occlusion.
    """
    from jawusd.imaging.meshio import load_mesh

    meshes = {key: load_mesh(path, kind="scan" if key.endswith("teeth") else "bone") for key, path in files.items()}
    anatomy = measure_anatomy(meshes, None, {})
    return Subject(name, anatomy.T_anatomical_skull, anatomy.landmarks, meshes, inferred=anatomy.inferred)


def subject_of_landmarks(path: str | os.PathLike[str], name: str) -> Subject:
    """Return the person of a landmarks file; without scans, errors are measured at the landmarks.

    Args:
        path: JSON of format jawusd-landmarks/1.
        name: of the person.

    Raises:
        FormatError: see `formats.landmarks.load_landmarks`.
    """
    given = load_landmarks(path)
    T, inferred = given.T_anatomical_skull, ()
    if T is None:
        T, inferred = landmark_frame(given.landmarks), ("anatomical axes, from the landmarks",)
    return Subject(name, T, given.landmarks, {}, inferred=inferred)


def check_same_jaw(subject: Subject, model: JawModel) -> None:
    """Check that a model and a person's scans are in one frame: their teeth must lie in one place.

    Args:
        subject: the person with scans.
        model: the model that shall move them.

    Raises:
        RigError: naming the distance.
    """
    apart = np.linalg.norm(model.arrays["landmarks"][:3] - subject.landmarks[:3], axis=1)
    if apart.max() > _TEETH_APART_MM:
        raise RigError(
            f"the {LANDMARKS[int(apart.argmax())]} of the model is {apart.max():.1f} mm from that of the scans "
            f"(allowed: {_TEETH_APART_MM:g} mm).",
            hint="Scans and the landmarks or poses of the model must be given in one frame.",
        )


def subject_of_build(folder: Path) -> Subject:
    """Return the person of a finished build: its model, and the meshes of its rig.

    Args:
        folder: of the build.

    Raises:
        FormatError: there is no model.
        RigError: there is no geometry.
    """
    from jawusd.rig.geo import read_geometry

    model = load_model(folder / "model.npz")
    bones = read_geometry(folder / "geo.usdc")
    return Subject(
        str(model.meta.get("actor") or folder.resolve().name),
        np.asarray(model.arrays["T_anatomical_skull"], dtype=np.float64),
        np.asarray(model.arrays["landmarks"], dtype=np.float64),
        bones,
        model.meta.get("fps"),
        np.asarray(model.arrays["T_rest"], dtype=np.float64),
    )
