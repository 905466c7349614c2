"""Turn tables of markers on head and jaw into poses of the jaw."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jawusd.errors import FormatError
from jawusd.formats.markers import RigidBody, read_body, read_markers
from jawusd.geometry import rigid_fits, se3_inverse
from jawusd.geometry.arrays import Array

BODIES = ("head", "jaw")

# Root mean square distance of a rigid body's markers from their places on it, beyond which a frame has no pose: a
# marker jumped or was taken for another. Of 6,400 fits to recorded speech and clench the largest is 0.18 mm; chance
# passes it once in 10 million where four markers have 0.3 mm of noise per axis (chi squared of six degrees of freedom).
_FARTHEST_MM = 1.0


def marker_poses(
    path: str | os.PathLike[str], rigid: Mapping[str, str], rest_frame: int | None = None, unit_mm: float = 1.0
) -> Array:
    """Return T_head_jaw (F, 4, 4) [mm] of a table of markers, NaN where a rigid body is out of sight.

    Args:
        path: the table, see `formats.markers.read_markers`.
        rigid: descriptions of the rigid bodies "head" and "jaw", see `formats.markers.read_body`; without a head the
            table is in coordinates of the head.
        rest_frame: where rigid bodies of which only the numbers are known have their shape and frame from.
        unit_mm: length of the table's and the rigid bodies' unit [mm].

    Raises:
        FormatError: a rigid body that is none of these, that is missing, or that the markers do not fit; no rest frame
            where one is needed, or one in which a marker is missing.
    """
    path = Path(path)
    unknown = sorted(set(rigid) - set(BODIES))
    if unknown or "jaw" not in rigid:
        named = ", ".join(rigid) or "none"
        raise FormatError(f"rigid bodies named: {named}; jaw is needed, head may be added.", path=path)
    points = read_markers(path) * unit_mm
    bodies = {name: read_body(description) for name, description in rigid.items()}
    moved = {name: _moved(name, body, points, rest_frame, unit_mm, path) for name, body in bodies.items()}
    return se3_inverse(moved["head"]) @ moved["jaw"] if "head" in moved else moved["jaw"]


def _moved(name: str, body: RigidBody, points: Array, rest_frame: int | None, unit_mm: float, path: Path) -> Array:
    """Return how a rigid body lies in the table's frame, (F, 4, 4)."""
    numbers = np.array(body.markers)
    if numbers.max() > points.shape[1]:
        raise FormatError(
            f"has {points.shape[1]} markers; the rigid body of the {name} names marker {numbers.max()}.", path=path
        )
    seen = points[:, numbers - 1]
    shape = _shape_at(rest_frame, seen, name, path) if body.points is None else body.points * unit_mm
    T, off_mm = rigid_fits(shape, seen)
    if not np.isfinite(off_mm).any():
        raise FormatError(f"no frame shows three markers of the {name} that do not lie on one line.", path=path)
    if np.nanmedian(off_mm) > _FARTHEST_MM:
        raise FormatError(
            f"its markers {', '.join(map(str, body.markers))} lie {np.nanmedian(off_mm):.3g} mm from their places on "
            f"the rigid body of the {name}, at most {_FARTHEST_MM:g} mm are allowed.",
            path=path,
            hint="Check --rigid: the numbers of the markers, their order, and the units of table and rigid body.",
        )
    T[off_mm > _FARTHEST_MM] = np.nan
    return T


def _shape_at(rest_frame: int | None, seen: Array, name: str, path: Path) -> Array:
    """Return where the markers of a rigid body are at the rest frame."""
    hint = "Name a frame (counted from 0) with the teeth in occlusion and all markers in sight with --rest-frame."
    if rest_frame is None:
        raise FormatError(f"the places of the markers of the {name} on their body are unknown.", path=path, hint=hint)
    if not 0 <= rest_frame < len(seen):
        raise FormatError(f"has no frame {rest_frame}; it has 0 to {len(seen) - 1}.", path=path)
    if not np.isfinite(seen[rest_frame]).all():
        raise FormatError(f"frame {rest_frame} does not show all markers of the {name}.", path=path, hint=hint)
    return seen[rest_frame]
