"""Models of jaw motion with one, two or three parameters: ours, and those of others, each fitted to the same poses.

A model is fitted to training data and returns how it rebuilds motions with a number of parameters: by its nearest
motion, where the code is not told by the motion itself (PCA, Gaussian process, autoencoder).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import model_peers
import numpy as np

from jawusd.base.errors import FittingError
from jawusd.evaluator.encoding import vector_images
from jawusd.fitting import FittingConfig
from jawusd.fitting.checks import shown_parameters
from jawusd.fitting.data import TrainingData, displacement
from jawusd.fitting.fit import FORMS
from jawusd.fitting.metric import MandibleMetric
from jawusd.geometry import make_transform, se3_exp, se3_log, so3_exp, so3_log
from jawusd.paper.model import fit_paper
from jawusd.paper.nlpca import Nlpca

Array = np.ndarray
Rebuild = Callable[[Array], Array]
Fitted = Callable[[Array, int], Array]  # of motions (N, 4, 4) and the number of parameters
Model = Callable[[TrainingData], Fitted]

FREE = {1: ((0,),), 2: ((0, 1), (0, 2)), 3: ((0, 1, 2),)}  # parameters left free, d1 to d3; the better pair is taken
# Poses that are learned from: a Gaussian process takes the cube of their number; networks learn for seconds a part.
MOST_GP, MOST_NET = 300, 200
MOST_CHOICE = 300  # poses that decide which parameters are left free
NETS: dict[bytes, dict[int, Nlpca]] = {}  # of the paper, by the poses they learned from: both forms share them
STEPS, NUDGE = 8, 1e-4  # of Gauss-Newton, and of its differences [mm]
FOLDS = 5


@dataclass(frozen=True)
class Entry:
    """Hold a model, and from how many poses of a take it learns at most."""

    model: Model
    most: int | None = None


def hold_out(data: TrainingData, entry: Entry) -> Array:
    """Return the rms errors [mm] of every pose with 1, 2, 3 parameters (3, N), contiguous fifths left out in turn."""
    fold = np.arange(len(data)) * FOLDS // len(data)
    errors = np.empty((3, len(data)))
    for k in range(FOLDS):
        seen = data.select(fold != k)
        unseen, fitted = data.motion[fold == k], entry.model(seen if entry.most is None else thinned(seen, entry.most))
        for parameters in FREE:
            errors[parameters - 1, fold == k] = data.metric.rms(fitted(unseen, parameters), unseen)
    return errors


def thinned(data: TrainingData, most: int) -> TrainingData:
    """Return at most so many poses, evenly spread over the take."""
    chosen = np.zeros(len(data), dtype=bool)
    chosen[np.linspace(0, len(data) - 1, min(most, len(data))).astype(int)] = True
    return data.select(chosen)


def nearest(
    decode: Callable[[Array], Array], metric: MandibleMetric, M: Array, d: Array, free: tuple[int, ...]
) -> Array:
    """Return the motions of a decoder nearest to M (N, 4, 4) by Gauss-Newton on some of its parameters d (N, k)."""

    def off(d: Array) -> Array:
        T = decode(d)
        images = [vector_images(each[:, :3, :3], each[:, :3, 3], metric.vectors) for each in (T, M)]
        return (images[0] - images[1]).reshape(len(M), -1)

    for _ in range(STEPS):
        r = off(d)
        J = np.stack([(off(d + NUDGE * np.eye(d.shape[1])[i]) - r) / NUDGE for i in free], axis=-1)
        H = np.swapaxes(J, 1, 2) @ J + 1e-12 * np.eye(len(free))
        tried = d.copy()
        tried[:, free] -= np.linalg.solve(H, np.swapaxes(J, 1, 2) @ r[..., None])[..., 0]
        better = np.linalg.norm(off(tried), axis=1) < np.linalg.norm(r, axis=1)
        d = np.where(better[:, None], tried, d)
    return decode(d)


def ours(method: str, **config: object) -> Model:
    """Return a model of jawusd; with fewer parameters the others stay 0."""

    def fit(data: TrainingData) -> Fitted:
        shown = np.ones(3, dtype=bool) if method == "paper" else shown_parameters(data)[0]
        nets = NETS.setdefault(data.motion.tobytes(), {}) if method == "paper" else None
        chosen = FittingConfig(method=method, starts=1, **config)
        if method == "paper":
            form = fit_paper(data, shown, chosen.literal, 1, chosen.seed, nets)
        else:
            form = FORMS[method](data, shown, chosen)

        def rebuilt(M: Array, free: tuple[int, ...]) -> Array:
            d, T = data.metric.nearest(form.model, M)
            start = d * np.isin(range(3), free)
            return T if len(free) == 3 else nearest(form.model.motion, data.metric, M, start, free)

        few = thinned(data, MOST_CHOICE).motion

        def error(free: tuple[int, ...]) -> float:
            return float((data.metric.rms(rebuilt(few, free), few) ** 2).mean())

        return lambda M, parameters: rebuilt(M, min(FREE[parameters], key=error))

    return fit


def on_twists(fit: Callable[[Array, int], Rebuild]) -> Model:
    """Return a model of twists in metric coordinates (N, 6), whose distances are rms displacements of the jaw."""

    def of_motions(data: TrainingData) -> Fitted:
        root = data.metric.twist_root()
        points = se3_log(data.motion) @ root

        def rebuilt(M: Array, parameters: int) -> Array:
            return se3_exp(np.linalg.solve(root.T, fit(points, parameters)(se3_log(M) @ root).T).T)

        return rebuilt

    return of_motions


def components(points: Array, count: int) -> tuple[Array, Array]:
    """Return mean (6,) and principal directions (count, 6) of points (N, 6)."""
    mean = points.mean(axis=0)
    return mean, np.linalg.svd(points - mean, full_matrices=False)[2][:count]


def pca(points: Array, parameters: int) -> Rebuild:
    """Principal components."""
    mean, axes = components(points, parameters)
    return lambda x: (x - mean) @ axes.T @ axes + mean


def gp_decoder(points: Array, parameters: int) -> Rebuild:
    """A Gaussian process from principal components to all coordinates."""
    mean, axes = components(points, parameters)
    predict = model_peers.gaussian_process((points - mean) @ axes.T, points)
    return lambda x: predict((x - mean) @ axes.T)


def autoencoder(points: Array, parameters: int) -> Rebuild:
    """A plain autoencoder 6-8-k-8-6 with tanh units, trained by L-BFGS from one start."""
    return model_peers.autoencoder(points, parameters, starts=1)[0]


def hinge(data: TrainingData) -> Fitted:
    """Rotation about one fixed joint, as FLAME's jaw; with fewer parameters about fixed axes through it."""
    R, t = data.motion[:, :3, :3], data.motion[:, :3, 3]
    # R c + t = place for all poses: linear in the joint c and its place
    columns = np.concatenate([R, np.broadcast_to(-np.eye(3), R.shape)], axis=2).reshape(-1, 6)
    joint, place = np.split(np.linalg.lstsq(columns, -t.ravel(), rcond=None)[0], 2)

    def turned(M: Array) -> Array:
        return so3_log(data.metric.best_rotation(M, joint, np.broadcast_to(place, (len(M), 3))))

    seen = turned(data.motion)

    def rebuild(M: Array, parameters: int) -> Array:
        mean, axes = components(seen, parameters)
        rotation = so3_exp((turned(M) - mean) @ axes.T @ axes + mean)
        return make_transform(rotation, place - rotation @ joint)

    return rebuild


def linear_blends(data: TrainingData) -> Fitted:
    """Joint values that are linear in controls, as RigLogic has them: open, forward, back, left, right of the incisor.

    The joint lies between the condyles; its translation and rotation vector are regressed on the controls, which are
    the parts of either sign of the incisal displacement.
    """
    joint = data.landmarks[3:].mean(axis=0)
    values = np.concatenate([displacement(data.motion, joint), so3_log(data.motion[:, :3, :3])], axis=1)

    def rebuild(M: Array, parameters: int) -> Array:
        order = (1, 2, 0)[:parameters]  # down, forward, to the side

        def controls(u: Array) -> Array:
            return np.concatenate([np.maximum(u[:, order], 0), np.minimum(u[:, order], 0)], axis=1)

        weights = np.linalg.lstsq(controls(data.displacement()), values, rcond=None)[0]

        def decode(u: Array) -> Array:
            value = controls(u) @ weights
            R = so3_exp(value[:, 3:])
            return make_transform(R, value[:, :3] + joint - R @ joint)

        return nearest(decode, data.metric, M, displacement(M, data.incisor), order)

    return rebuild


MODELS: dict[str, Entry] = {
    "anchored (jawusd)": Entry(ours("anchored")),
    "additive (jawusd)": Entry(ours("additive")),
    "paper (Yang et al. 2019)": Entry(ours("paper"), MOST_NET),
    "paper, literal": Entry(ours("paper", literal=True), MOST_NET),
    "PCA of twists": Entry(on_twists(pca)),
    "PCA codes + GP": Entry(on_twists(gp_decoder), MOST_GP),
    "autoencoder 6-8-k-8-6": Entry(on_twists(autoencoder), MOST_NET),
    "hinge alone (FLAME's jaw)": Entry(hinge),
    "linear blends (RigLogic's form)": Entry(linear_blends),
}


def errors_or_reason(data: TrainingData, entry: Entry) -> Array | str:
    """Return the hold-out errors (3, N) [mm] of a model, or why it cannot be fitted."""
    try:
        return hold_out(data, entry)
    except FittingError as error:
        return error.message
