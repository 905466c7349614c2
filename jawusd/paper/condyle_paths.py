"""Paper Fig. 5: paths of the condyles as the jaw opens, for the first principal component and for the models."""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator.models import JawModelForm
from jawusd.fitting.data import SubjectAnatomy, TrainingData
from jawusd.formats.experiments import CondylePath, Distances, ParameterPath
from jawusd.formats.mesh import Mesh
from jawusd.geometry import se3_exp, se3_log, transform_point, transform_points

EXPERIMENT = "condyle path"
PRINCIPAL = "principal component 1"

_STEPS = 121
_SHOWN_OPENINGS = (0.0, 1 / 3, 2 / 3, 1.0)  # fractions of a path at which the outline of the condyle is drawn
_AROUND_MM = 24.0  # radius [mm] around the condyle's centre within which bone is drawn
_NEAR_CLOSED_MM = 5.0
_HABITUAL_MM = 1.5  # maximum |d2| and |d3| [mm] of captured poses that count as pure opening
_BESIDE_MM = 0.75  # maximum difference in z [mm] between a path point and the captured condyles that limit its height
_FEWEST_BESIDE = 3


def condyle_paths(
    data: TrainingData,
    models: dict[str, JawModelForm],
    widest_mm: float,
    mandible: Mesh | None,
    anatomy: SubjectAnatomy,
) -> list[CondylePath]:
    """Sweep the first principal component, then the opening d1 of each model up to `widest_mm`.

    The mandible (mandible frame) gives the outlines of the condyle; without it, no outlines are drawn.
    """
    sweeps = {PRINCIPAL: principal_opening(data)}
    d = np.zeros((_STEPS, 3))
    d[:, 0] = np.linspace(0.0, widest_mm, _STEPS)
    sweeps |= {name: model.motion(d) for name, model in models.items()}
    bone = None if mandible is None else Mesh(anatomy.at_rest(mandible.vertices), mandible.faces)
    return [_path(name, motion, data, bone) for name, motion in sweeps.items()]


def parameter_paths(data: TrainingData, models: dict[str, JawModelForm], captured: Array) -> tuple[ParameterPath, ...]:
    """Sweep the parameters of each model one at a time, from the closed bite over the captured range.

    `captured` has the parameters of the captured poses in the default model [mm], shape (N, 3).
    """
    found = []
    # The other parameters stay zero, so d2 and d3 sweep only the range captured with the teeth nearly closed.
    near = captured[captured[:, 0] < _NEAR_CLOSED_MM]
    for name, model in models.items():
        for axis in range(3):
            d = np.zeros((_STEPS, 3))
            shown = near if axis and len(near) else captured
            low, high = np.percentile(shown[:, axis], [0.5, 99.5])
            d[:, axis] = np.linspace(min(low, 0.0) if axis else 0.0, max(high, 0.0), _STEPS)
            points = transform_point(model.motion(d), data.landmarks[3])
            found.append(ParameterPath(name, axis, d[:, axis], points))
    return tuple(found)


def principal_opening(data: TrainingData) -> Array:
    """Return the motions log M = w p1 for w between the captured extremes, shape (K, 4, 4), from closed to open.

    p1 is the first principal component of the captured twists under the mandible metric. The twists are not centred, so
    that the sweep (w1 p1 in the paper) passes through the closed bite like those of the models.
    """
    root = data.metric.twist_root()
    points = se3_log(data.motion) @ root * np.sqrt(data.weights)[:, None]
    first = np.linalg.svd(points, full_matrices=False)[2][0]
    scores = se3_log(data.motion) @ root @ first
    if np.median(scores) < 0:
        first, scores = -first, -scores
    weights = np.linspace(min(np.percentile(scores, 0.5), 0.0), np.percentile(scores, 99.5), _STEPS)
    return se3_exp(weights[:, None] * np.linalg.solve(root.T, first))


def _path(name: str, motion: Array, data: TrainingData, bone: Mesh | None) -> CondylePath:
    points = np.stack([transform_point(motion, centre) for centre in data.landmarks[3:]])
    opening = -(transform_point(motion, data.incisor) - data.incisor)[:, 1]
    heads = []
    if bone is not None:
        around = np.linalg.norm(bone.vertices - data.landmarks[3], axis=1) < 2 * _AROUND_MM
        near = Mesh(bone.vertices, bone.faces[around[bone.faces].all(axis=1)])
        for share in _SHOWN_OPENINGS:
            k = round(share * (len(motion) - 1))
            moved = Mesh(transform_points(motion[k], near.vertices), near.faces)
            heads.append(sagittal_section(moved, points[0, k], _AROUND_MM))
    return CondylePath(name, opening, points, tuple(heads))


def sagittal_section(mesh: Mesh, centre: Array, around_mm: float) -> Array:
    """Cut a mesh (anatomical frame) with the plane x = centre[0], within `around_mm` of the centre (3,) [mm].

    Returns:
        Segments of the cut, end points (z, y) [mm], shape (S, 2, 2).
    """
    side = mesh.vertices[:, 0] > centre[0]
    cut = mesh.vertices[mesh.faces[side[mesh.faces].sum(axis=1) % 3 > 0]]
    if not len(cut):
        return np.empty((0, 2, 2))
    height = cut[:, :, 0] - centre[0]
    above = height > 0
    # One of the three corners of a cut face is alone on its side of the plane; the cut connects points on this corner's
    # edges.
    alone = np.where(above.sum(1) == 1, above.argmax(1), (~above).argmax(1))
    rows = np.arange(len(cut))
    ends = []
    for other in (1, 2):
        far = (alone + other) % 3
        share = height[rows, alone] / (height[rows, alone] - height[rows, far])
        ends.append(cut[rows, alone] + share[:, None] * (cut[rows, far] - cut[rows, alone]))
    segments = np.stack(ends, axis=1)[:, :, [2, 1]]
    return segments[np.all(np.abs(segments - centre[[2, 1]]) < around_mm, axis=(1, 2))]


def path_distances(paths: list[CondylePath], captured: Array, d: Array) -> list[Distances]:
    """Measure the paths against the captured condyles (2, N, 3) [mm], whose d in the default model are (N, 3) [mm].

    Returns:
        For each path, the distances of its points from the nearest captured condyle centre during pure opening, and
        their heights above the highest captured condyle centre nearby; positive heights are anatomically impossible.
    """
    habitual = captured[:, np.all(np.abs(d[:, 1:]) < _HABITUAL_MM, axis=1)]
    found = []
    for path in paths:
        above = np.concatenate([_above(path.points[side], captured[side]) for side in (0, 1)])
        found.append(Distances(EXPERIMENT, path.model, "above every captured condyle", above))
        if habitual.shape[1]:
            away = np.linalg.norm(path.points[:, :, None] - habitual[:, None], axis=-1).min(2).ravel()
            found.append(Distances(EXPERIMENT, path.model, "from the captured opening path", away))
    return found


def _above(path: Array, captured: Array) -> Array:
    """Return how far [mm] path points (K, 3) lie above the highest of the captured points (N, 3) near their z, or 0."""
    beside = np.abs(path[:, None, 2] - captured[None, :, 2]) < _BESIDE_MM
    highest = np.where(beside, captured[None, :, 1], -np.inf).max(1)
    known = beside.sum(1) >= _FEWEST_BESIDE
    return np.maximum(path[known, 1] - highest[known], 0.0)
