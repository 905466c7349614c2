"""Fit the jaw in a face solver with the usual prior and with a jaw rig: python examples/03_face_solver.py [-o PNG]

A helmet camera sees noisy points of the chin and, once the mouth is open, the lower incisors. A face solver looks for
the jaw pose of every frame: an axis-angle turn about the jaw joint, as in FLAME and SMPL-X, and a translation. One
camera hardly shows depth, so a prior has to decide what the points leave open:

    neutral   the usual pull to the closed mouth, w_turn (lever * |axis-angle|)^2 + w_move |translation|^2
    turning   the same without a translation, as those models come
    rig       w * JawLayer.loss: squared distance to the person's own jaw model, and to its bounds
    d         the unknowns are the rig's parameters instead, with w * JawLayer.penalty: squared distance to its bounds

The person is synthetic (`jawusd.synthetic`: condyles on eminences, not the model's own form). Three performances of
hers are used: one with tracking noise to fit the rig, one to choose the weights of every prior on the same grid, by the
least error; and one, of other movements, to compare the priors. Nothing is shared between the three but the person.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import torch

from jawusd.evaluator import JawRig
from jawusd.fitting import fit_model
from jawusd.geometry import make_transform, transform_points
from jawusd.solvers import JawLayer, jaw_pose_from_axis_angle
from jawusd.synthetic.exercises import record
from jawusd.synthetic.person import Person

PERSON, FIT_SEED, TUNING_SEED, SCORING_SEED = 4, 1, 2, 3
FRAMES, STEP = 833, 8
CHIN = np.array([[0, -36, 1], [-11, -34, -3], [11, -34, -3], [0, -28, 3], [0, -41, -6]])  # from the incisal point [mm]
TEETH = np.array([[0, 0, 0], [-5, 0, -1], [5, 0, -1]])
EYE = np.array([45.0, -95.0, 260.0])  # helmet camera, from the incisal point: left, below, in front [mm]
FOCAL_PX, TEETH_SIGMA_PX, CHIN_SIGMA_PX = 1100.0, 1.0, 2.0
START_D = (5.0, 0.0, 0.0)  # where the search for d starts [mm]
SHUT_MM = 2.0  # opening below which a mouth counts as shut
SEEN_MM = 4.0  # opening from which the lower incisors are seen
LEVER_MM = 90.0  # from the jaw joint to the incisal point: makes turns and moves comparable
WEIGHTS = tuple(10.0 ** np.arange(-4.0, 3.0))  # of the priors' mm^2 against squared standard deviations of the points


@dataclass(frozen=True)
class Footage:
    """Hold what the camera saw and what was true.

    Attributes:
        pixels: shape (F, P, 2).
        weights: 1 / sigma^2, 0 where a point is not seen, shape (F, P) [1/px^2].
        T_true: T_skull_mandible, shape (F, 4, 4).
    """

    pixels: torch.Tensor
    weights: torch.Tensor
    T_true: np.ndarray


class Solver:
    """Find jaw poses from points in one camera."""

    def __init__(self, person: Person) -> None:
        self.person = person
        incisor = person.landmarks[0]
        self.points = torch.tensor(np.concatenate([TEETH, CHIN]) + incisor)
        forward = -EYE / np.linalg.norm(EYE)
        right = np.cross(forward, [0, 1, 0]) / np.linalg.norm(np.cross(forward, [0, 1, 0]))
        R = np.stack([right, np.cross(forward, right), forward])
        self.camera = torch.tensor(make_transform(R, -R @ (EYE + incisor)))
        self.joint = torch.tensor(person.landmarks[3:].mean(0))

    def project(self, T: torch.Tensor) -> torch.Tensor:
        """Return the pixels of the points under poses (F, 4, 4), shape (F, P, 2)."""
        posed = self.camera @ T
        p = self.points @ posed[:, :3, :3].mT + posed[:, None, :3, 3]
        return FOCAL_PX * p[..., :2] / p[..., 2:]

    def film(self, seed: int, kind: str) -> Footage:
        """Record the person and add the noise of a landmark detector."""
        T = record(self.person, FRAMES, seed, kind).T_true[::STEP]
        rng = np.random.default_rng(seed)
        sigma = np.repeat([TEETH_SIGMA_PX, CHIN_SIGMA_PX], [len(TEETH), len(CHIN)])
        pixels = self.project(torch.tensor(T)).numpy()
        pixels = pixels + rng.normal(size=pixels.shape) * sigma[:, None]
        weights = np.tile(sigma**-2.0, (len(T), 1))
        closed = -self.person.incisor(T)[:, 1] < SEEN_MM
        weights[closed, : len(TEETH)] = 0.0
        return Footage(torch.tensor(pixels), torch.tensor(weights), T)

    def solve(self, footage: Footage, prior: Callable, slides: bool = True) -> torch.Tensor:
        """Return the poses of all frames, each by itself; the prior maps turn, move and pose to (F,) [mm^2]."""
        count = len(footage.pixels)
        turn = torch.zeros(count, 3, dtype=torch.float64, requires_grad=True)
        move = torch.zeros(count, 3, dtype=torch.float64, requires_grad=slides)
        unknowns = [turn, move] if slides else [turn]

        def pose() -> torch.Tensor:
            # Unknowns of one size, lever lengths and millimetres, make the search well scaled.
            same = torch.eye(4, dtype=torch.float64)
            return jaw_pose_from_axis_angle(
                turn / LEVER_MM, move, joint=self.joint, T_skull_model=same, T_rest=same, unit_mm=1.0
            )

        return self.search(footage, unknowns, pose, lambda T: prior(turn, move, T))

    def solve_parameters(self, footage: Footage, layer: JawLayer, weight: float) -> torch.Tensor:
        """Return the poses of all frames, with the rig's parameters as unknowns."""
        d = torch.tensor([START_D], dtype=torch.float64).repeat(len(footage.pixels), 1).requires_grad_()
        return self.search(footage, [d], lambda: layer(d), lambda T: weight * layer.penalty(d))

    def search(self, footage: Footage, unknowns: list[torch.Tensor], pose: Callable, prior: Callable) -> torch.Tensor:
        """Return the poses that minimise misses and prior (F,) over the unknowns."""
        search = torch.optim.LBFGS(
            unknowns, max_iter=300, history_size=30, tolerance_change=1e-12, line_search_fn="strong_wolfe"
        )

        def cost() -> torch.Tensor:
            search.zero_grad()
            T = pose()
            misses = (self.project(T) - footage.pixels).square().sum(-1) * footage.weights
            total = misses.sum() + prior(T).sum()
            total.backward()
            return total

        search.step(cost)
        return pose().detach()

    def error_mm(self, footage: Footage, T: torch.Tensor) -> np.ndarray:
        """Return the mean distance of points all over the mandible from where they truly were [mm], shape (F,)."""
        points = self.person.mandible_points
        away = transform_points(T.numpy(), points) - transform_points(footage.T_true, points)
        return np.linalg.norm(away, axis=-1).mean(-1)


def fitted_rig(person: Person) -> JawRig:
    """Fit a rig to a take of its own, as a tracker would deliver it."""
    take = record(person, FRAMES, FIT_SEED, "training")
    model = fit_model(
        (np.arange(FRAMES), take.T_noisy),
        T_anatomical_skull=make_transform(np.eye(3), -person.landmarks[0]),
        landmarks=person.landmarks,
        mandible_vertices=person.mandible_points,
    )
    return JawRig(model.arrays, model.meta)


def ways(solver: Solver, rig: JawRig) -> dict[str, list[Callable[[Footage], torch.Tensor]]]:
    """Return the ways to solve footage, by name of the prior, one for each choice of weights."""
    layer = JawLayer(rig)

    def neutral(footage: Footage, a: float, b: float) -> torch.Tensor:
        return solver.solve(footage, lambda turn, move, T: a * turn.square().sum(-1) + b * move.square().sum(-1))

    def turning(footage: Footage, a: float) -> torch.Tensor:
        return solver.solve(footage, lambda turn, move, T: a * turn.square().sum(-1), slides=False)

    def prior(footage: Footage, a: float) -> torch.Tensor:
        return solver.solve(footage, lambda turn, move, T: a * layer.loss(T))

    return {
        "neutral": [partial(neutral, a=a, b=b) for a, b in product(WEIGHTS, WEIGHTS)],
        "turning": [partial(turning, a=a) for a in WEIGHTS],
        "rig": [partial(prior, a=a) for a in WEIGHTS],
        "d": [partial(solver.solve_parameters, layer=layer, weight=a) for a in WEIGHTS],
    }


def main() -> None:
    """Choose weights, compare, print and plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=Path("face_solver.png"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    person = Person(PERSON)
    solver, rig = Solver(person), fitted_rig(person)
    tuning, scoring = solver.film(TUNING_SEED, "training"), solver.film(SCORING_SEED, "hidden")
    opening_mm = -person.incisor(scoring.T_true)[:, 1]
    shut = opening_mm < SHUT_MM
    errors = {}
    print(f"error of the mandible [mm]; shut: of the {shut.sum()} frames open by less than {SHUT_MM:g} mm")
    print(f"{'prior':<10}{'tried':>7}{'best':>6}{'tuning':>9}{'mean':>9}{'p95':>9}{'max':>9}{'shut':>9}{'time s':>9}")
    for name, choices in ways(solver, rig).items():
        tuned = [solver.error_mm(tuning, solve(tuning)).mean() for solve in choices]
        best = int(np.argmin(tuned))
        begin = time.process_time()
        T = choices[best](scoring)
        spent_s = time.process_time() - begin
        e = errors[name] = solver.error_mm(scoring, T)
        print(
            f"{name:<10}{len(choices):>7}{best:>6}{tuned[best]:9.2f}{e.mean():9.2f}{np.percentile(e, 95):9.2f}"
            f"{e.max():9.2f}{e[shut].mean():9.2f}{spent_s:9.2f}",
            flush=True,
        )
    print(f"rig / neutral: {errors['rig'].mean() / errors['neutral'].mean():.2f}")
    worse = errors["d"] > errors["neutral"]
    print(f"frames in which d is worse than neutral: {worse.mean():.0%}")
    plot(errors, opening_mm, options.out)


def plot(errors: dict[str, np.ndarray], opening_mm: np.ndarray, path: Path) -> None:
    """Draw the errors over the scored frames, the opening below."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.2), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    seconds = np.arange(len(opening_mm)) * STEP / 24.0
    labels = {"neutral": "pull to the closed mouth", "turning": "the same, turning only", "rig": "jaw rig"}
    colours = {"neutral": "#d55e00", "turning": "#999999", "rig": "#0072b2"}
    for name in labels:
        e = errors[name]
        above.plot(seconds, e, color=colours[name], label=f"{labels[name]}: {e.mean():.1f} mm")
    above.set_ylabel("error of the mandible [mm]")
    figure.legend(frameon=False, loc="outside upper center", ncols=3)
    above.set_ylim(bottom=0)
    below.fill_between(seconds, opening_mm, color="#bbbbbb")
    below.set(xlabel="time [s]", ylabel="opening [mm]")
    figure.savefig(path, dpi=110)
    print(path)


if __name__ == "__main__":
    main()
