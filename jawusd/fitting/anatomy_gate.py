"""The anatomical gate: compare landmarks and poses with human ranges and recognise common mistakes.

Ranges: opening 49 +-9 mm, laterotrusion 10-12 +-3 mm, protrusion 8-9 +-2.5 mm, rotation 39 +-6 deg, condylar path
20 +-4 mm (Zawawi 2003; Hirsch 2006; Muto & Kanazawa 1996); limits lie three standard deviations out or more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.fitting.data import SubjectAnatomy, TrainingData, displacement
from jawusd.geometry import landmark_frame, se3_inverse, so3_log

_OPENING_MAX_MM = 75.0
_LATERAL_MAX_MM = 20.0
_PROTRUSION_MAX_MM = 16.0
_RETRUSION_MAX_MM = 6.0  # backwards beyond the habitual path, teeth nearly together
_NEAR_CLOSED_MM = 5.0  # openings up to which protrusion and retrusion are measured
_RISE_MAX_MM = 4.0  # the lower incisor cannot rise above the bite by more
_ROTATION_MAX_DEG = 57.0
_CONDYLE_MAX_MM = 32.0
_CONDYLES_APART_MM = (70.0, 140.0)
_QUANTILE = 99.5
_SAME_FRAME = 0.01  # of rotation matrices: a frame that was found from the landmarks themselves

_UNITS = {"metres": 1000.0, "centimetres": 10.0, "inches": 25.4, "micrometres": 1e-3}  # mm in one unit


@dataclass(frozen=True)
class AnatomyWarning:
    """Report one finding that no human jaw shows: a short code, and a message with the normal range."""

    code: str
    message: str


def check_anatomy(data: TrainingData, anatomy: SubjectAnatomy) -> list[AnatomyWarning]:
    """Compare landmarks and motions with human ranges; a recognised mistake is reported alone."""
    mistake = _frame_mistake(data) or _unit_mistake(data, anatomy) or _swap_mistake(data)
    return [mistake] if mistake else _out_of_range(data)


def _frame_mistake(data: TrainingData) -> AnatomyWarning | None:
    incisor, molar_left, molar_right, condyle_left, condyle_right = data.landmarks
    apart = float(np.linalg.norm(condyle_left - condyle_right))
    if not _CONDYLES_APART_MM[0] <= apart <= _CONDYLES_APART_MM[1]:
        return AnatomyWarning(
            "scan_units",
            f"The condyles are {apart:.4g} mm apart (human: 70-140 mm): the scans are probably not in mm.",
        )
    behind = min(incisor[2] - condyle_left[2], incisor[2] - condyle_right[2])
    if behind < 0:
        return AnatomyWarning(
            "front_back_flip", f"The condyles lie {-behind:.0f} mm in front of the incisors: z must point forward."
        )
    if condyle_left[0] < condyle_right[0] or molar_left[0] < molar_right[0]:
        return AnatomyWarning(
            "left_right_flip",
            "Left and right landmarks are exchanged: in the anatomical frame x must point to the subject's left.",
        )
    if min(condyle_left[1], condyle_right[1]) < incisor[1]:
        if np.allclose(landmark_frame(data.landmarks)[:3, :3], np.eye(3), atol=_SAME_FRAME):
            return AnatomyWarning(
                "left_right_flip",
                "Left and right landmarks are exchanged: the frame was found from them, and has the condyles below.",
            )
        return AnatomyWarning("upside_down", "The condyles lie below the incisal point: y must point up.")
    return None


def _unit_mistake(data: TrainingData, anatomy: SubjectAnatomy) -> AnatomyWarning | None:
    """Recognise translations in a wrong unit, which move the condyles out of their joints."""
    travel = _condyle_travel(data, anatomy, 1.0)
    if travel <= _CONDYLE_MAX_MM:
        return None
    scaled, name = min((_condyle_travel(data, anatomy, factor), name) for name, factor in _UNITS.items())
    if scaled > _CONDYLE_MAX_MM:
        return None
    return AnatomyWarning(
        "pose_units",
        f"The condyles travel {travel:.3g} mm (human: up to {_CONDYLE_MAX_MM:g} mm), but {scaled:.1f} mm if the "
        f"translations of the poses are in {name}.",
    )


def _condyle_travel(data: TrainingData, anatomy: SubjectAnatomy, factor: float) -> float:
    """Return how far the middle between the condyles moves [mm] with the poses' translations scaled."""
    T = anatomy.poses(data.motion)
    T[:, :3, 3] *= factor
    moved = displacement(anatomy.motion(T), data.landmarks[3:].mean(0))
    return float(np.percentile(np.linalg.norm(moved, axis=-1), 90))


def _swap_mistake(data: TrainingData) -> AnatomyWarning | None:
    rise = float(np.percentile(data.displacement()[:, 1], _QUANTILE))
    swapped = displacement(se3_inverse(data.motion), data.incisor)
    swapped_rise = float(np.percentile(swapped[:, 1], _QUANTILE))
    if rise > _RISE_MAX_MM and swapped_rise < _RISE_MAX_MM:
        return AnatomyWarning(
            "swapped_jaws",
            f"The lower incisal point rises {rise:.1f} mm above the bite (at most {_RISE_MAX_MM:g} mm is possible) but "
            "not in the inverse poses: upper and lower teeth are probably exchanged (T_lower_upper for T_upper_lower).",
        )
    return None


def _out_of_range(data: TrainingData) -> list[AnatomyWarning]:
    u = data.displacement()
    near = u[-u[:, 1] < _NEAR_CLOSED_MM]
    forward = near[:, 2] if len(near) else np.zeros(1)
    travel = np.linalg.norm([displacement(data.motion, condyle) for condyle in data.landmarks[3:]], axis=-1)
    turned = np.rad2deg(np.linalg.norm(so3_log(data.motion[:, :3, :3]), axis=-1))
    found = [
        ("opening", float(np.percentile(-u[:, 1], _QUANTILE)), _OPENING_MAX_MM, "mm"),
        ("rise", float(np.percentile(u[:, 1], _QUANTILE)), _RISE_MAX_MM, "mm"),
        ("laterotrusion", float(np.percentile(np.abs(u[:, 0]), _QUANTILE)), _LATERAL_MAX_MM, "mm"),
        ("protrusion", float(np.percentile(forward, _QUANTILE)), _PROTRUSION_MAX_MM, "mm"),
        ("retrusion", float(np.percentile(-forward, _QUANTILE)), _RETRUSION_MAX_MM, "mm"),
        ("rotation", float(np.percentile(turned, _QUANTILE)), _ROTATION_MAX_DEG, "deg"),
        (
            "condylar translation",
            float(np.percentile(travel, _QUANTILE)),
            _CONDYLE_MAX_MM,
            "mm",
        ),
    ]
    return [
        AnatomyWarning(
            f"{name.replace(' ', '_')}_range", f"{name.capitalize()} is {value:.1f} {unit} (human: up to {limit:g})."
        )
        for name, value, limit, unit in found
        if value > limit
    ]
