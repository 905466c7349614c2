"""Write the rig of a fitted model, and the take beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jawusd.base.errors import RigError, explain_missing_packages
from jawusd.evaluator import JawRig
from jawusd.formats.capture import Capture
from jawusd.formats.model import JawModel
from jawusd.formats.tracks import Tracks
from jawusd.geometry import LANDMARKS
from jawusd.pipeline.cameras import load_cameras, tracked_cameras
from jawusd.pipeline.contact import meeting_joints, meeting_teeth, with_joints, with_teeth
from jawusd.pipeline.meshes import BONES
from jawusd.pipeline.state import Progress, no_progress
from jawusd.pipeline.subject import Subject, registered_subject

DEFAULT_FPS = 24.0
_PROXY_FACES = 1500  # of a mesh; those along its borders come on top, see `proxy_of`
_TEETH_APART_MM = 15.0  # molars are picked by hand in one case and found by rule in the other


def check_same_jaw(subject: Subject, model: JawModel) -> None:
    """Check that a model and a person's scans are in one frame: their teeth must lie in one place.

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


@explain_missing_packages()
def bake_subject(
    subject: Subject,
    model: JawModel,
    folder: Path,
    progress: Progress = no_progress,
    *,
    fps: float = DEFAULT_FPS,
    table_size: int = 33,
    prim_name: str | None = None,
) -> list[Path]:
    """Write the rig of a person with meshes, and the captured motion if the model has any; return the files.

    Args:
        fps: frames per second if the subject has none.
        table_size: knots per axis of the sampled decoder, 17, 33 or 65.
        prim_name: of the actor's prim; None: after the person.

    Raises:
        RigError, OutputError: the rig cannot be written.
    """
    from jawusd.fitting.fit import with_speeds
    from jawusd.meshes.remeshing import bone_proxy_of, manifold, proxy_of
    from jawusd.rig.bake import bake_rig
    from jawusd.rig.layout import prim_name_of

    subject = registered_subject(subject, model.meta)
    # Bones come from segmented scans with all their faults; teeth scans stay as they are, vertex for vertex.
    meshes = {key: manifold(mesh) if key in BONES else mesh for key, mesh in subject.meshes.items()}
    if "contact" not in model.meta:  # fitted without the scans
        axes, landmarks, rest = (model.arrays[name] for name in ("T_anatomical_skull", "landmarks", "T_rest"))
        model = with_teeth(model, meeting_teeth(subject.meshes, axes, rest), progress, regauge=False)
        model = with_joints(model, meeting_joints(subject.meshes, axes, landmarks, rest), progress)
    if "velocity_covariance" not in model.arrays and subject.fps is not None:
        model = with_speeds(model, subject.fps)
    moving = len(model.frames) > 0
    progress("bake", 0, 1)
    files = bake_rig(
        folder,
        JawRig(model.arrays, model.meta),
        meshes,
        name=subject.name,
        fps=subject.fps or fps,
        frames=model.frames if moving else None,
        d=model.d if moving else None,
        table_size=table_size,
        prim_name=prim_name or prim_name_of(subject.name),
        proxies={
            key: (bone_proxy_of if key in BONES else proxy_of)(mesh, _PROXY_FACES)
            for key, mesh in meshes.items()
            if len(mesh.faces) > _PROXY_FACES
        },
    )
    progress("bake", 1, 1)
    return files


@explain_missing_packages()
def write_take(capture: Capture, tracks: Tracks, folder: Path) -> list[Path]:
    """Write the take beside the rig, its cameras and the actor where the head was; return the files.

    Raises:
        CalibrationError: a camera of the capture has no calibration.
        RigError, OutputError: the take cannot be written.
    """
    from jawusd.rig.cameras import write_cameras

    return write_cameras(
        folder / "cameras.usda",
        tracked_cameras(load_cameras(capture), tracks),
        folder / "anim_capture.usdc",
        tracks.frames,
        tracks.T_world_upper,
        capture.fps,
        [camera.name for camera in capture.cameras if camera.clip is not None and camera.clip.is_light],
    )
