"""Jaws in 3-D pages: the replay of a report, and the page that poses and keys a rig without a server."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath
from jawusd.evaluator import JawRig
from jawusd.evaluator.contact import AUTHORED_MM, UNIT_MM, ContactField
from jawusd.evaluator.motions import motions_of_poses
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.keys import DEFAULT_FPS
from jawusd.formats.mesh import DEEP, TOUCHING
from jawusd.formats.report import ReplayPart, ReportData
from jawusd.formats.tracks import LOST, PARTIAL, RECOVERED, Tracks
from jawusd.geometry.se3 import se3_log, transform_points
from jawusd.report.templates import base64_text, rendered

if TYPE_CHECKING:
    from jawusd.meshes.contact import Teeth
    from jawusd.meshes.solid import DistanceGrid

#: Names of the tracking states of frames.
STATES = ("tracked", "recovered after a loss", "tracked without a camera", "lost", "regularised by the model")
#: Landmarks whose paths are drawn: the lower incisal point and both condyles.
TRACED = (0, 3, 4)
_MOST_FRAMES = 6000  # maximum number of frames; longer takes are subsampled


def replay_data(data: ReportData) -> dict[str, object] | None:
    """Return the input of replay.js, ready for JSON encoding; None without meshes or frames.

    Poses are motions relative to occlusion in the anatomical frame, as row-major 3 x 4 matrices. Mesh
    vertices are quantised to 16 bits over the bounding box.
    """
    tracks, model = data.tracks, data.model
    if not data.parts or not len(tracks.frames):
        return None
    step = -(-len(tracks.frames) // _MOST_FRAMES)
    rows = np.arange(0, len(tracks.frames), step)
    d = _parameters_at(tracks.frames[rows], data)
    fitted = np.full((len(rows), 4, 4), np.nan)
    known = np.all(np.isfinite(d), axis=1)
    rig, margin = JawRig(model.arrays, model.meta), np.full(len(rows), np.nan)
    fitted[known], margin[known] = rig.pose(d[known]), rig.margin(d[known])
    A, rest = rig.T_anatomical_skull, rig.T_rest
    return {
        **_scene(rig, data.parts),
        "captured": _poses(motions_of_poses(tracks.T_upper_lower[rows], A, rest)),
        "fitted": _poses(motions_of_poses(fitted, A, rest)),
        "d": encoded(d.astype("<f4")),
        "margin": encoded(margin.astype("<f4")),
        "frames": encoded(tracks.frames[rows].astype("<i4")),
        "state": encoded(_states(tracks)[rows]),
        "states": list(STATES),
        "fps": float(data.model.notes.get("fps") or DEFAULT_FPS) / step,
    }


def _parameters_at(frames: NDArray[np.int64], data: ReportData) -> Array:
    """Return the jaw parameters of frames [mm], shape (F, 3); NaN where the model has no parameters."""
    rows = {int(frame): row for row, frame in enumerate(data.model.frames)}
    missing = np.full(3, np.nan)
    return np.array([data.model.d[rows[int(f)]] if int(f) in rows else missing for f in frames])


def _states(tracks: Tracks) -> NDArray[np.uint8]:
    state = np.zeros(len(tracks.frames), np.uint8)
    for value, code in ((RECOVERED, 1), (PARTIAL, 2), (LOST, 3)):
        state[np.any(tracks.status == value, axis=1)] = code
    state[tracks.prior_aided & (state != 3)] = 4
    return state


def _poses(motion: Array) -> str:
    return encoded(motion[:, :3].reshape(len(motion), 12).astype("<f4"))


def packed(part: ReplayPart) -> dict[str, object]:
    """Return a mesh for scene.js, its vertices quantised to 16 bits over the bounding box.

    Raises ValueError if the mesh has more vertices than 16 bits can number.
    """
    mesh = part.mesh
    if len(mesh.vertices) > np.iinfo(np.uint16).max:
        raise ValueError(f"a mesh of the replay has {len(mesh.vertices)} vertices; the limit is 65535")
    low = mesh.vertices.min(0)
    step = float(np.ptp(mesh.vertices, axis=0).max()) / np.iinfo(np.uint16).max or 1.0
    vertices = np.round((mesh.vertices - low) / step).astype("<u2")
    arrays = {"vertices": encoded(vertices), "faces": encoded(mesh.faces.astype("<u2"))}
    return {"name": part.name, "kind": part.kind, "moves": part.moves, "low": low.tolist(), "step": step, **arrays}


def encoded(values: ArrayLike) -> str:
    """Return the bytes of an array as base64 text."""
    return base64_text(np.ascontiguousarray(values).tobytes())


def _scene(rig: JawRig, parts: Sequence[ReplayPart]) -> dict[str, object]:
    """Return what both pages show: meshes, tolerance and traced landmarks [mm], and where the camera is aimed."""
    landmarks = transform_points(rig.T_anatomical_skull @ rig.T_rest, rig.landmarks)
    jaw = [part.mesh.vertices for part in parts if part.name != "skull"] or [parts[0].mesh.vertices]
    low, high = np.concatenate(jaw).min(0), np.concatenate(jaw).max(0)
    return {
        "parts": [packed(part) for part in parts],
        "tolerance": rig.tolerance_mm,
        "traced": landmarks[list(TRACED)].round(3).tolist(),
        "centre": (0.5 * (low + high)).round(2).tolist(),
        "radius": round(float(np.linalg.norm(high - low)) / 2, 2),
    }


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
    clearance = rig.contact
    captured = rig.captured_d[:: max(1, -(-len(rig.captured_d) // _MOST_CAPTURED))]
    return {
        **_scene(rig, page.parts),
        "axes": [axis.round(6).tolist() for axis in page.axes],
        "table": encoded(np.column_stack([twists, rig.margin(d)]).astype("<f4")),
        "take": encoded(np.column_stack([page.take, rig.margin(page.take)]).astype("<f4")),
        "first": page.first,
        "fps": page.fps,
        "ghosts": {"captured": encoded(captured.astype("<f4")), "count": page.ghosts[0], "apart": page.ghosts[1]},
        "contact": None if clearance is None or page.teeth is None else contact_data(clearance, page.teeth),
        "footage": page.footage,
    }
