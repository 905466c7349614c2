"""How far the condyles of an estimated head lie from the true ones.

    python tests/benchmarks/head.py [--persons 50] [--frames 1500]

Places the condyles of synthetic persons from their dental scans alone, then from the scans and a take with tracking
noise, and prints the mean and the largest distance from the true centres. The first person of the population is 0.
"""

import argparse

import numpy as np

from jawusd.geometry import anatomical_frame, find_landmarks, transform_points
from jawusd.rig.placeholder import condyles_from_motion
from jawusd.synthetic.anatomy import build_anatomy
from jawusd.synthetic.exercises import record
from jawusd.synthetic.person import Person

SEED = 3


def condyle_errors_mm(seed: int, frames: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the errors of both condyles from scans alone and from the motion [mm]; None where that cannot tell."""
    person = Person(seed)
    anatomy = build_anatomy(person)
    upper, lower = (arch.mesh.vertices[arch.tooth != 0] for arch in (anatomy.upper, anatomy.lower))
    A = anatomical_frame(upper, lower)
    mean = transform_points(A, find_landmarks(lower, None, A)[3:])
    truth = transform_points(A, person.joint.condyles)
    found = condyles_from_motion(A @ record(person, frames, SEED).T_noisy @ np.linalg.inv(A), mean)
    return tuple(None if at is None else np.linalg.norm(at - truth, axis=1) for at in (mean, found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--persons", type=int, default=50)
    parser.add_argument("--frames", type=int, default=1500)
    args = parser.parse_args()
    both = [condyle_errors_mm(seed, args.frames) for seed in range(args.persons)]
    for name, errors in zip(("scans alone", "scans and motion"), zip(*both)):
        known = np.array([error for error in errors if error is not None])
        print(f"{name}: {len(known)} persons, mean {known.mean():.1f} mm, largest {known.max():.1f} mm", flush=True)


if __name__ == "__main__":
    main()
