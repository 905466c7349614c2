"""Do picks agree with one another and with the masks? If not, the mistake that explains it is named."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

from jawusd.base.errors import TrackingError
from jawusd.formats.finding import Finding, Severity
from jawusd.tracking.initialization.pick_causes import ON, Evidence, Mistake, Seen, Setting, evidence, explanation

# Doubt of what is given from which a mistake is looked for. Of 60 valid persons with picks (`tests/benchmarks/
# population.py`, seeds 0 to 39 and 300 to 329) one exceeds it, at 1.95; no mistake was named for any of them.
_DOUBTFUL = 1.7
_FEWEST = 3  # picks on an arch


def pick_findings(given: Setting, seen: Sequence[Seen], masked: Sequence[str], frame: int) -> Iterator[Finding]:
    """Yield what is wrong or doubtful about the picks of a frame, and about all that they show to be wrong.

    Args:
        given: everything as the capture has it.
        seen: the masks, once per guess of the time offsets.
        masked: cameras that have masks.
        frame: of the picks, for the findings.

    Raises:
        TrackingError: the picks contradict one another, and no single mistake explains it.
    """
    found, problem = None, None
    try:
        found = evidence(given, seen, masked)
    except TrackingError as error:
        problem = error
    cause = None
    if found is None or not found.good or found.doubt > _DOUBTFUL:
        with contextlib.suppress(TrackingError):  # a pick that cannot be
            cause = explanation(given, found, seen, masked) if _can_be(given) else None
    if cause is not None:
        yield _explained(*cause, found, frame)
        yield from _left_out(cause[1], frame)
        return
    if found is None:
        raise problem or TrackingError("the picks contradict one another", frame=frame)
    yield from _left_out(found, frame)
    for name, share in found.on.items():
        if share < ON:
            message = f"{share:.0%} of its masks lie on the scans as the picks place them, {ON:.0%} or more are usual"
            hint = "Check picks, masks, calibration and time offsets of this camera."
            yield Finding("masks_off_picks", "warning", message, share, ON, camera=name, frame=frame, hint=hint)


def _explained(mistake: Mistake, undone: Evidence, found: Evidence | None, frame: int) -> Finding:
    """Return the mistake as a finding, with the evidence; a warning if tracking makes up for it."""
    as_given = "the picks contradict one another" if found is None else _said(found)
    message = f"{mistake.message}; as given {as_given}, with that undone {_said(undone)}"
    severity: Severity = "warning" if mistake.correctable and found is not None else "error"
    return Finding(
        mistake.kind,
        severity,
        message,
        value=None if found is None else round(found.doubt, 2),
        camera=mistake.camera,
        frame=frame,
        hint=mistake.hint,
    )


def _said(found: Evidence) -> str:
    worst = f" and {min(found.on.values()):.0%} or more of each camera's masks lie on the scans" if found.on else ""
    return f"the picks agree to {found.miss_mm:.1f} mm{worst}"


def _left_out(found: Evidence, frame: int) -> Iterator[Finding]:
    for arch, numbers in found.wrong.items():
        for number in numbers:
            message = f"pick {number} on the {arch} teeth does not fit the others and is left out"
            hint = "Check its vertex, pixels and camera names."
            yield Finding("pick_wrong", "warning", message, frame=frame, hint=hint)


def _can_be(given: Setting) -> bool:
    """Tell whether there are enough picks of vertices and cameras that exist."""
    for picks, vertices in zip(given.picks, given.vertices, strict=True):
        cameras = [{view.camera for view in pick.views} for pick in picks]
        known = all(len(own) >= 2 and own <= set(given.cameras) for own in cameras)
        if len(picks) < _FEWEST or not known or any(pick.vertex >= len(vertices) for pick in picks):
            return False
    return True
