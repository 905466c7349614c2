"""Fit a jaw model to tracks, or to poses and markers from other programs, converted to T_skull_mandible [mm].

Poses from jaw-tracking-system (PyPI `jaw-tracking-system`, Mueller et al., version 1.1) are HDF5 files: one group per
trajectory, by default `T_model_origin_mand_landmark_t` and, smoothed, `T_model_origin_mand_landmark_t_smooth`, with the
data sets `translations` (N, 3) and `rotations`, scalar-first quaternions (N, 4) or matrices (N, 3, 3), and the
attributes `unit` ("mm" or "m") and `sample_rate` [Hz]. Files cut by its `split_hdf5_by_sub_experiments` write their
`rotations` scalar-last and add `transformations` (N, 4, 4), which therefore take precedence. A trajectory maps the
frame of landmarks digitised on the mandible to the frame of the upper model.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypedDict

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, FormatError, errors_name_file, explain_missing_packages
from jawusd.formats.model import JawModel
from jawusd.formats.poses import read_poses
from jawusd.formats.tracks import Tracks, load_tracks
from jawusd.geometry import make_transform, matrix_from_wxyz, rigidity_defect, se3_inverse
from jawusd.pipeline.contact import (
    ContactSummary,
    condyle_solids,
    tooth_solids,
    with_condyle_contact,
    with_tooth_contact,
)
from jawusd.pipeline.markers import LENGTH_UNITS_MM, marker_poses
from jawusd.pipeline.state import Progress, no_progress
from jawusd.pipeline.subject import Subject, registered_subject

if TYPE_CHECKING:
    import h5py

#: Frame numbers (F,) and T_skull_mandible [mm] (F, 4, 4), NaN where there is no pose.
Poses = tuple[NDArray[np.int64], Array]

HDF5_SUFFIXES = (".h5", ".hdf5")
RAW_GROUP = "T_model_origin_mand_landmark_t"
_HDF5_UNITS_MM = {"mm": 1.0, "m": 1000.0}
_RIGID_TOLERANCE = 1e-3
_MOST_NUMBERS = 16_000_000  # maximum number of array elements: a million 4 x 4 matrices


@dataclass(frozen=True)
class TrajectoryOptions:
    """Conventions of a pose file: names, units and direction of its transforms."""

    #: for tables, maps jawusd's column names to the file's; see `formats.poses.read_poses`
    columns: Mapping[str, str] = field(default_factory=dict)
    length_unit: str = "mm"  # a key of `LENGTH_UNITS_MM`, for files that do not state their unit
    invert: bool = False  # whether the transforms of the file map the skull frame to the mandible frame
    #: frame with the teeth in occlusion, to which poses are made relative; None: they are relative to occlusion
    rest_frame: int | None = None
    group: str | None = None  # name of the trajectory in an HDF5 file; None: the raw trajectory
    #: rigid bodies in a table of markers (see `pipeline.markers.marker_poses`); empty if the file contains poses
    rigid: Mapping[str, str] = field(default_factory=dict)


class FitSummary(TypedDict, total=False):
    """Key figures of a fitted model: errors [mm], ranges of motion and warnings."""

    method: str
    kind: str
    errors: dict[str, dict[str, dict[str, float]]]
    ranges_mm: dict[str, tuple[float, float]]
    warnings: list[dict[str, str]]
    inferred: list[str]
    contact: ContactSummary
    joints: ContactSummary
    trimmed_frames: list[int]


@explain_missing_packages()
def fit_subject(
    subject: Subject,
    motion: Tracks | Poses,
    method: str = "anchored",
    progress: Progress = no_progress,
    fps: float | None = None,
) -> JawModel:
    """Fit the jaw model of a subject.

    Args:
        fps: frame rate of the poses [1/s]; None: the subject's frame rate.
        method: "anchored", "additive", "paper" or "pca".

    Raises:
        FittingError: the poses do not suffice for a model.
    """
    from jawusd.fitting import FittingConfig, fit_model
    from jawusd.fitting.fit import with_speeds
    from jawusd.paper.model import FORMS

    registration = motion.meta.get("registration") if isinstance(motion, Tracks) else None
    if registration is not None:
        subject = registered_subject(subject, {"registration": registration})
    axes, rest = subject.T_anatomical_skull, subject.T_rest
    with ThreadPoolExecutor(1) as pool:  # solids do not depend on the model; computing them mostly releases the GIL
        teeth = pool.submit(tooth_solids, subject.meshes, axes, rest)
        joints = pool.submit(condyle_solids, subject.meshes, axes, subject.landmarks, rest)
        model = fit_model(
            motion,
            T_anatomical_skull=axes,
            landmarks=subject.landmarks,
            mandible_vertices=subject.measured_points(),
            T_rest=rest,
            config=FittingConfig(method=method),
            actor=subject.name,
            forms=FORMS,
            progress=partial(progress, "fit"),
        )
        model.meta["inferred"] = list(subject.inferred)
        if registration is not None:
            model.meta["registration"] = registration
        model = with_tooth_contact(model, teeth.result(), progress)
        model = with_condyle_contact(model, joints.result(), progress)
    fps = fps or subject.fps
    if fps is None:
        return model
    model.meta["fps"] = fps
    return with_speeds(model, fps)


def fit_summary(model: JawModel) -> FitSummary:
    """Return the key figures of a fitted model."""
    found = {key: model.meta[key] for key in FitSummary.__annotations__ if key in model.meta}
    return cast(FitSummary, found)  # the values of meta are untyped JSON


def read_motion(path: AnyPath, options: TrajectoryOptions = TrajectoryOptions()) -> tuple[Tracks | Poses, float | None]:
    """Read tracks from tracks.npz, or poses and their frame rate from any other file; see `read_trajectory`.

    Raises:
        FormatError: the file is invalid, or it is tracks.npz, for which options do not apply.
        MissingDependencyError: the file is HDF5, and h5py is not installed.
    """
    if Path(path).suffix != ".npz":
        frames, T, fps = read_trajectory(path, options)
        return (frames, T), fps
    if options != TrajectoryOptions():
        raise FormatError("contains tracks; columns, units and rest frame apply only to other poses.", path=path)
    return load_tracks(path), None


@errors_name_file
def read_trajectory(path: AnyPath, options: TrajectoryOptions) -> tuple[NDArray[np.int64], Array, float | None]:
    """Read poses from a CSV or JSON table, a table of markers, or an HDF5 file (.h5, .hdf5) of jaw-tracking-system.

    Returns frame numbers, shape (F,); T_skull_mandible [mm], shape (F, 4, 4), NaN where there is no pose; and the frame
    rate, None if the file does not state it.

    Raises:
        FormatError: the file is invalid, an option does not apply to it, or the rest frame is missing or has no pose.
        MissingDependencyError: the file is HDF5, and h5py is not installed.
    """
    path, fps = Path(path), None
    if options.rigid:
        if options.columns or options.group:
            raise FormatError("columns and groups apply to poses; this is a table of markers.")
        T, fps = marker_poses(path, options.rigid, options.rest_frame, options.length_unit)
        frames = np.arange(len(T))
    elif path.suffix.lower() in HDF5_SUFFIXES:
        if options.rest_frame is None:
            hint = "Give a frame (counted from 0) with the teeth in occlusion with --rest-frame."
            raise FormatError("its poses are those of landmarks on the mandible, not of a scan.", hint=hint)
        frames, T = read_hdf5(path, options.group)
    else:
        frames, T = read_poses(path, options.columns)
        T[:, :3, 3] *= LENGTH_UNITS_MM[options.length_unit]
    if options.invert:
        T = se3_inverse(T)
    if options.rest_frame is not None:
        T = T @ se3_inverse(_pose_at(frames, T, options.rest_frame))
    return frames, T, fps


def _pose_at(frames: NDArray[np.int64], T: Array, wanted: int) -> Array:
    rows = np.flatnonzero(frames == wanted)
    if not rows.size:
        between = f"; it has frames {frames.min()} to {frames.max()}" if len(frames) else ""
        raise FormatError(f"has no frame {wanted}{between}.")
    found = T[rows[0]]
    if not np.isfinite(found).all():
        raise FormatError(f"frame {wanted} has no pose.", hint="Choose another frame in occlusion.")
    return found


@explain_missing_packages()
@errors_name_file
def read_hdf5(path: AnyPath, group: str | None = None) -> Poses:
    """Read a trajectory of jaw-tracking-system: poses of the landmark frame in the model frame, numbered from 0.

    Args:
        group: name of the trajectory's HDF5 group; None: the raw trajectory, or the only one in the file.

    Raises:
        FormatError: the file is invalid, lacks the group, has data sets of wrong shapes, or poses that are not rigid.
        MissingDependencyError: h5py is not installed.
    """
    import h5py

    if not Path(path).is_file():
        raise FormatError("there is no such file.")
    try:
        with h5py.File(path, "r") as file:
            inside = [name for name in file if isinstance(file.get(name, getlink=True), h5py.HardLink)]
            groups = [name for name in inside if isinstance(file[name], h5py.Group) and "translations" in file[name]]
            name = _chosen(groups, group)
            where = f'group "{name}"'
            t, rotations, whole = (
                _data(file[name], key, where) for key in ("translations", "rotations", "transformations")
            )
            unit = file[name].attrs.get("unit", "mm")
    # h5py raises exceptions of many types for corrupt files.
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, MemoryError) as error:
        raise FormatError(f"is not a readable HDF5 file ({error!s:.200}).") from error
    unit = unit.decode(errors="replace") if isinstance(unit, bytes) else str(unit)
    if unit not in _HDF5_UNITS_MM:
        raise FormatError(f'{where}: unit is "{unit}"; must be one of {", ".join(_HDF5_UNITS_MM)}.')
    T = _poses(t, rotations, whole, where)
    T[:, :3, 3] *= _HDF5_UNITS_MM[unit]
    T[~np.isfinite(T).all((1, 2))] = np.nan
    defect = rigidity_defect(np.where(np.isfinite(T), T, np.eye(4)))
    if len(T) and defect.max() > _RIGID_TOLERANCE:
        raise FormatError(
            f"{where}, row {int(defect.argmax()) + 1}: the pose is not rigid (deviation {defect.max():.2g}; "
            f"at most {_RIGID_TOLERANCE:g} is allowed)."
        )
    return np.arange(len(T)), T


def _chosen(groups: list[str], wanted: str | None) -> str:
    known = ", ".join(groups) or "none"
    if wanted is None:
        if RAW_GROUP in groups:
            return RAW_GROUP
        if len(groups) == 1:
            return groups[0]
        hint = "Choose one of them with --group." if groups else None
        raise FormatError(f"no trajectory is chosen; available trajectories: {known}.", hint=hint)
    if wanted not in groups:
        raise FormatError(f'has no trajectory "{wanted}"; it has {known}.')
    return wanted


def _data(group: h5py.Group, key: str, where: str) -> Array | None:
    if key not in group:
        return None
    link = group.get(key, getlink=True)
    held = group[key] if type(link).__name__ == "HardLink" else None
    if held is None or getattr(held, "external", None) or getattr(held, "is_virtual", False):
        raise FormatError(f'{where}: "{key}" is stored outside the file.')
    if not hasattr(held, "shape") or held.dtype.kind not in "fiu" or not held.shape or held.size > _MOST_NUMBERS:
        raise FormatError(f'{where}: "{key}" is not an array of at most {_MOST_NUMBERS} numbers.')
    return np.asarray(held[()], dtype=np.float64)


def _poses(t: Array | None, rotations: Array | None, whole: Array | None, where: str) -> Array:
    """Return the poses (F, 4, 4) from the data sets of a trajectory; translations are in the file's unit."""
    if whole is not None:
        if whole.ndim != 3 or whole.shape[1:] != (4, 4):
            raise FormatError(f'{where}: "transformations" has shape {whole.shape}, not (N, 4, 4).')
        return whole
    if rotations is None or t is None:
        raise FormatError(f'{where} has no "rotations".')
    if t.ndim != 2 or t.shape[1] != 3:
        raise FormatError(f'{where}: "translations" has shape {t.shape}; expected (N, 3).')
    count = len(t)
    if rotations.shape == (count, 3, 3):
        return make_transform(rotations, t)
    if rotations.shape != (count, 4):
        wanted = f"expected ({count}, 4) or ({count}, 3, 3)"
        raise FormatError(f'{where}: "rotations" has shape {rotations.shape}; {wanted}.')
    norm = np.linalg.norm(rotations, axis=1)
    if (norm < 1e-6).any():
        raise FormatError(f"{where}, row {int(norm.argmin()) + 1}: the quaternion is zero.")
    return make_transform(matrix_from_wxyz(rotations), t)
