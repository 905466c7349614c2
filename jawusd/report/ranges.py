"""How far this jaw went, beside what is known of other people."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.formats.model import JawModel
from jawusd.formats.tracks import Tracks
from jawusd.geometry import se3_inverse, so3_log, transform_point, transform_points
from jawusd.geometry.arrays import Array
from jawusd.report.verdicts import GOOD, LOOK

_QUANTILE = 99.5  # one odd frame is no range of motion
_NEAR_CLOSED_MM = 5.0  # openings in which protrusion is read off, as clinicians do


@dataclass(frozen=True)
class RangeRow:
    """Compare one range.

    Attributes:
        name: what was measured.
        found: this person's, with its unit.
        usual: of about 95 % of people, with its unit.
        source: of the published numbers.
        remark: the comparison in words.
        grade: "good" or "look".
    """

    name: str
    found: str
    usual: str
    source: str
    remark: str
    grade: str


# Lowest and highest usual value: mean -+ 2 SD, over both sexes where they are given apart.
_REFERENCE = {
    "opening at the incisors": (
        36.0,
        70.0,
        "mm",
        "51.3 \u00b1 8.3 (men), 44.3 \u00b1 6.7 (women), n = 894, PMC3428458",
    ),
    "laterotrusion to the left": (6.0, 15.2, "mm", "10.6 \u00b1 2.3, n = 1011, Hirsch 2006"),
    "laterotrusion to the right": (5.8, 14.6, "mm", "10.2 \u00b1 2.2, n = 1011, Hirsch 2006"),
    "protrusion": (3.2, 13.2, "mm", "8.2 \u00b1 2.5, n = 1011, Hirsch 2006"),
    "rotation": (27.7, 50.9, "deg", "39.1 \u00b1 5.9 (men), 36.3 \u00b1 4.3 (women), Muto & Kanazawa 1996"),
    "travel of the left condyle": (12.5, 28.5, "mm", "20.5 \u00b1 4.0 (men), 18.1 \u00b1 2.5 (women), same"),
    "travel of the right condyle": (12.5, 28.5, "mm", "20.5 \u00b1 4.0 (men), 18.1 \u00b1 2.5 (women), same"),
}


def human_ranges(tracks: Tracks, model: JawModel) -> list[RangeRow]:
    """Measure the ranges of the poses that shaped the model; empty if there are none.

    Returns:
        One row per movement.
    """
    motion, landmarks = captured_motion(tracks, model)
    if not len(motion):
        return []
    found = _measured(motion, landmarks)
    return [_row(name, value) for name, value in zip(_REFERENCE, found, strict=True)]


def captured_motion(tracks: Tracks, model: JawModel) -> tuple[Array, Array]:
    """Return the motions away from the closed bite that shaped the model, and the landmarks in it.

    Returns:
        Motions (N, 4, 4) and landmarks (5, 3) [mm], anatomical frame.
    """
    used = np.isin(tracks.frames, model.frames[model.trained]) & np.isfinite(tracks.raw_T_upper_lower).all((1, 2))
    return anatomical_motion(tracks.raw_T_upper_lower[used], model), rest_points(model, model.arrays["landmarks"])


def anatomical_motion(T_skull_mandible: Array, model: JawModel) -> Array:
    """Return motions away from the closed bite, anatomical frame, of poses (N, 4, 4)."""
    A, rest = model.arrays["T_anatomical_skull"], model.arrays["T_rest"]
    return A @ T_skull_mandible @ se3_inverse(A @ rest)


def rest_points(model: JawModel, points: Array) -> Array:
    """Return mandible points (N, 3) [mm] in the closed bite, anatomical frame."""
    return transform_points(model.arrays["T_anatomical_skull"] @ model.arrays["T_rest"], points)


def _measured(motion: Array, landmarks: Array) -> list[float]:
    u = transform_point(motion, landmarks[0]) - landmarks[0]
    near = u[-u[:, 1] < _NEAR_CLOSED_MM]
    turns = np.rad2deg(np.linalg.norm(so3_log(motion[:, :3, :3]), axis=-1))
    travels = [np.linalg.norm(transform_point(motion, point) - point, axis=-1) for point in landmarks[3:]]
    forward = near[:, 2] if len(near) else np.zeros(1)
    return [float(np.percentile(v, _QUANTILE)) for v in (-u[:, 1], u[:, 0], -u[:, 0], forward, turns, *travels)]


def _row(name: str, value: float) -> RangeRow:
    low, high, unit, source = _REFERENCE[name]
    if value < low:
        remark, grade = "less than usual: perhaps the full range was not recorded", LOOK
    elif value > high:
        remark, grade = "more than usual", LOOK
    else:
        remark, grade = "usual", GOOD
    return RangeRow(name, f"{value:.1f} {unit}", f"{low:g} to {high:g} {unit}", source, remark, grade)
