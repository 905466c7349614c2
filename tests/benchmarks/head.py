"""Distances of the condyles of estimated heads from the true ones, and their effect on the motion.

    python tests/benchmarks/head.py [--persons 50] [--frames 1500] [--fits 8]

Places the condyles of synthetic subjects from their dental scans alone, then from the scans and a take with tracking
noise, and prints the mean and the largest distance from the true centres. For the first subjects, a model is fitted
with the true and with the estimated condyles; the program prints how far apart the incisal points of the encoded take
are. The first subject of the population is 0.
"""

import argparse

import numpy as np

from jawusd.evaluator import JawRig
from jawusd.fitting import FittingConfig, fit_model
from jawusd.geometry import anatomical_frame, find_landmarks, make_transform, transform_points
from jawusd.rig.placeholder import condyles_from_motion
from jawusd.synthetic.anatomy import build_anatomy
from jawusd.synthetic.exercises import record
from jawusd.synthetic.person import Person

SEED = 3
CONDYLE_MM = 15.0  # points of the mandible nearer than this to a condyle's centre move with it
FITTED_EVERY = 4  # every so many frames are used to fit a model


def placed_condyles(seed: int, frames: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Return both condyles from scans alone and from the motion [mm], shape (2, 3) each; None if that is unknown."""
    person = Person(seed)
    anatomy = build_anatomy(person)
    upper, lower = (arch.mesh.vertices[arch.tooth != 0] for arch in (anatomy.upper, anatomy.lower))
    A = anatomical_frame(upper, lower)
    mean = transform_points(A, find_landmarks(lower, None, A)[3:])
    found = condyles_from_motion(A @ record(person, frames, SEED).T_noisy @ np.linalg.inv(A), mean)
    return tuple(None if at is None else transform_points(np.linalg.inv(A), at) for at in (mean, found))


def condyle_errors_mm(seed: int, frames: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the errors of both condyles from scans alone and from the motion [mm]; None if that is unknown."""
    truth = Person(seed).joint.condyles
    return tuple(None if at is None else np.linalg.norm(at - truth, axis=1) for at in placed_condyles(seed, frames))


def incisal_difference_mm(seed: int, frames: int) -> np.ndarray:
    """Return how far the incisal points of a take are apart with true and with estimated condyles [mm], shape (F,).

    Empty if the take does not show how the condyles slide.
    """
    person = Person(seed)
    estimated, points = person.landmarks.copy(), person.mandible_points.copy()
    found = placed_condyles(seed, frames)[1]
    if found is None:
        return np.zeros(0)
    estimated[3:], T = found, record(person, frames, SEED).T_noisy[::FITTED_EVERY]
    for true, moved in zip(person.landmarks[3:], estimated[3:]):
        points[np.linalg.norm(points - true, axis=1) < CONDYLE_MM] += moved - true
    places = []
    for landmarks, vertices in ((person.landmarks, person.mandible_points), (estimated, points)):
        axes = make_transform(np.eye(3), -landmarks[0])
        config = FittingConfig(holdout_folds=0)
        model = fit_model(
            (np.arange(len(T)), T),
            T_anatomical_skull=axes,
            landmarks=landmarks,
            mandible_vertices=vertices,
            config=config,
        )
        rig = JawRig(model.arrays, model.meta)
        places.append(transform_points(rig.pose(rig.encode(T).d), person.landmarks[:1])[:, 0])
    return np.linalg.norm(places[0] - places[1], axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--persons", type=int, default=50)
    parser.add_argument("--frames", type=int, default=1500)
    parser.add_argument("--fits", type=int, default=8, help="number of subjects with fitted models")
    args = parser.parse_args()
    both = [condyle_errors_mm(seed, args.frames) for seed in range(args.persons)]
    for name, errors in zip(("scans alone", "scans and motion"), zip(*both)):
        known = np.array([error for error in errors if error is not None])
        print(f"{name}: {len(known)} subjects, mean {known.mean():.1f} mm, largest {known.max():.1f} mm", flush=True)
    apart = [each for seed in range(args.fits) if len(each := incisal_difference_mm(seed, args.frames))]
    means, largest = [each.mean() for each in apart], max(each.max() for each in apart)
    print(f"incisal points apart: {len(apart)} subjects, mean {np.mean(means):.3f} mm, largest {largest:.3f} mm")


if __name__ == "__main__":
    main()
