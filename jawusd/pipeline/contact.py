"""Add to a jaw model what the scans say of its teeth: where they meet, and how deep each pose lets them in."""

from __future__ import annotations

from dataclasses import replace
from typing import TypedDict

from jawusd.evaluator import JawRig
from jawusd.formats.model import JawModel
from jawusd.pipeline.prepare import Subject
from jawusd.pipeline.scan_labels import TEETH
from jawusd.pipeline.state import Progress, no_progress


class ContactSummary(TypedDict, total=False):
    """Hold what is known of the contact of the teeth."""

    missing: str  # why nothing is
    closed_mm: float  # how deep the scans run into each other in the closed bite
    error_mm: float  # largest error of the clearances
    limit_mm: float  # measured poses of less clearance collide


def contact_words(contact: ContactSummary) -> str:
    """Return a summary as text."""
    if "missing" in contact:
        return f"nothing keeps them from passing through each other: {contact['missing']}"
    closed = contact["closed_mm"]
    meet = f"the scans run {closed:.2f} mm into each other" if closed > 0 else f"the scans leave {-closed:.2f} mm"
    return f"{meet} in the closed bite; clearances to {contact['error_mm']:.2f} mm"


def with_contact(
    model: JawModel, subject: Subject, progress: Progress = no_progress, *, regauge: bool = True
) -> JawModel:
    """Return a model with the clearance of its teeth; ``meta["contact"]`` says how deep, or why there is none.

    Args:
        subject: The person, scans registered as the model's poses are.
        regauge: Count d1 from where the teeth touch, and end the bound there.
    """
    from jawusd.fitting.glide import follow_teeth
    from jawusd.imaging.contact import NoContact, find_teeth, sample_field

    if not all(name in subject.meshes for name in TEETH.values()):
        return replace(model, meta={**model.meta, "contact": {"missing": "there are no scans of both rows of teeth"}})
    progress("contact", 0, 3)
    upper, lower = (subject.meshes[TEETH[row]] for row in ("upper", "lower"))
    try:
        teeth = find_teeth(upper, lower, model.arrays["T_anatomical_skull"], model.arrays["T_rest"])
        progress("contact", 1, 3)
        if regauge:
            model = follow_teeth(model, teeth)
        progress("contact", 2, 3)
        field = sample_field(teeth, JawRig(model.arrays, model.meta))
    except NoContact as reason:
        return replace(model, meta={**model.meta, "contact": {"missing": str(reason)}})
    finally:
        progress("contact", 3, 3)
    found: ContactSummary = {"closed_mm": field.closed_mm, "error_mm": field.error_mm, "limit_mm": field.limit_mm}
    return replace(model, arrays={**model.arrays, **field.arrays()}, meta={**model.meta, "contact": found})
