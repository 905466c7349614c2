"""Add to a jaw model what the scans say of teeth and condyles: where they meet, and how deep each pose lets them in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from typing_extensions import TypedDict

from jawusd.base.arrays import Array
from jawusd.base.errors import RigError
from jawusd.evaluator import JawRig
from jawusd.evaluator.contact import AUTHORED_MM, NEAR_MM, ContactField
from jawusd.formats.mesh import Mesh
from jawusd.formats.model import JawModel
from jawusd.formats.report import ContactPicture
from jawusd.pipeline.meshes import BONES
from jawusd.pipeline.scan_labels import TEETH
from jawusd.pipeline.state import Progress, no_progress
from jawusd.pipeline.subject import Subject

if TYPE_CHECKING:
    from jawusd.meshes.contact import Teeth
    from jawusd.meshes.joints import Joints

_QUALITY = 88  # of the pictures, JPEG
_FARTHEST_MM = 1.5  # distances that are measured, see `meshes.collision`


class ContactSummary(TypedDict, total=False):
    """Hold what is known of the contact of the teeth, or of the condyles."""

    missing: str  # why nothing is
    closed_mm: float  # how deep the scans run into each other in the closed bite
    error_mm: float  # largest error of the clearances
    limit_mm: float  # what captured poses need; measured poses of less clearance of the teeth collide


def contact_words(contact: object) -> str:
    """Return a `ContactSummary` as text; of anything else, as files of others may hold it, that nothing is known."""
    found = contact if isinstance(contact, dict) else {}
    closed, error = found.get("closed_mm"), found.get("error_mm")
    if not isinstance(closed, float) or not isinstance(error, float):
        return f"nothing keeps them from passing through each other: {found.get('missing', 'contact was not measured')}"
    meet = f"the scans run {closed:.2f} mm into each other" if closed > 0 else f"the scans leave {-closed:.2f} mm"
    return f"{meet} in the closed bite; clearances to {error:.2f} mm"


def joint_words(joints: object) -> str:
    """Return the `ContactSummary` of the condyles as text; of anything else, that nothing is known."""
    found = joints if isinstance(joints, dict) else {}
    closed, error, limit = (found.get(name) for name in ("closed_mm", "error_mm", "limit_mm"))
    if not isinstance(closed, float) or not isinstance(error, float) or not isinstance(limit, float):
        return f"not compared with the skull: {found.get('missing', 'that was not measured')}"
    where = (
        f"{closed:.2f} mm in the bone of the skull" if closed > 0 else f"{-closed:.2f} mm from the bone of the skull"
    )
    if closed <= -_FARTHEST_MM:
        where = f"more than {_FARTHEST_MM:g} mm from the bone of the skull"
    if error == 0.0:  # measured where there is less
        return f"{where} in the closed bite, and not within {NEAR_MM:g} mm of it anywhere inside the bound"
    deeper = f"up to {-limit:.2f} mm into it in captured poses; " if limit < -AUTHORED_MM else ""
    return f"{where} in the closed bite; {deeper}clearances to {error:.2f} mm, no pose is refused for them"


def contact_pictures(model: JawModel, subject: Subject) -> tuple[ContactPicture, ...]:
    """Return the contacts of the closed bite, and half way of gliding forward and to both sides.

    Args:
        subject: The person, scans registered as the model's poses are.

    Raises:
        RigError: The scans do not show them.
    """
    from jawusd.media.overlay import encode_jpeg
    from jawusd.meshes.contact import ContactMap

    rig = JawRig(model.arrays, model.meta)
    drawn, closed = ContactMap(teeth_of(rig, subject.meshes)), rig.ranges(0.0)
    poses = {
        "closed bite": [0.0, 0.0, 0.0],
        "gliding forward": [0.0, 0.0, 0.5 * float(closed.d3_max)],
        "gliding to the left": [0.0, 0.5 * float(closed.d2_max), 0.0],
        "gliding to the right": [0.0, 0.5 * float(closed.d2_min), 0.0],
    }
    return tuple(
        ContactPicture(
            f"{name} (d = {', '.join(f'{x:.1f}' for x in d)} mm)",
            float(rig.clearance(d).clearance_mm),
            encode_jpeg(drawn.draw(rig.pose(d)), _QUALITY),
        )
        for name, d in poses.items()
        if np.isfinite(d).all()
    )


def teeth_of(rig: JawRig, meshes: Mapping[str, Mesh]) -> Teeth:
    """Return both rows of teeth among meshes (skull and mandible frame) as solids.

    Raises:
        RigError: The rig has no clearances, or the meshes do not show how the teeth meet.
    """
    from jawusd.meshes.contact import NoContact, find_teeth

    missing = [name for name in TEETH.values() if name not in meshes]
    if rig.contact is None or missing:
        raise RigError("does not know how the teeth meet.", hint="Fit it with scans of both rows in occlusion.")
    upper, lower = (meshes[TEETH[row]] for row in ("upper", "lower"))
    try:
        return find_teeth(upper, lower, rig.T_anatomical_skull, rig.T_rest)
    except NoContact as reason:
        raise RigError(f"does not show how the teeth meet: {reason}.") from reason


def meeting_teeth(meshes: Mapping[str, Mesh], T_anatomical_skull: Array, T_rest: Array) -> Teeth | str:
    """Return both rows of teeth among meshes as solids, or why there are none; what else is given is as in `Subject`.

    Args:
        meshes: Scans and bones, registered as the poses are.
    """
    from jawusd.meshes.contact import NoContact, find_teeth

    if any(name not in meshes for name in TEETH.values()):
        return "there are no scans of both rows of teeth"
    try:
        return find_teeth(meshes[TEETH["upper"]], meshes[TEETH["lower"]], T_anatomical_skull, T_rest)
    except NoContact as reason:
        return str(reason)


def meeting_joints(
    meshes: Mapping[str, Mesh], T_anatomical_skull: Array, landmarks: Array, T_rest: Array
) -> Joints | str:
    """Return condyles and skull among meshes as solids, or why there are none; see `meeting_teeth`."""
    from jawusd.meshes.contact import NoContact
    from jawusd.meshes.joints import find_joints

    if any(name not in meshes for name in BONES):
        return "there are no meshes of both skull and mandible"
    try:
        return find_joints(meshes["skull"], meshes["mandible"], landmarks, T_anatomical_skull, T_rest)
    except NoContact as reason:
        return str(reason)


def with_teeth(
    model: JawModel, teeth: Teeth | str, progress: Progress = no_progress, *, regauge: bool = True
) -> JawModel:
    """Return a model with the clearances of the teeth.

    ``meta["contact"]`` says how deep these run into each other, or why there are none.

    Args:
        teeth: Those of the person, see `meeting_teeth`.
        regauge: Count d1 from where the teeth touch, and end the bound there.
    """
    from jawusd.fitting.glide import follow_teeth
    from jawusd.meshes.contact import sample_field

    if isinstance(teeth, str):
        return _known(model, "contact", {"missing": teeth})
    progress("contact", 0, 3)
    if regauge:
        model = follow_teeth(model, teeth)
    progress("contact", 1, 3)
    field = sample_field(teeth, JawRig(model.arrays, model.meta))
    progress("contact", 2, 3)
    return replace(_known(model, "contact", _summary(field)), arrays={**model.arrays, **field.arrays("teeth")})


def with_joints(model: JawModel, joints: Joints | str, progress: Progress = no_progress) -> JawModel:
    """Return a model with the clearances of the condyles.

    ``meta["joints"]`` says how deep these run into the skull, or why there are none.

    Args:
        joints: Those of the person, see `meeting_joints`.
    """
    from jawusd.meshes.contact import sample_field
    from jawusd.meshes.joints import STEP_MM

    if isinstance(joints, str):
        model = _known(model, "joints", {"missing": joints})
    else:
        field = sample_field(joints, JawRig(model.arrays, model.meta), STEP_MM, np.inf)
        known, clearances = _known(model, "joints", _summary(field)), field.arrays("condyles")
        model = replace(known, arrays={**model.arrays, **clearances})
    progress("contact", 3, 3)
    return model


def _known(model: JawModel, name: str, found: ContactSummary) -> JawModel:
    return replace(model, meta={**model.meta, name: found})


def _summary(field: ContactField) -> ContactSummary:
    return {"closed_mm": field.closed_mm, "error_mm": field.error_mm, "limit_mm": field.limit_mm}
