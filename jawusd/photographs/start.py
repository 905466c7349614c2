"""The first poses of photographs: views found by search, aligned coarsely, with rows slid along one another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from jawusd.base.arrays import Array
from jawusd.geometry import make_transform
from jawusd.photographs.contact import Contact
from jawusd.photographs.crowns import Crowns, split_teeth
from jawusd.photographs.drawing import Drawing
from jawusd.photographs.lens import PhotoPose
from jawusd.photographs.search import UsualBite, searched
from jawusd.photographs.solve import Aligner, Bite, Photo
from jawusd.tracking.contour.scan import Scan, thinned

_WIDTH_PX = 360  # of the pictures that candidates are aligned in
_FACES = 6000  # crown faces per row, enough for these pictures
_CANDIDATES, _FINALISTS = 20, 4  # of each handedness
# Gates of the steps [mm]: from a tooth off to half a tooth off; then with rows slid along one another.
_WIDE_GATES, _SLID_GATES = (4.0, 4.0, 3.5, 3.5, 3.0, 3.0, 2.5, 2.5), (3.0, 3.0, 2.5, 2.0, 2.0, 2.0)
# How far the lower row may be from a usual bite. All are looked at, the best few aligned.
_ASIDE_MM, _UP_MM, _AHEAD_MM = (-4.0, -2.0, 0.0, 2.0, 4.0), (-2.0, 0.0, 2.0), (-4.0, -2.0, 0.0, 2.0, 4.0)
_SLIDES = 4
_MISFIT_GATE_MM = 1.5


@dataclass(frozen=True, eq=False)
class Rows:
    """Hold both rows of teeth, fine and thin, standing as rows usually do."""

    usual: UsualBite
    fine: tuple[Crowns, Crowns]
    thin: tuple[Crowns, Crowns]

    @classmethod
    def of(cls, scans: Sequence[Scan], usual: UsualBite) -> Rows:
        """Split both scans into teeth."""
        fine, thin = (
            [split_teeth(scan, T, r) for r, (scan, T) in enumerate(zip(some, usual.frames, strict=True))]
            for some in (scans, [thinned(scan, _FACES) for scan in scans])
        )
        return cls(usual, (fine[0], fine[1]), (thin[0], thin[1]))


@dataclass(frozen=True, eq=False)
class Found:
    """Hold how one photograph begins."""

    misfit: float  # of its lines, see `Aligner.misfit` [-]
    other_misfit: float  # the same if the photograph had been mirrored the other way
    mirrored: bool
    bite: Bite  # of this photograph alone, at a reduced size
    rows: Rows


def find_first(drawing: Drawing, scans: Sequence[Scan], usual: Sequence[UsualBite], contact: Contact) -> Found:
    """Return the best start of a photograph of rows whose bite nobody knows, out of the usual bites."""
    tried = []
    for bite in usual:
        rows = Rows.of(scans, bite)
        found = _aligned_candidates(drawing, rows, rows.usual.T_upper_lower, _CANDIDATES)
        tried += [(misfit, mirrored, one, rows) for misfit, mirrored, one in found]
    tried.sort(key=lambda one: one[0])
    ends = []
    for _, mirrored, one, rows in _finalists(tried):
        aligner = Aligner(rows.thin, rows.usual.T_upper_lower, contact)
        for begin in _slid(one, rows, aligner):
            end = aligner.aligned(begin, _SLID_GATES)
            ends.append((_misfit(aligner, end), mirrored, end, rows))
    return _best(ends)


def _slid(bite: Bite, rows: Rows, aligner: Aligner) -> list[Bite]:
    """Return a photograph with the bites among slid ones that fit best as they are, and the one that it has."""
    axes = rows.usual.T_anatomical_upper[:3, :3]
    out = []
    for slide in product(_ASIDE_MM, _UP_MM, _AHEAD_MM):
        T_upper_lower = make_transform(np.eye(3), axes.T @ slide) @ rows.usual.T_upper_lower
        out.append(Bite(bite.photos, T_upper_lower, bite.gum_mm))
    return [bite, *sorted(out, key=lambda one: _misfit(aligner, one))[:_SLIDES]]


def _misfit(aligner: Aligner, bite: Bite) -> float:
    """Return the misfit of one photograph, both rows alike."""
    return float(aligner.misfit(bite, _MISFIT_GATE_MM).mean())


def find_next(drawing: Drawing, rows: Rows, T_upper_lower: Array, contact: Contact) -> Found:
    """Return the best start of a photograph of a bite that another photograph has given, roughly."""
    found = _aligned_candidates(drawing, rows, T_upper_lower, _CANDIDATES)
    aligner = Aligner(rows.thin, rows.usual.T_upper_lower, contact)
    ends = []
    for _, mirrored, one, _ in _finalists([(*entry, rows) for entry in found]):
        again = aligner.aligned(Bite(one.photos, T_upper_lower, one.gum_mm), _SLID_GATES)
        ends.append((_misfit(aligner, again), mirrored, again, rows))
    return _best(ends)


def _aligned_candidates(
    drawing: Drawing, rows: Rows, T_upper_lower: Array, count: int
) -> list[tuple[float, bool, Bite]]:
    """Return misfit, mirrored and poses of the most promising views after some steps, best first."""
    aligner = Aligner(rows.thin, rows.usual.T_upper_lower, None)
    factor = _WIDTH_PX / drawing.size_px[0]
    out = []
    for one in searched(drawing, rows.thin, rows.usual, T_upper_lower, count):
        lines = drawing.mirrored() if one.mirrored else drawing
        photo = Photo(lines, PhotoPose(one.T_cam_upper, one.focal_px, 0.0)).shrunk(factor)
        bite = aligner.aligned(Bite((photo,), T_upper_lower, np.zeros(2)), _WIDE_GATES)
        out.append((_misfit(aligner, bite), one.mirrored, bite))
    return sorted(out, key=lambda entry: entry[0])


def _finalists(tried: Sequence[tuple[float, bool, Bite, Rows]]) -> list[tuple[float, bool, Bite, Rows]]:
    """Return the best starts, some of each handedness, so that the other one is refused on its merits."""
    ordered = sorted(tried, key=lambda one: one[0])
    return [one for way in (False, True) for one in [o for o in ordered if o[1] is way][:_FINALISTS]]


def _best(ends: Sequence[tuple[float, bool, Bite, Rows]]) -> Found:
    misfit, mirrored, bite, rows = min(ends, key=lambda one: one[0])
    other = min((one[0] for one in ends if one[1] is not mirrored), default=1.0)
    return Found(misfit, other, mirrored, bite, rows)
