"""Data of the 3-D replay: decimated meshes and the poses of the take, encoded as text."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.evaluator.motions import motions_of_poses
from jawusd.formats.keys import DEFAULT_FPS
from jawusd.formats.report import ReplayPart, ReportData
from jawusd.formats.tracks import LOST, PARTIAL, RECOVERED, Tracks
from jawusd.geometry import transform_points
from jawusd.report.templates import base64_text

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
    A, rest = model.arrays["T_anatomical_skull"], model.arrays["T_rest"]
    landmarks = transform_points(A @ rest, model.arrays["landmarks"])
    return {
        "parts": [packed(part) for part in data.parts],
        "captured": _poses(motions_of_poses(tracks.T_upper_lower[rows], A, rest)),
        "fitted": _poses(motions_of_poses(fitted, A, rest)),
        "d": encoded(d.astype("<f4")),
        "margin": encoded(margin.astype("<f4")),
        "tolerance": rig.tolerance_mm,
        "frames": encoded(tracks.frames[rows].astype("<i4")),
        "state": encoded(_states(tracks)[rows]),
        "states": list(STATES),
        "fps": float(data.model.notes.get("fps") or DEFAULT_FPS) / step,
        **framed(data.parts),
        "traced": landmarks[list(TRACED)].round(3).tolist(),
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


def framed(parts: Sequence[ReplayPart]) -> dict[str, object]:
    """Return the centre and the radius [mm] of the jaw, without the skull: there, the virtual camera is aimed."""
    jaw = [part.mesh.vertices for part in parts if part.name != "skull"] or [parts[0].mesh.vertices]
    low, high = np.concatenate(jaw).min(0), np.concatenate(jaw).max(0)
    return {"centre": (0.5 * (low + high)).round(2).tolist(), "radius": round(float(np.linalg.norm(high - low)) / 2, 2)}
