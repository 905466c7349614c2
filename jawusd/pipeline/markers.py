"""Turn tables of markers on head and jaw into poses of the jaw."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jawusd.errors import FormatError
from jawusd.formats.markers import Plate, read_markers, read_plate
from jawusd.geometry import rigid_fits, se3_inverse
from jawusd.geometry.arrays import Array

PLATES = ("head", "jaw")

# Root mean square distance of a plate's markers from their places on it, beyond which a frame has no pose: a marker
# jumped or was taken for another. Of 6,400 plates of recorded speech and clench the largest is 0.18 mm; chance passes
# it once in 10 million where four markers have 0.3 mm of noise per axis (chi squared of six degrees of freedom).
_FARTHEST_MM = 1.0


def marker_poses(
    path: str | os.PathLike[str], rigid: Mapping[str, str], rest_frame: int | None = None, unit_mm: float = 1.0
) -> Array:
    """Return T_head_jaw (F, 4, 4) [mm] of a table of markers, NaN where a plate is out of sight.

    Args:
        path: the table, see `formats.markers.read_markers`.
        rigid: what is told of the plates "head" and "jaw", see `formats.markers.read_plate`; without a head the table
            is in coordinates of the head.
        rest_frame: where plates of which only the numbers are known have their shape and frame from.
        unit_mm: length of the table's and the plates' unit [mm].

    Raises:
        FormatError: a plate that is none of these, that is missing, or that the markers do not fit; no rest frame where
            one is needed, or one in which a marker is missing.
    """
    path = Path(path)
    unknown = sorted(set(rigid) - set(PLATES))
    if unknown or "jaw" not in rigid:
        told = ", ".join(rigid) or "none"
        raise FormatError(f"plates {told} were named; jaw is needed, head may be added.", path=path)
    points = read_markers(path) * unit_mm
    moved = {name: _moved(name, read_plate(told), points, rest_frame, unit_mm, path) for name, told in rigid.items()}
    return se3_inverse(moved["head"]) @ moved["jaw"] if "head" in moved else moved["jaw"]


def _moved(name: str, plate: Plate, points: Array, rest_frame: int | None, unit_mm: float, path: Path) -> Array:
    """Return how a plate lies in the table's frame, (F, 4, 4)."""
    numbers = np.array(plate.markers)
    if numbers.max() > points.shape[1]:
        raise FormatError(
            f"has {points.shape[1]} markers; the plate of the {name} names marker {numbers.max()}.", path=path
        )
    seen = points[:, numbers - 1]
    shape = _shape_at(rest_frame, seen, name, path) if plate.points is None else plate.points * unit_mm
    T, off_mm = rigid_fits(shape, seen)
    if not np.isfinite(off_mm).any():
        raise FormatError(f"no frame shows three markers of the {name} that do not lie on one line.", path=path)
    if np.nanmedian(off_mm) > _FARTHEST_MM:
        raise FormatError(
            f"its markers {', '.join(map(str, plate.markers))} lie {np.nanmedian(off_mm):.3g} mm from their places on "
            f"the plate of the {name}, at most {_FARTHEST_MM:g} mm are allowed.",
            path=path,
            hint="Check --rigid: the numbers of the markers, their order, and the units of table and plate.",
        )
    T[off_mm > _FARTHEST_MM] = np.nan
    return T


def _shape_at(rest_frame: int | None, seen: Array, name: str, path: Path) -> Array:
    """Return where the markers of a plate are at the rest frame."""
    hint = "Name a frame (counted from 0) with the teeth in occlusion and all markers in sight with --rest-frame."
    if rest_frame is None:
        raise FormatError(f"nothing tells where the markers of the {name} lie on their plate.", path=path, hint=hint)
    if not 0 <= rest_frame < len(seen):
        raise FormatError(f"has no frame {rest_frame}; it has 0 to {len(seen) - 1}.", path=path)
    if not np.isfinite(seen[rest_frame]).all():
        raise FormatError(f"frame {rest_frame} does not show all markers of the {name}.", path=path, hint=hint)
    return seen[rest_frame]
