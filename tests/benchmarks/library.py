"""Make rigs from landmarks alone, leaving one person out: python tests/benchmarks/library.py [--persons 12]

Synthetic persons, whose joints share nothing with the models and are drawn without regard to the landmarks. Each is
captured (833 noisy poses) and fitted; then each in turn gets a rig from its five landmarks and the other persons' rigs,
and is compared with its own captured poses, mean vertex distance per pose [mm] over 42 points of the mandible:

* "shares": the person's own rig reads d off each captured pose, as shares of that person's ranges; the same shares pose
  the other rig. What animation sees: ranges and shape of the motion count.
* "nearest": the pose of the other rig nearest to each captured pose (`encode`). What tracking and validation see.

Beside it: the person's own rig (the floor: noise, and what three parameters do not explain); the rig of the person
with the most similar landmarks, laid upon the landmarks rigidly; one fixed person of no library, scaled by similarity.
Then the error that the rig itself expected, the share of captured poses it calls valid, the same with landmarks picked
1 mm wrong, smaller libraries, and motions retargeted between all pairs.
"""

from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

import argparse  # noqa: E402

import numpy as np  # noqa: E402
from scipy.signal import find_peaks  # noqa: E402

from jawusd.evaluator import JawRig  # noqa: E402
from jawusd.fitting import FittingConfig, fit_model  # noqa: E402
from jawusd.geometry import landmark_frame, make_transform, rigid_fit, transform_points  # noqa: E402
from jawusd.library.personal import Donor, Learned, landmark_distance_mm, leave_one_out, personal_motion  # noqa: E402  # noqa: E402
from jawusd.pipeline.library import fit_personal, retarget  # noqa: E402
from jawusd.pipeline.subject import Subject  # noqa: E402
from jawusd.synthetic.exercises import record  # noqa: E402
from jawusd.synthetic.person import Person  # noqa: E402

FRAMES, TAKE, GENERIC_SEED = 833, 1, 1000
PICKING_SD_MM = 1.0
PROMINENCE_MM = 2.0


class Captured:
    """One person with a take and a rig fitted to it."""

    def __init__(self, seed: int) -> None:
        self.person = Person(seed)
        take = record(self.person, FRAMES, TAKE)
        self.poses = take.T_noisy
        model = fit_model(
            (np.arange(FRAMES), self.poses),
            T_anatomical_skull=make_transform(np.eye(3), -self.person.landmarks[0]),
            landmarks=self.person.landmarks,
            mandible_vertices=self.person.mandible_points,
            config=FittingConfig(holdout_folds=0),
        )
        self.donor = Donor(f"person {seed}", JawRig(model.arrays, model.meta))
        self.d = self.donor.rig.encode(self.poses)[0]
        self.shares = self.donor.rig.normalized(self.d)
        self.d_clean = self.donor.rig.encode(self.person.pose(*take.controls.T))[0]

    def error(self, poses: np.ndarray) -> np.ndarray:
        """Return the mean vertex distance of poses from the captured ones [mm], shape (FRAMES,)."""
        points = self.person.mandible_points
        return np.linalg.norm(transform_points(poses, points) - transform_points(self.poses, points), axis=-1).mean(1)

    def errors(self, rig: JawRig) -> tuple[np.ndarray, np.ndarray]:
        """Return the errors of a rig made for this person: at equal shares, and of the nearest poses [mm]."""
        return self.error(rig.pose(rig.denormalized(self.shares))), self.error(rig.pose(rig.encode(self.poses)[0]))

    def errors_of_other(self, other: Donor, scaled: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return the errors of another person's rig laid upon this one's landmarks, rigidly or by similarity [mm]."""
        here, there = self.donor.landmarks, other.landmarks
        B = rigid_fit(there, here)
        size = [np.sqrt(((x - x.mean(0)) ** 2).sum()) for x in (here, there)]
        scale = size[0] / size[1] if scaled else 1.0
        to_here = np.diag([scale, scale, scale, 1.0])
        to_here = B @ to_here
        to_here[:3, 3] = here.mean(0) - to_here[:3, :3] @ there.mean(0)
        back = np.linalg.inv(to_here)
        rig, rest = other.rig, other.rig.T_rest
        at_shares = rig.pose(rig.denormalized(self.shares))
        nearest = rig.pose(rig.encode(back @ self.poses @ to_here @ rest)[0])
        undo = np.linalg.inv(rest)
        return tuple(self.error(to_here @ T @ undo @ back) for T in (at_shares, nearest))

    def rig_from(self, donors: list[Donor], landmarks: np.ndarray, learned: Learned) -> JawRig:
        """Return the rig made from landmarks and other persons."""
        motion = personal_motion(donors, landmarks, learned)
        model = fit_personal(Subject("made", landmark_frame(landmarks), landmarks, {}), motion, lambda *_: None)
        return JawRig(model.arrays, model.meta)


def row(label: str, *columns: np.ndarray) -> None:
    """Print mean/median/p95/max of pooled errors."""
    cells = [f"{e.mean():6.3f} {np.median(e):6.3f} {np.percentile(e, 95):6.3f} {e.max():6.2f}" for e in columns]
    print(f"{label:<44}" + "  | ".join(cells), flush=True)


def tabulate(persons: list[Captured], generic: Donor) -> None:
    """Print the errors of the rigs made, and of the baselines, side by side."""
    rng = np.random.default_rng(0)
    found: dict[str, list] = {}
    means, expected, valid = [], [], []
    for i, person in enumerate(persons):
        others = [other.donor for other in persons[:i] + persons[i + 1 :]]
        target = person.donor.landmarks
        alike = min(others, key=lambda donor: landmark_distance_mm(donor.landmarks, target))
        learned, learned_closest = leave_one_out(others), leave_one_out(others, closest=True)
        promised = learned.summary()["mean"]
        rig = person.rig_from(others, target, learned)
        picked = target + rng.normal(scale=PICKING_SD_MM, size=target.shape)
        rows = {
            "own rig (floor)": person.errors(person.donor.rig),
            "landmarks, average": person.errors(rig),
            "landmarks, average, picked 1 mm wrong": person.errors(person.rig_from(others, picked, learned)),
            "landmarks, closest": person.errors(person.rig_from(others, target, learned_closest)),
            "nearest neighbour, rigidly": person.errors_of_other(alike, scaled=False),
            "generic, scaled": person.errors_of_other(generic, scaled=True),
        }
        for label, errors in rows.items():
            found.setdefault(label, []).append(errors)
        means.append(rows["landmarks, average"][0].mean())
        expected.append(promised)
        valid.append(rig.validate(person.poses).valid.mean())
        print(
            f"person {i}: {means[-1]:.3f} mm at equal shares, expected {promised:.3f}, valid {valid[-1]:.3f}",
            flush=True,
        )
    print(f"\n{'mean vertex error [mm]':<44}shares: mean median p95 max   | nearest: mean median p95 max")
    for label, parts in found.items():
        row(label, *(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    print(f"\nworst person {max(means):.3f} mm; expected {np.mean(expected):.3f} mm on average (landmarks)")
    print(f"captured poses that the rigs from landmarks call valid: {np.mean(valid):.3f} (least {min(valid):.3f})")


def sizes(persons: list[Captured]) -> None:
    """Print the errors at equal shares for smaller libraries."""
    print("\npersons in the library: mean error at equal shares [mm]")
    for count in (2, 4, 7, 11):
        if count >= len(persons):
            continue
        errors = []
        for i, person in enumerate(persons):
            others = [persons[(i + 1 + k) % len(persons)].donor for k in range(count)]
            rig = person.rig_from(others, person.donor.landmarks, leave_one_out(others))
            errors.append(person.error(rig.pose(rig.denormalized(person.shares))))
        print(f"  {count:2d}: {np.concatenate(errors).mean():.3f}", flush=True)


def retargeting(persons: list[Captured]) -> None:
    """Print validity and timing of every motion, as captured and without noise, carried to every other person."""
    for label, motions in (
        ("as captured", [person.d for person in persons]),
        ("without noise", [person.d_clean for person in persons]),
    ):
        frames, valid, outside, moved, off = np.arange(float(FRAMES)), [], [], [], {0: [], 1: [], 2: []}
        pairs = [(a, b) for a in range(len(persons)) for b in range(len(persons)) if a != b]
        for giver, taker in pairs:
            rig = persons[taker].donor.rig
            carried = retarget(persons[giver].donor.rig, rig, frames, motions[giver])
            valid.append(rig.validate(rig.pose(carried.d)).valid.mean())
            outside.append(carried.outside.mean())
            moved.append(carried.moved_mm)
            for axis, shifts in off.items():
                shifts.append(peak_shifts(motions[giver][:, axis], carried.d[:, axis]))
        print(
            f"\nmotions {label}, retargeted: {len(valid)}; valid frames {np.mean(valid):.4f} (least {min(valid):.4f})"
        )
        away = np.concatenate(moved)
        print(f"equal shares outside the bound: {np.mean(outside):.4f} of the frames; moved from equal shares [mm]:")
        print(f"  mean {away.mean():.4f}, p95 {np.percentile(away, 95):.3f}, max {away.max():.2f}")
        for axis, shifts in off.items():
            pooled = np.concatenate(shifts)
            same, one, two = ((pooled <= k).mean() for k in (0, 1, 2))
            print(f"peaks of d{axis + 1}: {len(pooled)}; same frame {same:.4f}, within 1 {one:.4f}, within 2 {two:.4f}")


def peak_shifts(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return by how many frames each prominent peak, up or down, of one curve is from the nearest peak of another."""
    shifts = []
    for sign in (1.0, -1.0):
        there = find_peaks(sign * b)[0]
        for peak in find_peaks(sign * a, prominence=PROMINENCE_MM)[0]:
            shifts.append(np.abs(there - peak).min() if len(there) else FRAMES)
    return np.array(shifts)


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--persons", type=int, default=12)
    parser.add_argument("--only", choices=("rigs", "sizes", "retarget"))
    arguments = parser.parse_args()
    persons = [Captured(seed) for seed in range(arguments.persons)]
    if arguments.only in (None, "rigs"):
        tabulate(persons, Captured(GENERIC_SEED).donor)
    if arguments.only in (None, "sizes"):
        sizes(persons)
    if arguments.only in (None, "retarget"):
        retargeting(persons)


if __name__ == "__main__":
    main()
