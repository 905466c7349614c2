"""Ranges of motion: of one person beside published ones, and of many actors side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from jawusd.base.arrays import Array
from jawusd.base.errors import shown
from jawusd.evaluator.frames import motions_of_poses
from jawusd.formats.model import JawModel
from jawusd.formats.tracks import Tracks
from jawusd.geometry import so3_log, transform_point, transform_points
from jawusd.report.style import BLACK, BLUE, GREEN, SKY, new_figure, save_figure
from jawusd.report.verdicts import GOOD, LOOK

_QUANTILE = 99.5  # robust to single outliers
_NEAR_CLOSED_MM = 5.0  # openings up to which protrusion is measured, as in clinics


RANGES = "ranges"  # name of the files with many actors

_PARAMETERS = {
    "opening": ("opening d1", BLUE),
    "laterotrusion": ("laterotrusion d2, + left", GREEN),
    "protrusion": ("protrusion d3, + forward", SKY),
}
_ROW_IN, _MARGINS_IN = 0.22, 0.9
_MOST_ROWS = 400  # a taller picture cannot be opened


@dataclass(frozen=True)
class RangeRow:
    """Compare the range of one movement with that of about 95 % of people, in words; the grade is "good" or "look"."""

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
    """Measure the ranges of the poses that the model was fitted to, a row per movement; none without poses."""
    T = tracks.raw_T_upper_lower
    used = np.isin(tracks.frames, model.frames[model.trained]) & np.all(np.isfinite(T), axis=(1, 2))
    if not used.any():
        return []
    A, rest = model.arrays["T_anatomical_skull"], model.arrays["T_rest"]
    found = _measured(motions_of_poses(T[used], A, rest), transform_points(A @ rest, model.arrays["landmarks"]))
    return [_row(name, value) for name, value in zip(_REFERENCE, found, strict=True)]


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


def draw_ranges(people: Sequence[tuple[str, dict[str, list[float]]]], folder: Path) -> list[Path]:
    """Draw the ranges of actors, see `ranges_figure`, into a folder as PNG and SVG; return the files.

    Raises:
        OutputError: a file cannot be written.
    """
    return save_figure(ranges_figure(people), folder, RANGES)


def ranges_figure(people: Sequence[tuple[str, dict[str, list[float]]]]) -> Figure:
    """Draw the ranges of actors as bars, one row per actor, one column per parameter.

    Args:
        people: name of each actor, and lowest and highest value [mm] by "opening", "laterotrusion", "protrusion"; the
            first 400 are drawn.
    """
    drawn = list(people)[:_MOST_ROWS]
    figure, axes = new_figure(9.0, _MARGINS_IN + _ROW_IN * max(len(drawn), 2), 1, 3, sharey=True)
    rows = range(len(drawn))
    for axis, (key, (title, color)) in zip(axes, _PARAMETERS.items(), strict=True):
        ends = [ranges[key] for _, ranges in drawn]
        axis.barh(rows, [high - low for low, high in ends], left=[low for low, _ in ends], color=color, height=0.7)
        axis.axvline(0.0, color=BLACK, lw=0.8)
        axis.set(title=title, xlabel="[mm]")
    axes[0].set_yticks(rows, [shown(name)[:30] for name, _ in drawn])
    axes[0].invert_yaxis()
    return figure
