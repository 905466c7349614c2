"""Libraries of actors, retargeting of motion between actors, and rigs made from landmarks alone."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import AnyPath, EvaluatorError, FormatError, OutputError, explain_missing_packages
from jawusd.evaluator import JawRig, load
from jawusd.evaluator.bounds import SMALLEST_REACH_MM
from jawusd.evaluator.kinds import HELD_OUT_ARRAYS
from jawusd.formats.atomic import refuse_existing
from jawusd.formats.model import JawModel, load_model, save_model
from jawusd.library.index import MODEL_FILE, Entry, Library, load_donors, scan_library
from jawusd.library.personal import PersonalMotion, leave_one_out, personal_motion
from jawusd.library.timing import follow
from jawusd.pipeline.fit import fit_summary
from jawusd.pipeline.state import Progress
from jawusd.pipeline.subject import Subject, subject_of_landmarks

# Minimum step of a retargeted motion between samples, relative to the source's step times the ratio of the ranges.
_SLOWEST = 0.1
_ROUNDS = 400  # maximum number of alternations of timing and projection into the bound; most motions need fewer than 40

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


@explain_missing_packages()
def load_any_rig(path: Path) -> JawRig:
    """Read a rig from `model.npz`, which needs only numpy, or from any USD layer that contains it.

    Raises:
        JawusdError: the file is not a rig.
        MissingDependencyError: the file is USD, and OpenUSD is not installed.
    """
    if path.suffix == ".npz":
        return load(path)
    from jawusd.rig import load_rig

    return load_rig(path)


def open_library(folder: AnyPath) -> Library:
    """Scan a folder with one subfolder per subject, and update its index; see `library.index.scan_library`."""
    return scan_library(folder, load_any_rig)


def add_rig(folder: AnyPath, source: Path, name: str | None, force: bool) -> Path:
    """Copy a rig into a library, as the model file `NAME/model.npz` (default: the name in the rig); return that file.

    Raises:
        FormatError: the file is not a rig, or the name is not a valid folder name.
        OutputError: the library already has a subject of this name, or the file cannot be written.
    """
    rig = load_any_rig(source)
    called = name or str(rig.meta.get("actor") or "")
    if not _NAME.fullmatch(called):
        raise FormatError(
            f'"{called}" is not a valid folder name; use letters, digits, ".", "_" and "-".',
            path=source,
            hint="Give --name.",
        )
    place = Path(folder) / called
    # A symbolic link could point outside the library.
    if place.is_symlink() or (place / MODEL_FILE).is_symlink():
        raise OutputError("is a symbolic link; rigs are stored in the library itself.", path=place)
    refuse_existing(place / MODEL_FILE, force)
    save_model(place / MODEL_FILE, _as_model(rig, source, called))
    return place / MODEL_FILE


def _as_model(rig: JawRig, source: Path, name: str) -> JawModel:
    if source.suffix == ".npz":
        model = load_model(source)
        model.meta["actor"] = name
        return model
    arrays = {key: np.array(value) for key, value in rig.arrays.items()}
    return JawModel(arrays, *_no_frames(), {**rig.meta, "actor": name})


def _no_frames() -> tuple[NDArray[np.int64], Array, Array, Mask]:
    """Return frames, d, residuals and training mask of a model without a take."""
    return np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), np.zeros(0, bool)


@explain_missing_packages()
def plot_ranges(entries: Sequence[Entry], folder: Path, force: bool) -> list[Path]:
    """Plot the ranges of motion of a library's subjects side by side, as PNG and SVG; return the files.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        OutputError: a file exists already, or cannot be written.
    """
    from jawusd.report.figures import RANGES, ranges_figure
    from jawusd.report.style import save_figure

    for suffix in (".png", ".svg"):
        refuse_existing(folder / (RANGES + suffix), force)
    return save_figure(ranges_figure([(entry.actor, entry.ranges_mm) for entry in entries]), folder, RANGES)


@dataclass(frozen=True, eq=False)
class PersonalRig:
    """A rig made from landmarks."""

    model: JawModel  # the fitted model
    motion: PersonalMotion  # the motion to which the model was fitted
    left_out: tuple[str, ...]  # subjects of the library that were not used, because their captures lack a movement
    header: Mapping[str, object]  # provenance stored in the model's header


def personal_rig(landmarks: Path, library: Library, *, closest: bool, name: str, progress: Progress) -> PersonalRig:
    """Make a rig for a subject without a capture, from the subject's landmarks and a library.

    The motion of the library's subjects is transferred to the landmarks and averaged (see `library.personal`), and the
    anchored model is fitted to it. The model's header states the expected error, estimated by leave-one-out over the
    library; the residual limit of measured poses allows for that error.

    Args:
        landmarks: file of format jawusd-landmarks/1.
        closest: use the motion of the subject with the most similar landmarks instead of the average.

    Raises:
        FormatError: the landmarks file is not of that format.
        FittingError: the library has no usable subject, or the landmarks are not those of a jaw.
    """
    subject = subject_of_landmarks(landmarks, name)
    progress("carry", 0, 1)
    donors = load_donors(library, load_any_rig)
    motion = personal_motion(donors, subject.landmarks, leave_one_out(donors, closest=closest))
    progress("carry", 1, 1)
    model = fit_personal(subject, motion, progress)
    left_out = tuple(entry.path for entry in library.entries if entry.not_shown)
    return PersonalRig(model, motion, left_out, cast("Mapping[str, object]", model.meta["personal"]))


@explain_missing_packages()
def fit_personal(subject: Subject, motion: PersonalMotion, progress: Progress) -> JawModel:
    """Fit the anchored model to motion transferred to a subject, and store the expected error in the model's header.

    Raises like `fitting.fit_model`.
    """
    from jawusd.fitting import FittingConfig, fit_model

    model = fit_model(
        (np.arange(len(motion.poses)), motion.poses),
        T_anatomical_skull=subject.T_anatomical_skull,
        landmarks=subject.landmarks,
        config=FittingConfig(holdout_folds=0),  # no cross-validation: held-out frames would be those of other subjects
        actor=subject.name,
        progress=partial(progress, "fit"),
    )
    model.meta["inferred"] = list(subject.inferred)
    learned, scale_mm = motion.learned, motion.learned.bandwidth_mm
    model.meta["personal"] = {
        "weights": motion.weights,
        "landmark_distance_scale_mm": None if scale_mm is None or not np.isfinite(scale_mm) else scale_mm,
        "expected_error_mm": learned.summary() if learned.errors_mm else None,
        "fit_to_carried_motion_mm": model.meta["errors"],
    }
    # The training error does not apply to this subject, whose motion was not measured.
    model.meta["errors"] = {"expected": learned.table()} if learned.errors_mm else {}
    caution = {"code": "personal", "message": _caution(motion)}
    model.meta["warnings"] = [*fit_summary(model)["warnings"], caution]
    if learned.errors_mm:
        limit = np.maximum(model.arrays["residual_limit_mm"], learned.pooled().mean())
        model.arrays["residual_limit_mm"] = limit
    # Transferred poses are not a take of this subject, so the file gets no captured motion and no held-out frames.
    arrays = {name: value for name, value in model.arrays.items() if name not in HELD_OUT_ARRAYS}
    return JawModel(arrays, *_no_frames(), model.meta)


def _caution(motion: PersonalMotion) -> str:
    persons = f"{len(motion.weights)} library subject{'s' if len(motion.weights) > 1 else ''}"
    start = f"Made from landmarks and {persons}, not from a capture;"
    if not motion.learned.errors_mm:
        return f"{start} the expected error is unknown, because the library has a single subject."
    found = motion.learned.summary()
    return f"{start} expected error {found['mean']:.2f} mm, 95 % below {found['p95']:.2f} mm (leave-one-out)."


@dataclass(frozen=True, eq=False)
class Retargeted:
    """A retargeted motion, and the changes made to keep it inside the bound."""

    frames: Array  # frame numbers, shape (G,)
    d: Array  # jaw parameters of the target [mm], inside its bound, NaN in lost frames, shape (G, 3)
    outside: Mask  # samples at which equal fractions of the ranges of motion would lie outside the bound, shape (G,)
    moved_mm: Array  # distance in d [mm] of each sample from equal fractions of the ranges, NaN if lost, shape (G,)


def retarget(source: JawRig, target: JawRig, frames: Array, d: Array) -> Retargeted:
    """Retarget a motion to another subject: equal fractions of both ranges of motion, same timing, inside the bound.

    The motion is resampled at all whole frames, because it is linear between samples in d, but not in fractions of the
    ranges of motion. Equal fractions alone would shift peaks by some frames and might leave the bound, so the motion is
    alternately adjusted to rise and fall with the source (see `library.timing`) and projected into the bound.

    `frames` (F,) increase; `d` (F, 3) are parameters of the source [mm], NaN in lost frames. Raises EvaluatorError if
    no frame has parameters.
    """
    known = np.isfinite(d).all(axis=1)
    if not known.any():
        raise EvaluatorError("no frame of the motion has parameters; there is nothing to retarget.")
    first, last = frames[known][[0, -1]]
    lost = frames[~known]
    whole = np.setdiff1d(np.arange(np.ceil(first), np.floor(last) + 1), lost)
    times = np.union1d(frames, whole)
    at = np.stack([np.interp(times, frames[known], column) for column in d[known].T], axis=1)
    at[np.isin(times, lost)] = np.nan
    carried = target.denormalized(source.normalized(at))
    kept, here = carried.copy(), np.isfinite(at[:, 0])
    kept[here] = _in_time(source, target, at[here], carried[here])
    outside = here.copy()
    outside[here] = ~target.is_inside(carried[here])
    return Retargeted(times, kept, outside, np.linalg.norm(kept - carried, axis=1))


def _in_time(source: JawRig, target: JawRig, original: Array, carried: Array) -> Array:
    """Return d (F, 3) [mm] inside the bound and near `carried`, rising and falling where `original` does."""
    sizes = [np.ptp(rig.d_range, axis=1) for rig in (source, target)]
    least = _SLOWEST * sizes[1] / np.maximum(sizes[0], SMALLEST_REACH_MM)
    kept = carried.copy()
    for _ in range(_ROUNDS):
        for axis in range(3):
            kept[:, axis] = follow(original[:, axis], kept[:, axis], least[axis])
        outside = ~target.is_inside(kept)
        if not outside.any():
            break
        kept[outside] = target.project(kept[outside])
    return kept
