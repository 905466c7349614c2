"""Poses from elsewhere: other column names, units, directions and reference frames become T_skull_mandible in mm."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jawusd.errors import FormatError
from jawusd.formats.poses import read_poses
from jawusd.geometry import se3_inverse
from jawusd.geometry.arrays import Array
from jawusd.pipeline.hdf5 import read_hdf5

HDF5_SUFFIXES = (".h5", ".hdf5")
LENGTH_UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}


@dataclass(frozen=True)
class TrajectoryOptions:
    """Say how a file of poses is written.

    Attributes:
        columns: our column names to the file's, see `formats.poses.read_poses`; tables only.
        length_unit: of the translations, a key of `LENGTH_UNITS_MM`; tables only, HDF5 files name theirs.
        invert: the poses map skull to mandible.
        rest_frame: a frame with the teeth in occlusion: the jaw is measured from there, so that the file's mandible
            frame may lie anywhere on the mandible; None: the poses are identity in occlusion.
        group: the trajectory of an HDF5 file; None: its raw one.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    length_unit: str = "mm"
    invert: bool = False
    rest_frame: int | None = None
    group: str | None = None


def read_trajectory(path: str | os.PathLike[str], options: TrajectoryOptions) -> tuple[NDArray[np.int64], Array]:
    """Read poses from a CSV or JSON table, or from HDF5 of jaw-tracking-system.

    Args:
        path: `.csv`, `.json`, `.h5` or `.hdf5`.
        options: how the file is written.

    Returns:
        Frame numbers (F,) and T_skull_mandible [mm] (F, 4, 4), NaN where an HDF5 file has no pose.

    Raises:
        FormatError: not such a file; an option that does not suit it; the rest frame is missing or has no pose.
        MissingDependencyError: HDF5 without h5py.
    """
    path = Path(path)
    if path.suffix.lower() in HDF5_SUFFIXES:
        if options.rest_frame is None:
            raise FormatError(
                "its poses are those of landmarks on the mandible, not of a scan.",
                path=path,
                hint="Name a frame (counted from 0) with the teeth in occlusion with --rest-frame.",
            )
        frames, T = read_hdf5(path, options.group)
    else:
        frames, T = read_poses(path, options.columns)
        T[:, :3, 3] *= LENGTH_UNITS_MM[options.length_unit]
    if options.invert:
        T = se3_inverse(T)
    if options.rest_frame is not None:
        T = T @ se3_inverse(_pose_at(frames, T, options.rest_frame, path))
    return frames, T


def _pose_at(frames: NDArray[np.int64], T: Array, wanted: int, path: Path) -> Array:
    rows = np.flatnonzero(frames == wanted)
    if not rows.size:
        between = f"; it has {frames.min()} to {frames.max()}" if len(frames) else ""
        raise FormatError(f"has no frame {wanted}{between}.", path=path)
    found = T[rows[0]]
    if not np.isfinite(found).all():
        raise FormatError(f"frame {wanted} has no pose.", path=path, hint="Name another frame in occlusion.")
    return found
