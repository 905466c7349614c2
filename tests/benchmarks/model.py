"""Fit every jaw model to synthetic persons and score it on poses it has not seen: python tests/benchmarks/model.py

Five persons whose joints share nothing with the models: 833 training poses, 5,000 hidden poses of other exercises, both
with tracking noise. Errors are the largest distance of a mandible point per pose [mm]. Tables to stdout: the models
and, in the same run, methods of others, with the floor (projection onto the person's own manifold), the numbers stored
and processor seconds per fit; then the default model with fewer poses, other noise, gross outliers, no mandible mesh
and turned scan frames; then its bounds and single sliders against the person's truth.
"""

from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

import argparse  # noqa: E402
import sys  # noqa: E402
import time  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402
from model_peers import PEERS  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from possible_poses import PERSONS, PossiblePoses  # noqa: E402

from jawusd.evaluator import JawRig  # noqa: E402
from jawusd.fitting import FittingConfig, fit_model  # noqa: E402
from jawusd.fitting.data import SubjectAnatomy, TrainingData, select_poses  # noqa: E402
from jawusd.geometry import make_transform, random_rotation, se3_exp, transform_points  # noqa: E402
from jawusd.paper.model import fit_paper  # noqa: E402
from jawusd.synthetic.exercises import record  # noqa: E402

TRAINING, HIDDEN, SEED_TRAINING, SEED_HIDDEN = 833, 5000, 1, 2
SWEEPS = ((0, 0.0), (1, 0.0), (2, 0.0), (1, 15.0), (2, 15.0))  # axis, opening [mm]
ALL_SHOWN = np.ones(3, dtype=bool)
DECODER = ("path_", "glide_", "spline_", "curve")  # arrays that a model is decoded from


class Subject:
    """One person with a training take and hidden poses."""

    def __init__(self, seed: int, envelope: str = "box") -> None:
        self.person = PERSONS[envelope](seed)
        self.T_anatomical_skull = make_transform(np.eye(3), -self.person.landmarks[0])
        self.hidden = record(self.person, HIDDEN, SEED_HIDDEN, "hidden").T_noisy
        self.possible = PossiblePoses(self.person)
        self.floor = self.possible.nearest(self.hidden, bounded=False)[1]

    def take(self, frames: int = TRAINING, noise: float = 1.0) -> np.ndarray:
        """Return a training take."""
        return record(self.person, frames, SEED_TRAINING, noise_scale=noise).T_noisy

    def fit(self, T: np.ndarray, mesh: bool = True, **config):
        """Return the rig and header of a model, and the processor seconds it took."""
        start = time.process_time()
        model = fit_model(
            (np.arange(len(T)), T),
            T_anatomical_skull=self.T_anatomical_skull,
            landmarks=self.person.landmarks,
            mandible_vertices=self.person.mandible_points if mesh else None,
            config=FittingConfig(holdout_folds=0, **config),
        )
        return JawRig(model.arrays, model.meta), model, time.process_time() - start

    def training(self) -> tuple[SubjectAnatomy, TrainingData]:
        """Return the training take as fitting sees it."""
        anatomy = SubjectAnatomy.of(self.T_anatomical_skull, self.person.landmarks, self.person.mandible_points, None)
        return anatomy, select_poses(np.arange(TRAINING), self.take(), anatomy).data

    def error(self, rig: JawRig, T: np.ndarray) -> np.ndarray:
        """Return the largest distance per pose [mm] between poses and the nearest ones of the rig."""
        points = self.person.mandible_points
        near = rig.pose(rig.encode(T)[0])
        return np.linalg.norm(transform_points(near, points) - transform_points(T, points), axis=-1).max(1)


def row(label: str, *columns: np.ndarray) -> None:
    """Print mean/median/p95/max of pooled errors."""
    cells = [f"{e.mean():6.3f} {np.median(e):6.3f} {np.percentile(e, 95):6.3f} {e.max():6.2f}" for e in columns]
    print(f"{label:<52}" + "  | ".join(cells), flush=True)


def described(label: str, numbers: list[int], seconds: list[float]) -> str:
    """Return a row's label with the mean count of stored numbers and processor seconds."""
    return f"{label:<34}{np.mean(numbers):8.0f}{np.mean(seconds):8.1f}"


def models(subjects: list[Subject], starts: int) -> None:
    """Print the table of models and peers: training and hidden errors, numbers stored and seconds."""
    print(f"{'model':<34}{'numbers':>8}{'s':>8}  train: mean median p95 max         | hidden")
    row("floor", np.zeros(1), np.concatenate([s.floor for s in subjects]))
    for label, config in {
        "pca": {"method": "pca"},
        "additive": {"method": "additive"},
        "anchored": {"method": "anchored"},
        "paper": {"method": "paper", "starts": starts},
        "paper --literal": {"method": "paper", "literal": True, "starts": starts},
    }.items():
        train, hidden, numbers, seconds = [], [], [], []
        for subject in subjects:
            T = subject.take()
            rig, model, took = subject.fit(T, **config)
            train.append(subject.error(rig, T))
            hidden.append(subject.error(rig, subject.hidden))
            seconds.append(took)
            numbers.append(sum(array.size for name, array in model.arrays.items() if name.startswith(DECODER)))
        row(described(label, numbers, seconds), np.concatenate(train), np.concatenate(hidden))
    published(subjects, starts)
    peers(subjects)


def published(subjects: list[Subject], starts: int) -> None:
    """Print the literal model encoded by its networks, as the paper does, instead of projected."""
    train, hidden = [], []
    for subject in subjects:
        anatomy, data = subject.training()
        fit = fit_paper(data, ALL_SHOWN, True, starts, 0)
        for T, errors in ((subject.take(), train), (subject.hidden, hidden)):
            M = anatomy.motion(T)
            errors.append(data.metric.largest(fit.reconstruct_as_published(M), M))
    row("paper --literal, as published", np.concatenate(train), np.concatenate(hidden))


def peers(subjects: list[Subject]) -> None:
    """Print the same errors of methods of others."""
    for label, fit in PEERS.items():
        train, hidden, numbers, seconds = [], [], [], []
        for subject in subjects:
            anatomy, data = subject.training()
            start = time.process_time()
            peer = fit(data)
            seconds.append(time.process_time() - start)
            numbers.append(peer.numbers)
            for T, errors in ((subject.take(), train), (subject.hidden, hidden)):
                M = anatomy.motion(T)
                errors.append(data.metric.largest(peer.rebuild(M), M))
        row(described(label, numbers, seconds), np.concatenate(train), np.concatenate(hidden))


def robustness(subjects: list[Subject]) -> None:
    """Print hidden errors of the default model under less, worse and differently framed data."""
    print("\nanchored, hidden errors")
    cases = {f"{n} poses": lambda s, n=n: s.fit(s.take(n)) for n in (200, 400, 833, 1600)}
    cases |= {f"{x:g} x noise": lambda s, x=x: s.fit(s.take(noise=x)) for x in (0.0, 0.5, 2.0, 4.0)}
    cases |= {"3 % outliers": lambda s: s.fit(with_outliers(s)), "no mandible mesh": lambda s: s.fit(s.take(), False)}
    for label, fit in cases.items():
        row(label, np.concatenate([s.error(fit(s)[0], s.hidden) for s in subjects]))
    row("scan frames turned", np.concatenate([turned_error(s) for s in subjects]))


def with_outliers(subject: Subject) -> np.ndarray:
    """Return the take with 3 % of its poses off by about 1.5 degrees and 2 mm."""
    rng = np.random.default_rng(3)
    T = subject.take()
    struck = rng.choice(len(T), int(0.03 * len(T)), replace=False)
    about = make_transform(np.eye(3), subject.person.landmarks[0])
    blur = se3_exp(rng.normal(size=(len(struck), 6)) * [*[np.deg2rad(1.5)] * 3, 2.0, 2.0, 2.0])
    T[struck] = T[struck] @ about @ blur @ np.linalg.inv(about)
    return T


def turned_error(subject: Subject) -> np.ndarray:
    """Return hidden errors when upper and lower scan come in frames turned against each other."""
    rng = np.random.default_rng(4)
    upper, lower = (make_transform(random_rotation(rng), rng.normal(size=3) * 80) for _ in range(2))
    back = np.linalg.inv(lower)
    model = fit_model(
        (np.arange(TRAINING), upper @ subject.take() @ back),
        T_anatomical_skull=subject.T_anatomical_skull @ np.linalg.inv(upper),
        landmarks=transform_points(lower, subject.person.landmarks),
        mandible_vertices=transform_points(lower, subject.person.mandible_points),
        T_rest=upper @ back,
        config=FittingConfig(holdout_folds=0),
    )
    rig = JawRig(model.arrays, model.meta)
    T = upper @ subject.hidden @ back
    near = np.linalg.inv(upper) @ rig.pose(rig.encode(T)[0]) @ lower
    points = subject.person.mandible_points
    moved = transform_points(near, points) - transform_points(subject.hidden, points)
    return np.linalg.norm(moved, axis=-1).max(1)


def bounds(count: int) -> None:
    """Print false acceptance of the bounds at 10 % false rejection, and the validity of single sliders."""
    print("\nbounds: false acceptance at 10 % false rejection of hidden poses (as fitted: rejected, accepted falsely)")
    for envelope in ("box", "competing"):
        found = [one_bound(Subject(seed, envelope)) for seed in range(count)]
        mean = np.mean(found, axis=0)
        print(
            f"{envelope:<10} slice hull {mean[0]:.3f} (as fitted {mean[1]:.3f}, {mean[2]:.3f}); alpha shapes "
            f"{mean[3]:.3f} (as fitted {mean[4]:.3f}, {mean[5]:.3f}); valid single-slider poses {100 * mean[6]:.1f} %",
            flush=True,
        )


def one_bound(subject: Subject) -> list[float]:
    """Return the figures of one person's bounds."""
    rig, _, _ = subject.fit(subject.take())
    hidden = rig.encode(subject.hidden)[0]
    rng = np.random.default_rng(5)
    low, high = hidden.min(0) - 3, hidden.max(0) + 3
    tried = low + (high - low) * rng.random((3000, 3))
    truly = subject.possible.include(rig.pose(tried))
    figures = []
    for bound in ("slices", "polygons"):
        margin, of_hidden = rig.margin(tried, bound=bound), rig.margin(hidden, bound=bound)
        at_ten, as_fitted = margin > np.quantile(of_hidden, 0.1), margin > 0
        figures += [falsely_accepted(at_ten, truly), float((of_hidden < 0).mean()), falsely_accepted(as_fitted, truly)]
    sweep = []
    for axis, opening in SWEEPS:
        d = np.zeros((60, 3))
        d[:, 0] = opening
        d[:, axis] = np.linspace(*rig.d_range[axis], 60)
        sweep.append(d[rig.margin(d) > 0])
    return [*figures, float(subject.possible.include(rig.pose(np.concatenate(sweep))).mean())]


def falsely_accepted(accepted: np.ndarray, truly: np.ndarray) -> float:
    """Return the share of accepted poses that the person cannot take."""
    return float((accepted & ~truly).sum() / accepted.sum())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--persons", type=int, default=5)
    parser.add_argument("--starts", type=int, default=4, help="random starts of the paper's networks")
    parser.add_argument("--skip-models", action="store_true")
    parser.add_argument("--only-peers", action="store_true", help="the methods of others alone")
    options = parser.parse_args()
    people = [Subject(seed) for seed in range(options.persons)]
    if options.only_peers:
        peers(people)
        raise SystemExit
    if not options.skip_models:
        models(people, options.starts)
    robustness(people)
    bounds(options.persons)
