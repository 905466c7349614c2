"""The experiments of Yang et al. (2019) for any take: paper Figs. 5, 12 and 13, and coverage of the envelope.

Fig. 13 compares random poses of a model within its bounds with the captured poses.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import FittingError
from jawusd.evaluator.bounds import PolygonBound, SliceHull
from jawusd.evaluator.encoding import vector_images
from jawusd.fitting.bounds import PLANES, fit_bounds
from jawusd.fitting.checks import FAR_MM, bound_not_reached, missing_movements, shown_parameters
from jawusd.fitting.data import FittedForm, Source, SubjectAnatomy, TrainingData, select
from jawusd.fitting.fit import FORMS, FittingConfig, Progress, one_blas_thread
from jawusd.fitting.metric import MandibleMetric
from jawusd.formats.experiments import Coverage, Distances, Experiments
from jawusd.formats.mesh import Mesh
from jawusd.geometry import se3_exp, se3_log, transform_point, transform_points
from jawusd.paper.condyle_paths import condyle_paths, parameter_paths, path_distances, sagittal_section
from jawusd.paper.model import COMPONENTS, PaperFit, fit_paper

if TYPE_CHECKING:
    from jawusd.paper.nlpca import Nlpca

POSES = 1000
BOX, POLYGONS, SLICES = "static: box", "dynamic: two polygons", "dynamic: slice hull"

# Size and number of batches; bounds that fill less than 0.5 % of their box give fewer than `POSES` poses.
_BATCH, _BATCHES = 4000, 50


@dataclass(frozen=True, eq=False)
class Bounds:
    """Bounds of one model's parameters."""

    box: Array  # captured range of each parameter [mm], shape (3, 2)
    polygons: PolygonBound  # alpha shapes as in the paper
    rings: tuple[tuple[Array, ...], tuple[Array, ...]]  # rings of `polygons` in (d1, d2) and (d1, d3) [mm], each (n, 2)
    slices: SliceHull  # the slice hull
    slices_box: Array  # bounding box of the slice hull [mm], shape (3, 2)

    @classmethod
    def of(cls, d: Array, alpha: float) -> Bounds:
        """Build the bounds of captured parameters d (N, 3) [mm]; `alpha` as in `FittingConfig`."""
        arrays, box = fit_bounds(d, alpha), np.stack([d.min(0), d.max(0)], axis=1)
        lateral, protrusive = (tuple(np.split(arrays[name], arrays[f"{name}_counts"].cumsum()[:-1])) for name in PLANES)
        return cls(box, PolygonBound(arrays), (lateral, protrusive), SliceHull(arrays), arrays["d_range"])

    def draw(self, rng: np.random.Generator) -> dict[str, Array]:
        """Return up to `POSES` uniformly distributed parameters (n, 3) [mm] within each bound, keyed by its name."""
        return {
            BOX: _spread(self.box, lambda d: np.full(len(d), -1.0), rng),
            POLYGONS: _spread(self.box, self.polygons.signed_distance, rng),
            SLICES: _spread(self.slices_box, self.slices.signed_distance, rng),
        }


def _spread(box: Array, excess: Callable[[Array], Array], rng: np.random.Generator) -> Array:
    kept = np.empty((0, 3))
    for _ in range(_BATCHES):
        d = box[:, 0] + rng.random((_BATCH, 3)) * (box[:, 1] - box[:, 0])
        kept = np.concatenate([kept, d[excess(d) <= 0]])
        if len(kept) >= POSES:
            break
    return kept[:POSES]


def distance_to_nearest(metric: MandibleMetric, motion: Array, captured: Array) -> Array:
    """Return the largest vertex distance (n,) [mm] of motions (n, 4, 4) to the nearest captured motion (N, 4, 4)."""
    # The rms distance is Euclidean in these columns and never exceeds the largest vertex distance, so only captured
    # poses whose rms distance is below the best largest distance so far can be nearer.
    at, places = _columns(metric, motion), _columns(metric, captured)
    tree = cKDTree(places)
    guess = tree.query(at)[1]
    best = metric.largest(motion, captured[guess])
    for row, found in enumerate(tree.query_ball_point(at, best)):
        near = captured[found]
        near = near[metric.largest_at_least(motion[row], near) <= best[row]]
        best[row] = metric.largest(motion[row], near).min(initial=best[row])
    return best


def captured_reference(metric: MandibleMetric, captured: Array, folds: int) -> Array:
    """Return the distance [mm] of each captured motion (N, 4, 4) to the nearest motion in another part of the take.

    The motions are in temporal order; the take is split into `folds` contiguous parts.
    """
    fold = np.arange(len(captured)) * folds // len(captured)
    parts = [distance_to_nearest(metric, captured[fold == k], captured[fold != k]) for k in range(folds)]
    return np.concatenate(parts)


def _columns(metric: MandibleMetric, motion: Array) -> Array:
    return vector_images(motion[:, :3, :3], motion[:, :3, 3], metric.vectors).reshape(len(motion), -1)


#: Configurations of the compared models, by label.
MODELS: dict[str, FittingConfig] = {
    "paper, literal": FittingConfig(method="paper", literal=True),
    "paper": FittingConfig(method="paper"),
    "additive": FittingConfig(method="additive"),
    "anchored": FittingConfig(method="anchored"),
    "pca": FittingConfig(method="pca"),
}
DEFAULT, LINEAR = "anchored", "pca"
#: Models that fit within seconds, for `quick`.
QUICK = ("additive", DEFAULT, LINEAR)
RECONSTRUCTION, SYNTHESIS = "reconstruction", "synthesis"

_LARGEST = "largest vertex distance"
_OPENING_QUANTILE = 0.995  # quantile of d1 at which the sweep of Fig. 5 ends; below 1 to ignore single frames
_SKULL_AROUND_MM = 30.0
_GRID_MM = 0.5
_SLICES = 60


@dataclass(frozen=True)
class _Fitted:
    """The models of one take, and the captured poses encoded with each."""

    forms: dict[str, FittedForm]
    d: dict[str, Array]
    nearest: dict[str, Array]
    notes: tuple[str, ...]


@one_blas_thread
def run_experiments(
    source: Source,
    anatomy: SubjectAnatomy,
    *,
    bones: Mapping[str, Mesh] | None = None,
    config: FittingConfig = FittingConfig(),  # noqa: B008 - frozen
    actor: str = "",
    quick: bool = False,
    progress: Progress | None = None,
) -> Experiments:
    """Run the paper's experiments on a take.

    Args:
        source: tracks, whose raw poses without a prior are used, or frame numbers and poses.
        bones: meshes "mandible" and "skull" for outlines, scan frame [mm]; either may be missing.
        config: starts and seed of the networks, trimming, alpha, folds; `method` is ignored.
        quick: whether to skip the networks and the paper's model, and to draw random poses of the default model only.

    Returns:
        The results. Models that cannot be fitted to the take are omitted and listed in `notes`.

    Raises:
        FittingError: there are too few poses, or there is no motion.
    """
    wanted = QUICK if quick else tuple(MODELS)
    notify, steps = progress or (lambda done, total: None), len(wanted) + (0 if quick else COMPONENTS)
    data, bones = select(source, anatomy).data, bones or {}
    shown, sentences = shown_parameters(data)
    fitted = _fit_all(data, shown, wanted, config, lambda done: notify(done, steps))
    nets = [] if quick else _networks(data, config, fitted.forms.get("paper"), lambda d: notify(len(wanted) + d, steps))
    captured = np.stack([transform_point(data.motion, centre) for centre in data.landmarks[3:]])
    d, kept = fitted.d[DEFAULT], fitted.d[DEFAULT][fitted.forms[DEFAULT].kept]
    swept = {name: fitted.forms[name].model for name in ("paper", DEFAULT) if name in fitted.forms}
    widest = float(np.quantile(kept[:, 0], _OPENING_QUANTILE))
    paths = condyle_paths(data, swept, widest, bones.get("mandible"), anatomy)
    drawn = (DEFAULT,) if quick else tuple(fitted.d)
    bounds = {name: Bounds.of(fitted.d[name][fitted.forms[name].kept], config.alpha) for name in drawn}
    distances = path_distances(paths, captured, d)
    distances += _reconstruction(data, fitted, nets) + _synthesis(data, fitted, bounds, config)
    compared = {name: fitted.forms[name].model for name in (LINEAR, DEFAULT) if name in fitted.forms}
    notify(steps, steps)
    skull = np.empty((0, 2, 2))
    if "skull" in bones:
        placed = Mesh(transform_points(anatomy.T_anatomical_skull, bones["skull"].vertices), bones["skull"].faces)
        skull = sagittal_section(placed, data.landmarks[3], _SKULL_AROUND_MM)
    lacking = (*sentences, *missing_movements(kept, shown))
    return Experiments(
        actor=actor,
        frames=len(data),
        captured_condyles=captured,
        skull=skull,
        condyle_paths=tuple(paths),
        distances=tuple(distances),
        coverage=_coverage(kept, bounds[DEFAULT], lacking),
        notes=fitted.notes,
        parameter_paths=parameter_paths(data, compared, kept),
    )


def _fit_all(
    data: TrainingData, shown: Mask, wanted: tuple[str, ...], config: FittingConfig, notify: Callable[[int], None]
) -> _Fitted:
    forms: dict[str, FittedForm] = {}
    parameters: dict[str, Array] = {}
    nearest: dict[str, Array] = {}
    nets: dict[int, Nlpca] = {}
    notes = []
    for step, name in enumerate(wanted):
        notify(step)
        start = time.perf_counter()
        try:
            chosen = replace(config, method=MODELS[name].method, literal=MODELS[name].literal)
            if chosen.method == "paper":  # both variants of the paper's model share their networks
                form: FittedForm = fit_paper(data, shown, chosen.literal, chosen.starts, chosen.seed, nets)
            else:
                form = FORMS[chosen.method](data, shown, chosen)
        except FittingError as error:
            if name == DEFAULT:
                raise
            notes.append(f"{name}: {error}")
            continue
        seconds = time.perf_counter() - start
        d, motion = data.metric.nearest(form.model, data.motion)
        usable = np.all(np.isfinite(d), axis=1)
        if not usable[form.kept].all():
            notes.append(f"{name}: {int((~usable[form.kept]).sum())} poses cannot be encoded.")
            if name == DEFAULT:
                raise FittingError(notes[-1], hint="Check the units of the poses.")
            continue
        forms[name], parameters[name], nearest[name] = form, d, motion
        notes.append(f"{name}: fitted in {seconds:.1f} s; {int((~form.kept).sum())} frames discarded as outliers.")
    return _Fitted(forms, parameters, nearest, tuple(notes))


def _networks(
    data: TrainingData, config: FittingConfig, paper: FittedForm | None, notify: Callable[[int], None]
) -> list[Nlpca]:
    """Return networks with 1 to 5 components; the last network is taken from the paper's model if it was fitted."""
    from jawusd.paper.nlpca import train_nlpca  # imported late, since it imports torch

    points = se3_log(data.motion) @ data.metric.twist_root()
    nets = []
    for count in range(1, COMPONENTS + 1):
        notify(count - 1)
        if count == COMPONENTS and isinstance(paper, PaperFit):
            nets.append(paper.network_sum.net)
        else:
            nets.append(train_nlpca(points, count, config.seed))
    notify(COMPONENTS)
    return nets


def _reconstruction(data: TrainingData, fitted: _Fitted, nets: list[Nlpca]) -> list[Distances]:
    """Return the errors of paper Fig. 12: reconstruction of all captured poses, trimmed ones included, by model."""
    root = data.metric.twist_root()
    points = se3_log(data.motion) @ root
    rebuilt = {
        f"NLPCA {net.components}": se3_exp(np.linalg.solve(root.T, net.decode(net.encode(points)).T).T) for net in nets
    }
    for name, form in fitted.forms.items():
        if isinstance(form, PaperFit):
            rebuilt[f"{name}, as published"] = form.reconstruct_as_published(data.motion)
    rebuilt |= fitted.nearest
    found = []
    for name, motion in rebuilt.items():
        known = np.all(np.isfinite(motion), axis=(1, 2))  # the encoding of gross outliers may not converge
        errors = data.metric.largest(motion[known], data.motion[known])
        found.append(Distances(RECONSTRUCTION, name, _LARGEST, errors))
    return found


def _synthesis(
    data: TrainingData, fitted: _Fitted, bounds: dict[str, Bounds], config: FittingConfig
) -> list[Distances]:
    """Return the distances of paper Fig. 13, from random poses of each model to the nearest captured pose."""
    folds = max(config.holdout_folds, 2)
    reference = captured_reference(data.metric, data.motion, folds)
    found = [Distances(SYNTHESIS, "captured hold-out poses", f"{folds} contiguous parts", reference)]
    for name in bounds:
        form = fitted.forms[name]
        for bound, d in bounds[name].draw(np.random.default_rng(config.seed)).items():
            if len(d):
                distance = distance_to_nearest(data.metric, form.model.motion(d), data.motion)
                found.append(Distances(SYNTHESIS, name, bound, distance))
    return found


def _coverage(d: Array, bounds: Bounds, sentences: tuple[str, ...]) -> Coverage:
    low, high = bounds.slices_box[0]
    openings = np.linspace(low, high, _SLICES)
    at = np.zeros((_SLICES, 3))
    at[:, 0] = openings
    slices = np.stack([np.stack(bounds.slices.chord(at, axis), axis=1) for axis in (1, 2)])
    (lateral, lateral_share), (forward, forward_share) = (_gaps(d, bounds, axis) for axis in (1, 2))
    gaps, shares = (lateral, forward), (lateral_share, forward_share)
    return Coverage(d, bounds.rings, openings, slices, gaps, (*sentences, *bound_not_reached(gaps, shares)))


def _gaps(d: Array, bounds: Bounds, axis: int) -> tuple[Array, float]:
    """Return the points (d1, d_axis) of the slice hull that are far from all captured poses, and their fraction."""
    first, second = (np.arange(low, high, _GRID_MM) for low, high in bounds.slices_box[[0, axis]])
    grid = np.zeros((len(first) * len(second), 3))
    grid[:, 0], grid[:, axis] = (part.ravel() for part in np.meshgrid(first, second))
    grid = grid[bounds.slices.signed_distance(grid) <= 0][:, [0, axis]]
    scale = FAR_MM[[0, axis]]
    far = np.array([((((d[:, [0, axis]] - point) / scale) ** 2).sum(1) > 1).all() for point in grid], dtype=bool)
    return grid[far], float(far.mean()) if len(far) else 0.0
