"""Hold the jaw model against every bar that is no error table: python tests/benchmarks/model_stress.py

For five synthetic persons: does d come back from its pose, how evenly do the parameters move the jaw, is every slider
position within the bounds one the person can take, how honest is the predicted uncertainty, and how well the networks
of the paper train. With --capture, a recorded capture with truth: the model on true poses with tracking noise and, with
--tracks, on tracked poses; whole parts of the take and whole kinds of exercises left out. All errors are the largest
distance of a mandible point per pose [mm].
"""

from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

import argparse  # noqa: E402
from collections.abc import Callable  # noqa: E402
from functools import partial  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402
from model import SEED_TRAINING, TRAINING, Subject, row  # noqa: E402

from jawusd.evaluator import JawRig  # noqa: E402
from jawusd.fitting import FittingConfig, fit_model  # noqa: E402
from jawusd.fitting.anchored import fit_anchored  # noqa: E402
from jawusd.fitting.data import (  # noqa: E402
    FittedForm,
    SubjectAnatomy,
    TrainingData,
    select_poses,
    select_tracks,
)
from jawusd.formats.capture import load_capture  # noqa: E402
from jawusd.formats.tracks import load_tracks  # noqa: E402
from jawusd.geometry import make_transform, se3_exp, se3_log, so3_exp, transform_point  # noqa: E402
from jawusd.paper.model import fit_paper  # noqa: E402
from jawusd.paper.nlpca import train_nlpca  # noqa: E402
from jawusd.pipeline.subject import load_meshes, subject_of_capture  # noqa: E402
from jawusd.synthetic.exercises import record  # noqa: E402

ALL_SHOWN = np.ones(3, dtype=bool)
SWEPT_OPENINGS_MM = (0.0, 5.0, 10.0, 15.0, 25.0, 35.0)
STEP_MM = 0.1
NOISE_MM, NOISE_RAD = 0.12, np.deg2rad(0.08)  # of tracking, at the middle of the lower dental arch
BELOW_INCISOR = np.array([0.0, -3.0, -20.0])  # that middle [mm]
Fit = Callable[[TrainingData], FittedForm]


def anchored(data: TrainingData) -> FittedForm:
    """Fit the default model."""
    return fit_anchored(data, ALL_SHOWN, FittingConfig().trim_mad)


def persons(count: int) -> None:
    """Print a line per person and envelope."""
    print(
        "person            round trip  condition  sliders: valid  off by  sd: within 2 sd, least landmark  "
        "verdicts: own poses accepted"
    )
    for envelope in ("box", "competing"):
        for seed in range(count):
            one_person(seed, envelope)


def one_person(seed: int, envelope: str) -> None:
    """Print a line."""
    subject = Subject(seed, envelope)
    T = subject.take()
    model = fit_model(
        (np.arange(len(T)), T),
        T_anatomical_skull=subject.T_anatomical_skull,
        landmarks=subject.person.landmarks,
        mandible_vertices=subject.person.mandible_points,
    )
    rig = JawRig(model.arrays, model.meta)
    d = inside(rig)
    back = np.abs(rig.encode(rig.pose(d))[0] - d).max()
    moved = np.stack([rig.point_jacobian(d, point) for point in subject.person.mandible_points], axis=1)
    values = np.linalg.svd(moved.reshape(len(d), -1, 3), compute_uv=False)
    swept = sweeps(rig)
    off = subject.possible.nearest(rig.pose(swept))[1]
    within = covered(subject, rig)
    print(
        f"{envelope:<10} {seed}   {back:12.1e} mm {(values[:, 0] / values[:, 2]).max():9.2f}   "
        f"{100 * (off <= 1).mean():10.2f} % {off.max():9.2f} mm   {100 * within.mean():8.1f} % "
        f"{100 * within.min():8.1f} %   {100 * rig.validate(T).valid.mean():10.2f} %",
        flush=True,
    )


def inside(rig: JawRig) -> np.ndarray:
    """Return parameters spread over the bounds [mm], shape (n, 3)."""
    low, high = rig.d_range.T
    d = low + (high - low) * np.random.default_rng(6).random((4000, 3))
    return d[rig.margin(d) > 0]


def sweeps(rig: JawRig) -> np.ndarray:
    """Return all positions of each slider alone, lateral and protrusion at several openings too, within the bounds."""
    found = []
    for axis in range(3):
        for opening in SWEPT_OPENINGS_MM if axis else (0.0,):
            low, high = rig.d_range[axis]
            d = np.zeros((int((high - low) / STEP_MM) + 1, 3))
            d[:, 0] = opening
            d[:, axis] = np.linspace(low, high, len(d))
            found.append(d[rig.margin(d) > 0])
    return np.concatenate(found)


def covered(subject: Subject, rig: JawRig) -> np.ndarray:
    """Return the share of hidden errors within two predicted standard deviations, per landmark, shape (5,)."""
    d = rig.encode(subject.hidden)[0]
    near, shares = rig.pose(d), []
    for sd, point in zip(rig.landmark_sigma_mm(d).T, subject.person.landmarks, strict=True):
        error = np.linalg.norm(transform_point(near, point) - transform_point(subject.hidden, point), axis=-1)
        shares.append((error <= 2 * sd).mean())
    return np.array(shares)


def networks(count: int, starts: int) -> None:
    """Print the training error of the paper's network of five components, best of the starts and mean over persons."""
    best = []
    for seed in range(count):
        subject = Subject(seed)
        T = record(subject.person, TRAINING, SEED_TRAINING).T_noisy
        person = subject.person
        anatomy = SubjectAnatomy.of(subject.T_anatomical_skull, person.landmarks, person.mandible_points, None)
        data = select_poses(np.arange(len(T)), T, anatomy).data
        root = data.metric.twist_root()
        points = se3_log(data.motion) @ root
        errors = []
        for start in range(starts):
            net = train_nlpca(points, 5, start)
            rebuilt = se3_exp(np.linalg.solve(root.T, net.decode(net.encode(points)).T).T)
            errors.append(data.metric.largest(rebuilt, data.motion).mean())
        best.append(min(errors))
    print(
        f"\nNLPCA with 5 components, training error: mean {np.mean(best):.3f}, persons {np.round(best, 3)}", flush=True
    )


def recorded(folder: Path, tracks: Path | None, starts: int) -> None:
    """Print the tables of a capture with truth."""
    capture = load_capture(folder)
    meshes = load_meshes(capture)
    found = subject_of_capture(capture, meshes)
    bone = meshes.get("mandible", meshes["lower_teeth"])
    anatomy = SubjectAnatomy.of(found.T_anatomical_skull, found.landmarks, bone.vertices, None)
    with np.load(capture.folder / "truth" / "truth.npz") as archive:
        frames, true, phase = archive["frames"], archive["T_upper_lower"], archive["phase"]
    noisy = with_tracking_noise(true, found.landmarks[0] + BELOW_INCISOR)
    sources = {"true poses with noise": select_poses(frames, noisy, anatomy).data}
    if tracks is not None:
        sources["tracked poses"] = select_tracks(load_tracks(tracks), anatomy).data
    for label, data in sources.items():
        rows = np.searchsorted(frames, data.frames)
        print(f"\n{capture.name}, {label}, {len(data)} frames{'':<14}mean median  p95    max", flush=True)
        every = np.arange(len(data))
        folds = every * 5 // len(data)
        row("anchored, train", errors(anchored(data), data))
        row("anchored, true poses", errors(anchored(data), data, anatomy.motion(true[rows])))
        row("anchored, five parts left out", left_out(data, folds, anchored))
        for kind in np.unique(phase):
            if (phase[rows] == kind).any():
                row(f"anchored, {kind} left out", left_out(data, np.where(phase[rows] == kind, 0, -1), anchored))
        literal = fit_paper(data, ALL_SHOWN, True, starts, 0)
        row("paper --literal, train", errors(literal, data))
        again = partial(fit_paper, shown=ALL_SHOWN, literal=True, starts=1, seed=literal.notes["seed"])
        row("paper --literal, five parts left out", left_out(data, folds, again))


def with_tracking_noise(T: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Turn and move each pose a little about a point of the mandible."""
    rng = np.random.default_rng(0)
    R = so3_exp(rng.normal(size=(len(T), 3)) * NOISE_RAD)
    return T @ make_transform(R, centre + rng.normal(size=(len(T), 3)) * NOISE_MM - R @ centre)


def errors(form: FittedForm, data: TrainingData, motion: np.ndarray | None = None) -> np.ndarray:
    """Return the distance of motions, those of the data if None, to the nearest ones of a model [mm], shape (N,)."""
    motion = data.motion if motion is None else motion
    return data.metric.largest(data.metric.nearest(form.model, motion)[1], motion)


def left_out(data: TrainingData, folds: np.ndarray, fit: Fit) -> np.ndarray:
    """Return the errors of frames of each fold >= 0 under a model of all others [mm]."""
    return np.concatenate(
        [errors(fit(data.select(folds != k)), data.select(folds == k)) for k in np.unique(folds[folds >= 0])]
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--persons", type=int, default=5)
    parser.add_argument("--starts", type=int, default=4, help="random starts of the paper's networks")
    parser.add_argument("--capture", type=Path, help="capture.toml of a capture with truth")
    parser.add_argument("--tracks", type=Path, help="its tracks.npz")
    options = parser.parse_args()
    persons(options.persons)
    networks(options.persons, options.starts)
    if options.capture:
        recorded(options.capture, options.tracks, options.starts)
