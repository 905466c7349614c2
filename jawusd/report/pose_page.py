"""Write a web page that poses and keys a rig without a server: meshes, sampled decoder and bound in one HTML file."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath
from jawusd.evaluator import JawRig
from jawusd.evaluator.contact import AUTHORED_MM, UNIT_MM, ContactField
from jawusd.evaluator.motions import motions_of_poses
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.mesh import DEEP, TOUCHING
from jawusd.formats.report import ReplayPart
from jawusd.geometry.se3 import se3_log, transform_points
from jawusd.report.replay import TRACED, encoded, framed, packed
from jawusd.report.templates import base64_text, rendered

if TYPE_CHECKING:
    from jawusd.meshes.contact import Teeth
    from jawusd.meshes.solid import DistanceGrid


_STEP_MM = 0.02  # quantisation step of stored distances
# Range of stored distances: from this much deeper than the closed bite, to this distance.
_DEEPER_MM, _FARTHEST_MM = 0.4, 0.6
_TIPS_MM = 8.0  # height of the crowns, from the tips of the teeth, on which contacts are painted


def contact_data(clearance: ContactField, teeth: Teeth) -> dict[str, object]:
    """Return the input of contacts.js, ready for JSON encoding; the teeth are in the anatomical frame, in occlusion."""
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
        "values": _deflated(np.round((np.clip(values, low, high) - low) / _STEP_MM).astype(np.uint8)),
    }


def _deflated(values: NDArray[np.uint8] | NDArray[np.int16]) -> str:
    """Return the bytes of an array, compressed by zlib, as base64 text."""
    return base64_text(zlib.compress(np.ascontiguousarray(values).tobytes(), 9))


_SCRIPTS = ("scene.js", "decoder.js", "contacts.js", "drag.js", "ghosts.js", "keys.js", "timeline.js", "pose.js")
_MOST_CAPTURED = 1000


@dataclass(frozen=True, eq=False)
class PosePage:
    """Contents of the page that poses a rig."""

    name: str  # name of the actor
    rig: JawRig
    parts: tuple[ReplayPart, ...]
    axes: tuple[Array, Array, Array]  # grid of the sampled decoder: increasing values of d1, d2 and d3 [mm]
    take: Array  # parameters of the take, frame by frame [mm], shape (F, 3); F = 0 without a take
    first: int  # first frame of the take
    fps: float  # frame rate of the take, and of keys
    ghosts: tuple[int, float]  # number of captured poses that are shown near a pose, and their least distance in d [mm]
    teeth: Teeth | None = None  # both arches, whose contacts are painted; None without contacts
    #: JPEG images as base64 text by camera, the frame of the first one, and the step to the next
    footage: Mapping[str, object] | None = None


def write_pose_page(path: AnyPath, page: PosePage) -> None:
    """Write the page to an HTML file, with text from the rig escaped; raises OutputError."""
    text = rendered("pose.html.j2", _SCRIPTS, name=page.name, data=pose_data(page), marks=(*TOUCHING, DEEP))
    write_text_atomic(path, text)


def pose_data(page: PosePage) -> dict[str, object]:
    """Return the input of pose.js, ready for JSON encoding.

    The table contains, for each grid point, the twist (omega [rad], v [mm]) of the motion relative to occlusion in the
    anatomical frame, and the margin [mm]; the take d and the margin of every frame [mm]; the ghosts d [mm].
    """
    rig = page.rig
    d = np.stack(np.meshgrid(*page.axes, indexing="ij"), axis=-1).reshape(-1, 3)
    twists = se3_log(motions_of_poses(rig.pose(d), rig.T_anatomical_skull, rig.T_rest))
    landmarks = transform_points(rig.T_anatomical_skull @ rig.T_rest, rig.landmarks)
    clearance = rig.contact
    captured = rig.captured_d[:: max(1, -(-len(rig.captured_d) // _MOST_CAPTURED))]
    return {
        "parts": [packed(part) for part in page.parts],
        "axes": [axis.round(6).tolist() for axis in page.axes],
        "table": encoded(np.column_stack([twists, rig.margin(d)]).astype("<f4")),
        "take": encoded(np.column_stack([page.take, rig.margin(page.take)]).astype("<f4")),
        "first": page.first,
        "fps": page.fps,
        "tolerance": rig.tolerance_mm,
        "traced": landmarks[list(TRACED)].round(3).tolist(),
        "ghosts": {"captured": encoded(captured.astype("<f4")), "count": page.ghosts[0], "apart": page.ghosts[1]},
        "contact": None if clearance is None or page.teeth is None else contact_data(clearance, page.teeth),
        "footage": page.footage,
        **framed(page.parts),
    }
