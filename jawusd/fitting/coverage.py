"""Which parameters the captured poses move, and which parts of the envelope are missing."""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.fitting.data import TrainingData
from jawusd.fitting.gauge_fit import SMALLEST_OPENING_MM, fit_path

PARAMETERS = ("opening", "laterotrusion", "protrusion")

# Ranges below which a take should be repeated: smaller than those of nearly all adults (Hirsch 2006, Zawawi 2003)
_SMALL_OPENING_MM, _SMALL_LATERAL_MM, _SMALL_PROTRUSION_MM = 30.0, 5.0, 4.0
_WIDE, _FEW_WIDE_FRAMES = 0.85, 10  # share of the largest opening that counts as wide open
_HALF_OPEN = (0.25, 0.65)
_HALF_OPEN_SHARE = 0.35  # of the range with closed teeth that should be reached half open
# Directions of (laterotrusion, protrusion) that frames should reach half open, to this share of the closed range
_SECTORS, _SECTOR_REACH, _FEWEST_SECTORS = 8, 0.25, 6

#: A place of the bound farther than this from all captured poses lies in a gap [mm].
FAR_MM = np.array([3.0, 2.0, 2.0])
# Share of the bound in gaps that is worth recording. Of 14 synthetic persons' takes of 1,200 frames that wander through
# the whole envelope at most 0.5 % lie in gaps, without half open frames at least 20 %; of takes of 833 frames of
# exercises, none of which gets this advice, 0.4 to 10.8 %.
_MOST_GAPS = 0.15

# Ranges (1 to 99 %) below which a parameter is noise or habit, not an exercise [mm]
_SMALLEST_RANGE_MM = np.array([SMALLEST_OPENING_MM, 3.0, 2.5])


def shown_parameters(data: TrainingData) -> tuple[Mask, list[str]]:
    """Return which of opening, laterotrusion and protrusion the poses exercise, (3,), and a sentence for each other."""
    u = data.displacement()
    gx, gz, _, _ = fit_path(u, data.weights).path(-u[:, 1])
    side, front = u[:, 0] - gx, u[:, 2] - gz
    if _range(side) >= _SMALLEST_RANGE_MM[1]:
        # A lateral excursion moves the jaw forward too; only motion beyond that shows protrusion.
        arch = np.stack([np.abs(side), side, side**2], axis=-1)
        front = front - arch @ np.linalg.lstsq(arch, front, rcond=None)[0]
    spread = np.array([_range(values) for values in (-u[:, 1], side, front)])
    shown = spread >= _SMALLEST_RANGE_MM
    sentences = [
        f"The poses do not show {name}: it varies by {spread[i]:.1f} mm (at least {_SMALLEST_RANGE_MM[i]:g} mm are "
        f"needed), so its slider only shifts the jaw within that range without learned rotation."
        for i, name in enumerate(PARAMETERS)
        if not shown[i]
    ]
    return shown, sentences


def _range(values: Array) -> float:
    return float(np.percentile(values, 99) - np.percentile(values, 1))


def missing_movements(d: Array, shown: Mask) -> list[str]:
    """Return a sentence for each movement that a take lacks, with what to record.

    Args:
        d: parameters of the captured poses [mm], shape (N, 3).
        shown: which parameters the data show, shape (3,); the others have their own sentences.
    """
    widest = float(d[:, 0].max())
    found = []
    if shown[0]:
        if widest < _SMALL_OPENING_MM:
            found.append(f"The widest opening is {widest:.0f} mm: record opening as wide as possible, three times.")
        wide = int((d[:, 0] > _WIDE * widest).sum())
        if wide < _FEW_WIDE_FRAMES:
            found.append(f"Only {wide} frames are near full opening: hold the widest opening for a second.")
    for name, side in (("left", d[:, 1]), ("right", -d[:, 1])):
        if shown[1] and side.max() < _SMALL_LATERAL_MM:
            found.append(f"The jaw moves {max(side.max(), 0.0):.1f} mm to the {name}: record a full slide that way.")
    if shown[2] and d[:, 2].max() < _SMALL_PROTRUSION_MM:
        found.append(f"The jaw moves {max(d[:, 2].max(), 0.0):.1f} mm forward: record a full protrusion.")
    return found + (_missing_half_open(d) if shown.all() else [])


def bound_not_reached(gaps: tuple[Array, Array], shares: tuple[float, float]) -> list[str]:
    """Return a sentence for each plane in which much of the bound lies far from every captured pose.

    Args:
        gaps: places (d1, d2) and (d1, d3) in gaps [mm], each (G, 2).
        shares: of all places of the bound in that plane.
    """
    found = []
    for name, far, places, share in zip(PARAMETERS[1:], FAR_MM[1:], gaps, shares, strict=True):
        if share > _MOST_GAPS:
            low, high = places[:, 0].min(), places[:, 0].max()
            found.append(
                f"{100 * share:.0f} % of the bound of opening and {name} has no captured pose within {FAR_MM[0]:g} and "
                f"{far:g} mm: record slow circling at {low:.0f} to {high:.0f} mm of opening."
            )
    return found


def _missing_half_open(d: Array) -> list[str]:
    """Return sentences for what is missing between a quarter and two thirds of the opening."""
    low, high = (share * d[:, 0].max() for share in _HALF_OPEN)
    half = d[(d[:, 0] > low) & (d[:, 0] < high), 1:]
    where = f"between {low:.0f} and {high:.0f} mm of opening"
    if not len(half):
        return [f"There are no frames {where}: record opening and closing slowly."]
    reach = np.stack([d[:, 1].max(), -d[:, 1].min(), d[:, 2].max()])
    reached = np.stack([half[:, 0].max(), -half[:, 0].min(), half[:, 1].max()])
    names = ("slide to the left", "slide to the right", "protrusion")
    found = [
        f"There is no {name} {where}: record it with the mouth half open."
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
