"""Checks of the training data: human ranges, common mistakes, and movements that are missing.

Human ranges: opening 49 +-9 mm, laterotrusion 10-12 +-3 mm, protrusion 8-9 +-2.5 mm, rotation 39 +-6 deg, condylar path
20 +-4 mm (Zawawi 2003; Hirsch 2006; Muto & Kanazawa 1996). Limits are at least three standard deviations from the mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.fitting.data import PARAMETERS, SubjectAnatomy, TrainingData, displacement
from jawusd.fitting.gauge_fit import SMALLEST_OPENING_MM, fit_path, sheared
from jawusd.geometry import landmark_frame, se3_inverse, so3_log

_OPENING_MAX_MM = 75.0
_LATERAL_MAX_MM = 20.0
_PROTRUSION_MAX_MM = 16.0
_RETRUSION_MAX_MM = 6.0  # maximum retrusion behind the habitual path [mm], with the teeth nearly together
_NEAR_CLOSED_MM = 5.0  # maximum opening [mm] at which protrusion and retrusion are measured
_RISE_MAX_MM = 4.0  # maximum rise of the lower incisor above its position in the closed bite [mm]
_ROTATION_MAX_DEG = 57.0
_CONDYLE_MAX_MM = 32.0
_CONDYLES_APART_MM = (70.0, 140.0)
_QUANTILE = 99.5
# Maximum difference of rotation matrices for a coordinate frame to count as derived from the landmarks.
_SAME_FRAME = 0.01

_UNITS = {"metres": 1000.0, "centimetres": 10.0, "inches": 25.4, "micrometres": 1e-3}  # length of each unit in mm

# Ranges of motion below which a take should be repeated; nearly all adults exceed them (Hirsch 2006, Zawawi 2003).
_SMALL_OPENING_MM, _SMALL_LATERAL_MM, _SMALL_PROTRUSION_MM = 30.0, 5.0, 4.0
# Minimum fraction of the largest opening for a frame to count as wide open, and minimum number of such frames.
_WIDE, _FEW_WIDE_FRAMES = 0.85, 10
_HALF_OPEN = (0.25, 0.65)  # fractions of the largest opening between which the mouth counts as half open
_HALF_OPEN_SHARE = 0.35  # minimum fraction of the full range that should be reached with the mouth half open
# Directions in the plane of laterotrusion and protrusion to be covered with the mouth half open: their number, the
# distance from the median (as a fraction of the range) at which a frame covers one, and how many must be covered.
_SECTORS, _SECTOR_REACH, _FEWEST_SECTORS = 8, 0.25, 6
#: Distances along d1, d2 and d3 [mm]; a point of the bound farther from every captured pose lies in a gap.
FAR_MM = np.array([3.0, 2.0, 2.0])
_MOST_GAPS = 0.15  # maximum fraction of the bound in gaps; beyond it, more should be recorded
# Ranges (1st to 99th percentile) below which a parameter counts as not excited [mm].
_SMALLEST_RANGE_MM = np.array([SMALLEST_OPENING_MM, 3.0, 2.5])
# Movements that excite each parameter. Sentences on missing movements end in ": record" and a movement.
_MOVEMENTS = ("opening as wide as possible, three times", "full slides to both sides", "a full protrusion")


@dataclass(frozen=True)
class AnatomyWarning:
    """Warning about a value outside the human range: a short code, and a message with the normal range."""

    code: str
    message: str


def check_anatomy(data: TrainingData, anatomy: SubjectAnatomy) -> list[AnatomyWarning]:
    """Compare landmarks and motions with human ranges; if one common mistake explains the result, report only it."""
    mistake = _frame_mistake(data) or _unit_mistake(data, anatomy) or _swap_mistake(data)
    return [mistake] if mistake else _out_of_range(data)


def _frame_mistake(data: TrainingData) -> AnatomyWarning | None:
    incisor, molar_left, molar_right, condyle_left, condyle_right = data.landmarks
    apart = float(np.linalg.norm(condyle_left - condyle_right))
    if not _CONDYLES_APART_MM[0] <= apart <= _CONDYLES_APART_MM[1]:
        message = f"The condyles are {apart:.4g} mm apart (human: 70-140 mm): the scans are probably not in mm."
        return AnatomyWarning("scan_units", message)
    behind = min(incisor[2] - condyle_left[2], incisor[2] - condyle_right[2])
    if behind < 0:
        message = f"The condyles lie {-behind:.0f} mm in front of the incisors: z must point forward."
        return AnatomyWarning("front_back_flip", message)
    swapped = "Left and right landmarks are swapped:"
    if condyle_left[0] < condyle_right[0] or molar_left[0] < molar_right[0]:
        message = f"{swapped} in the anatomical frame x must point to the subject's left."
        return AnatomyWarning("left_right_flip", message)
    if min(condyle_left[1], condyle_right[1]) < incisor[1]:
        if np.allclose(landmark_frame(data.landmarks)[:3, :3], np.eye(3), atol=_SAME_FRAME):
            message = f"{swapped} the frame derived from them puts the condyles below."
            return AnatomyWarning("left_right_flip", message)
        return AnatomyWarning("upside_down", "The condyles lie below the incisal point: y must point up.")
    return None


def _unit_mistake(data: TrainingData, anatomy: SubjectAnatomy) -> AnatomyWarning | None:
    """Detect translations in a wrong unit, which dislocate the condyles."""
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
    """Return the distance that the midpoint of the condyles moves [mm] if the translations are scaled by a factor."""
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
            "not in the inverse poses: upper and lower teeth are probably swapped (T_lower_upper for T_upper_lower).",
        )
    return None


def _out_of_range(data: TrainingData) -> list[AnatomyWarning]:
    u = data.displacement()
    near = u[-u[:, 1] < _NEAR_CLOSED_MM]
    forward = near[:, 2] if len(near) else np.zeros(1)
    travel = np.linalg.norm([displacement(data.motion, condyle) for condyle in data.landmarks[3:]], axis=-1)
    turned = np.rad2deg(np.linalg.norm(so3_log(data.motion[:, :3, :3]), axis=-1))
    found = [
        ("opening", -u[:, 1], _OPENING_MAX_MM, "mm"),
        ("rise", u[:, 1], _RISE_MAX_MM, "mm"),
        ("laterotrusion", np.abs(u[:, 0]), _LATERAL_MAX_MM, "mm"),
        ("protrusion", forward, _PROTRUSION_MAX_MM, "mm"),
        ("retrusion", -forward, _RETRUSION_MAX_MM, "mm"),
        ("rotation", turned, _ROTATION_MAX_DEG, "deg"),
        ("condylar translation", travel, _CONDYLE_MAX_MM, "mm"),
    ]
    extremes = [(name, float(np.percentile(values, _QUANTILE)), limit, unit) for name, values, limit, unit in found]
    return [
        AnatomyWarning(
            f"{name.replace(' ', '_')}_range", f"{name.capitalize()} is {value:.1f} {unit} (human: up to {limit:g})."
        )
        for name, value, limit, unit in extremes
        if value > limit
    ]


def shown_parameters(data: TrainingData) -> tuple[Mask, list[str]]:
    """Return which parameters (3,) the poses excite, and a sentence for each parameter that they do not excite."""
    u = data.displacement()
    opening, side, front = sheared(u, fit_path(u, data.weights)).T
    if _range(side) >= _SMALLEST_RANGE_MM[1]:
        # A lateral excursion also moves the jaw forward; only motion beyond that is protrusion.
        arch = np.stack([np.abs(side), side, side**2], axis=-1)
        front = front - arch @ np.linalg.lstsq(arch, front, rcond=None)[0]
    spread = np.array([_range(values) for values in (opening, side, front)])
    shown = spread >= _SMALLEST_RANGE_MM
    sentences = [
        f"The poses do not show {name}: it varies by {spread[i]:.1f} mm (at least {_SMALLEST_RANGE_MM[i]:g} mm are "
        f"needed), so its slider only shifts the jaw within that range without learned rotation: "
        f"record {_MOVEMENTS[i]}."
        for i, name in enumerate(PARAMETERS)
        if not shown[i]
    ]
    return shown, sentences


def _range(values: Array) -> float:
    return float(np.percentile(values, 99) - np.percentile(values, 1))


def missing_movements(d: Array, shown: Mask) -> list[str]:
    """Return a sentence with advice for each missing movement of the captured d (N, 3) [mm] along parameters shown."""
    widest = float(d[:, 0].max())
    found = []
    if shown[0]:
        if widest < _SMALL_OPENING_MM:
            found.append(f"The widest opening is {widest:.0f} mm: record opening as wide as possible, three times.")
        wide = int((d[:, 0] > _WIDE * widest).sum())
        if wide < _FEW_WIDE_FRAMES:
            found.append(f"Only {wide} frames are near full opening: record the widest opening, held for a second.")
    for name, side in (("left", d[:, 1]), ("right", -d[:, 1])):
        if shown[1] and side.max() < _SMALL_LATERAL_MM:
            found.append(f"The jaw moves {max(side.max(), 0.0):.1f} mm to the {name}: record a full slide that way.")
    if shown[2] and d[:, 2].max() < _SMALL_PROTRUSION_MM:
        found.append(f"The jaw moves {max(d[:, 2].max(), 0.0):.1f} mm forward: record a full protrusion.")
    return found + (_missing_half_open(d) if shown.all() else [])


def bound_not_reached(gaps: tuple[Array, Array], shares: tuple[float, float]) -> list[str]:
    """Return a sentence for each plane in which too large a share of the bound is far from all captured poses.

    The gaps of each plane are points (d1, d2) and (d1, d3) [mm], (G, 2).
    """
    found = []
    for name, far, places, share in zip(PARAMETERS[1:], FAR_MM[1:], gaps, shares, strict=True):
        if share > _MOST_GAPS:
            low, high = places[:, 0].min(), places[:, 0].max()
            found.append(
                f"{100 * share:.0f} % of the bound of opening and {name} has no captured pose within {FAR_MM[0]:g} and "
                f"{far:g} mm: record slow circling between {low:.0f} and {high:.0f} mm of opening."
            )
    return found


def _missing_half_open(d: Array) -> list[str]:
    """Return sentences on movements that are missing between a quarter and two thirds of the opening."""
    low, high = (share * d[:, 0].max() for share in _HALF_OPEN)
    half = d[(d[:, 0] > low) & (d[:, 0] < high), 1:]
    where = f"between {low:.0f} and {high:.0f} mm of opening"
    if not len(half):
        return [f"There are no frames {where}: record opening and closing slowly."]
    reach = np.stack([d[:, 1].max(), -d[:, 1].min(), d[:, 2].max()])
    reached = np.stack([half[:, 0].max(), -half[:, 0].min(), half[:, 1].max()])
    names = ("slide to the left", "slide to the right", "protrusion")
    found = [
        f"There is no {name} {where}: record a {name} with the mouth half open."
        for name, here, there in zip(names, reached, reach, strict=True)
        if here < _HALF_OPEN_SHARE * there
    ]
    circle = (half - np.median(half, axis=0)) / np.maximum([max(reach[:2]), reach[2]], 1.0)
    far = circle[np.linalg.norm(circle, axis=1) > _SECTOR_REACH]
    covered = len(np.unique(np.round(np.arctan2(far[:, 1], far[:, 0]) / (2 * np.pi) * _SECTORS) % _SECTORS))
    if covered < _FEWEST_SECTORS:
        found.append(
            f"Only {covered} of {_SECTORS} directions are covered {where}: record ten seconds of circling with the "
            "mouth half open."
        )
    return found
