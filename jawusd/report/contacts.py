"""Data of the contacts that a page paints on the teeth: distances to the opposing arch, clearances and marks."""

from __future__ import annotations

import base64
import zlib
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jawusd.evaluator.contact import AUTHORED_MM, UNIT_MM, ContactField
from jawusd.formats.mesh import DEEP, TOUCHING

if TYPE_CHECKING:
    from jawusd.meshes.contact import Teeth
    from jawusd.meshes.solid import DistanceGrid

_STEP_MM = 0.02  # of stored distances
_DEEPER_MM, _FARTHEST_MM = 0.4, 0.6  # stored distances reach from this much below the closed bite to this
_TIPS_MM = 8.0  # height of the crowns, from the tips of the teeth, on which contacts are painted


def contact_data(clearance: ContactField, teeth: Teeth) -> dict[str, object]:
    """Return the input of contacts.js, ready for JSON encoding.

    Args:
        clearance: The clearance of the rig's teeth.
        teeth: Both arches as solids, in the anatomical frame in occlusion.
    """
    closed = clearance.closed_mm
    # If the scans have a gap in the closed bite, that gap counts as contact, as in images of contacts.
    limits = [DEEP.apart_mm - closed, *(mark.apart_mm - min(closed, 0.0) for mark in TOUCHING)]
    return {
        "fields": [_field(teeth.pair.upper.grid, 1, closed), _field(teeth.pair.lower.grid, -1, closed)],
        "marks": [[*mark.color, limit] for mark, limit in zip((DEEP, *TOUCHING), limits, strict=True)],
        "clearance": {
            "first": clearance.first_mm.tolist(),
            "step": clearance.step_mm.tolist(),
            "shape": list(clearance.values.shape),
            "values": _deflated(np.round(clearance.values / UNIT_MM).astype(np.int16)),
            "unit": UNIT_MM,
            "authored": -AUTHORED_MM - clearance.error_mm,
            "measured": clearance.limit_mm - clearance.error_mm,
        },
    }


def _field(grid: DistanceGrid, up: int, closed_mm: float) -> dict[str, object]:
    """Return the distances near the tips of an arch as bytes, and how to read them; `up` is 1 for the upper arch."""
    low, high = -max(closed_mm, 0.0) - _DEEPER_MM, _FARTHEST_MM
    near = np.argwhere((grid.values > low) & (grid.values < high))
    first, last = near.min(axis=0), near.max(axis=0)
    layers = round(_TIPS_MM / grid.step_mm)
    if up > 0:
        last[1] = min(last[1], first[1] + layers)
    else:
        first[1] = max(first[1], last[1] - layers)
    values = grid.values[tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))]
    return {
        "origin": (grid.origin + grid.step_mm * first).tolist(),
        "step": grid.step_mm,
        "shape": list(values.shape),
        "low": low,
        "unit": _STEP_MM,
        "values": _deflated(_steps(values, low, high)),
    }


def _steps(values: NDArray[np.float32], low: float, high: float) -> NDArray[np.uint8]:
    """Return values clipped to a range, in whole steps from its lower end."""
    return np.round((np.clip(values, low, high) - low) / _STEP_MM).astype(np.uint8)


def _deflated(values: NDArray[np.uint8] | NDArray[np.int16]) -> str:
    """Return the bytes of an array, compressed by zlib, as base64 text."""
    return base64.b64encode(zlib.compress(np.ascontiguousarray(values).tobytes(), 9)).decode("ascii")
