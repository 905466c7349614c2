"""Write the rig of a fitted model, the captured take beside it, and the table of joint deltas for ARKit shapes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import FittingError, RigError, explain_missing_packages
from jawusd.evaluator import JawRig
from jawusd.evaluator.skin import Skin
from jawusd.formats.arkit import JAW_COLUMNS, shares_of
from jawusd.formats.capture import Capture
from jawusd.formats.keys import DEFAULT_FPS
from jawusd.formats.model import JawModel
from jawusd.formats.poses import JointDelta
from jawusd.formats.tracks import Tracks
from jawusd.geometry import LANDMARKS
from jawusd.pipeline.cameras import load_cameras, tracked_cameras
from jawusd.pipeline.contact import condyle_solids, tooth_solids, with_condyle_contact, with_tooth_contact
from jawusd.pipeline.state import Progress, no_progress
from jawusd.pipeline.subject import BONES, Subject, registered_subject

_PROXY_FACES = 1500  # number of faces of a proxy mesh, not counting those along borders; see `proxy_of`
_TEETH_APART_MM = 15.0  # maximum distance between the (picked or detected) tooth landmarks of model and scans


def check_same_jaw(subject: Subject, model: JawModel) -> None:
    """Raise RigError if the tooth landmarks of a model and of a subject's scans are far apart."""
    apart = np.linalg.norm(model.arrays["landmarks"][:3] - subject.landmarks[:3], axis=1)
    if apart.max() > _TEETH_APART_MM:
        raise RigError(
            f"the {LANDMARKS[int(apart.argmax())]} of the model is {apart.max():.1f} mm from that of the scans; at "
            f"most {_TEETH_APART_MM:g} mm is allowed.",
            hint="Scans and the landmarks or poses of the model must share one coordinate frame.",
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
    """Write the rig of a subject with meshes and, if there is any, the captured motion; return the files written.

    Args:
        fps: frame rate if the subject has none.
        table_size: knots per axis of the sampled decoder, 17, 33 or 65.
        prim_name: None: derived from the name of the subject.

    Raises:
        RigError, OutputError: the rig cannot be written.
    """
    from jawusd.fitting.fit import with_speeds
    from jawusd.meshes.remeshing import bone_proxy_of, manifold, proxy_of
    from jawusd.rig.bake import bake_rig
    from jawusd.rig.layout import prim_name_of

    subject = registered_subject(subject, model.meta)
    # Bones come from segmented volumes and need cleaning; the vertices of teeth scans are kept.
    meshes = {key: manifold(mesh) if key in BONES else mesh for key, mesh in subject.meshes.items()}
    if "contact" not in model.meta:  # the model was fitted without the scans
        axes, landmarks, rest = (model.arrays[name] for name in ("T_anatomical_skull", "landmarks", "T_rest"))
        model = with_tooth_contact(model, tooth_solids(subject.meshes, axes, rest), progress, regauge=False)
        model = with_condyle_contact(model, condyle_solids(subject.meshes, axes, landmarks, rest), progress)
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
    """Write the cameras and the captured head motion to the rig's folder; return the files written.

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


SHAPES = ("JawOpen", "JawLeft", "JawRight", "JawForward")
_REST_SHARE = 0.1  # fraction of the training frames, nearest to the closed bite, whose median is the face at rest
_WEIGHTS = (0.5, 1.0)  # shape weights in the table: two, because the joint does not move linearly with the weight


def joint_deltas(rig: JawRig, skin: Skin | None = None) -> list[JointDelta]:
    """Return the offset of the jaw joint, midway between the condyles, for each ARKit shape at half and full weight.

    All other shapes are at rest. The jaw parameters d are projected into the bound, as by `jawusd animate`.

    Args:
        skin: the subject's map from ARKit weights to d, whose face at rest is neutral; None: weights are fractions of
            the ranges of motion, and the teeth are closed in the neutral face.

    Raises:
        FittingError: the map was not learned from the four jaw weights.
    """
    from jawusd.rig.skel import joint_poses

    neutral, places = (np.zeros(4), range(4)) if skin is None else _face_at_rest(skin)
    cases = [(i, weight) for i in range(len(SHAPES)) for weight in _WEIGHTS]
    weights = np.tile(neutral, (1 + len(cases), 1))
    for row, (i, weight) in enumerate(cases, start=1):
        weights[row, places[i]] = weight
    wanted = rig.denormalized(shares_of(weights)) if skin is None else skin(weights).d
    d = rig.project(wanted)
    joint = joint_poses(rig, d)
    moved, turned = joint[1:, :3, 3] - joint[0, :3, 3], joint[1:, :3, :3] @ joint[0, :3, :3].T
    clamped = np.linalg.norm(d - wanted, axis=1)[1:].tolist()
    rows = zip(cases, d[1:], moved, turned, clamped, strict=True)
    return [JointDelta(SHAPES[i], weight, *rest) for (i, weight), *rest in rows]


def _face_at_rest(skin: Skin) -> tuple[Array, list[int]]:
    """Return the median columns (K,) of the training frames nearest to the closed bite, and where the jaw weights are.

    Raises FittingError if a jaw weight is not among the columns.
    """
    names = [name.lower() for name in skin.names]
    if missing := [shape for shape, column in zip(SHAPES, JAW_COLUMNS, strict=True) if column not in names]:
        raise FittingError(
            f"the map was not learned from {', '.join(missing)}; the table needs the four jaw weights of ARKit.",
            hint="Learn it with `jawusd arkit-fit`.",
        )
    arrays = skin.arrays
    near = np.argsort(np.linalg.norm(arrays["d"], axis=1))[: max(int(_REST_SHARE * len(arrays["d"])), 1)]
    rest = arrays["mean"] + arrays["scale"] * np.median(arrays["features"][near], axis=0) @ arrays["basis"]
    return rest, [names.index(column) for column in JAW_COLUMNS]
