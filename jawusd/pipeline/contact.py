"""Contact of teeth and condyles in a jaw model: clearances measured on the meshes, and rendered contact images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from typing_extensions import TypedDict

from jawusd.base.arrays import Array
from jawusd.base.errors import RigError
from jawusd.evaluator import JawRig
from jawusd.formats.mesh import Mesh
from jawusd.formats.model import JawModel
from jawusd.formats.report import ContactPicture
from jawusd.pipeline.state import Progress, no_progress
from jawusd.pipeline.subject import BONES, TEETH, Subject

if TYPE_CHECKING:
    from jawusd.meshes.contact import Surfaces, Teeth

_QUALITY = 88  # JPEG quality of the images


class ContactSummary(TypedDict, total=False):
    """Summary of the contact of the teeth, or of the condyles."""

    missing: str  # reason why contact was not measured
    closed_mm: float  # penetration depth of the scans with the teeth closed
    error_mm: float  # Maximum error of the clearances.
    limit_mm: float  # Smallest clearance of captured poses; poses with less clearance count as collisions.


def contact_pictures(model: JawModel, subject: Subject) -> tuple[ContactPicture, ...]:
    """Draw tooth contacts in occlusion and halfway through each glide; raises RigError if the scans define none."""
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
    """Return both arches as solids, from meshes in skull and mandible frame; raises RigError if that fails."""
    if rig.contact is None or any(name not in meshes for name in TEETH.values()):
        raise RigError("has no tooth contact data.", hint="Fit it with scans of both arches in occlusion.")
    teeth = tooth_solids(meshes, rig.T_anatomical_skull, rig.T_rest)
    if isinstance(teeth, str):
        raise RigError(f"does not allow tooth contact to be computed: {teeth}.")
    return teeth


def tooth_solids(meshes: Mapping[str, Mesh], T_anatomical_skull: Array, T_rest: Array) -> Teeth | str:
    """Return both arches as solids, or the reason why that failed.

    The meshes are in the registration to which the poses refer; axes and rest pose are as in `Subject`.
    """
    from jawusd.meshes.contact import NoContact, find_teeth

    if any(name not in meshes for name in TEETH.values()):
        return "scans of both arches are needed"
    try:
        return find_teeth(meshes[TEETH["upper"]], meshes[TEETH["lower"]], T_anatomical_skull, T_rest)
    except NoContact as reason:
        return str(reason)


def condyle_solids(
    meshes: Mapping[str, Mesh], T_anatomical_skull: Array, landmarks: Array, T_rest: Array
) -> Surfaces | str:
    """Return condyles and skull as solids, or the reason why that failed; see `tooth_solids`."""
    from jawusd.meshes.contact import NoContact, find_joints

    if any(name not in meshes for name in BONES):
        return "meshes of both skull and mandible are needed"
    try:
        return find_joints(meshes["skull"], meshes["mandible"], landmarks, T_anatomical_skull, T_rest)
    except NoContact as reason:
        return str(reason)


def with_tooth_contact(
    model: JawModel, teeth: Teeth | str, progress: Progress = no_progress, *, regauge: bool = True
) -> JawModel:
    """Return the model with clearances of `tooth_solids` added; ``meta["contact"]`` summarises them.

    With `regauge`, d1 is shifted so that the teeth touch at d1 = 0, where the bound then ends.
    """
    from jawusd.fitting.glide import follow_teeth

    if isinstance(teeth, str):
        return _measured(model, "contact", teeth, "teeth")
    progress("contact", 0, 3)
    if regauge:
        model = follow_teeth(model, teeth)
    progress("contact", 1, 3)
    model = _measured(model, "contact", teeth, "teeth")
    progress("contact", 2, 3)
    return model


def with_condyle_contact(model: JawModel, joints: Surfaces | str, progress: Progress = no_progress) -> JawModel:
    """Return the model with clearances of `condyle_solids` added; ``meta["joints"]`` summarises them."""
    from jawusd.meshes.contact import JOINT_STEP_MM

    model = _measured(model, "joints", joints, "condyles", JOINT_STEP_MM, np.inf)
    progress("contact", 3, 3)
    return model


def _measured(
    model: JawModel, name: str, solids: Surfaces | str, parts: Literal["teeth", "condyles"], *sampling: float
) -> JawModel:
    """Return the model with the clearances of some parts, or with the reason why they could not be measured."""
    from jawusd.meshes.contact import sample_field

    if isinstance(solids, str):
        return replace(model, meta={**model.meta, name: ContactSummary(missing=solids)})
    field = sample_field(solids, JawRig(model.arrays, model.meta), *sampling)
    found = ContactSummary(closed_mm=field.closed_mm, error_mm=field.error_mm, limit_mm=field.limit_mm)
    return replace(model, meta={**model.meta, name: found}, arrays={**model.arrays, **field.arrays(parts)})
