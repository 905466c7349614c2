"""Trajectories of jaw-tracking-system (PyPI `jaw-tracking-system`, Mueller et al.), an optical marker system, as HDF5.

Layout, as its `store_transformations` writes it (version 1.1): one group per trajectory, by default
`T_model_origin_mand_landmark_t` and, smoothed, `T_model_origin_mand_landmark_t_smooth`, with the data sets
`translations` (N, 3) and `rotations`, scalar-first quaternions (N, 4) or matrices (N, 3, 3), and the attributes `unit`
("mm" or "m", of the translations) and `sample_rate` [Hz]. Files cut by its `split_hdf5_by_sub_experiments` add
`transformations` (N, 4, 4) and write their `rotations` scalar-last, so `transformations` is read where there is one. A
trajectory maps the frame of mandibular landmarks, which is digitised on the teeth, to the frame of the upper model.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jawusd.errors import FormatError, explain_missing_packages
from jawusd.geometry import make_transform, matrix_from_wxyz, rigidity_defect
from jawusd.geometry.arrays import Array

RAW_GROUP = "T_model_origin_mand_landmark_t"

_MM = {"mm": 1.0, "m": 1000.0}
_RIGID_TOLERANCE = 1e-3
_MOST_NUMBERS = 16_000_000  # a million 4 x 4 matrices


@explain_missing_packages()
def read_hdf5(path: str | os.PathLike[str], group: str | None = None) -> tuple[NDArray[np.int64], Array]:
    """Read a trajectory.

    Args:
        path: the file.
        group: which trajectory; None: the raw one, or the only one.

    Returns:
        Frame numbers from 0, shape (F,), and poses, the landmark frame in the model frame [mm], shape (F, 4, 4), NaN
        where the file has NaN.

    Raises:
        FormatError: not such a file, no such group, data sets of wrong shapes, or poses that are not rigid.
        MissingDependencyError: h5py is not installed.
    """
    import h5py

    path = Path(path)
    if not path.is_file():
        raise FormatError("there is no such file.", path=path)
    try:
        with h5py.File(path, "r") as file:
            inside = [name for name in file if isinstance(file.get(name, getlink=True), h5py.HardLink)]
            groups = [name for name in inside if isinstance(file[name], h5py.Group) and "translations" in file[name]]
            name = _chosen(groups, group, path)
            held = {key: _data(file[name], key, name, path) for key in ("translations", "rotations", "transformations")}
            unit = file[name].attrs.get("unit", "mm")
    # h5py reports what is damaged inside a file by whatever its layers stumble over.
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, MemoryError) as error:
        raise FormatError(f"is not an HDF5 file that can be read ({error!s:.200}).", path=path) from error
    unit = unit.decode(errors="replace") if isinstance(unit, bytes) else str(unit)
    if unit not in _MM:
        raise FormatError(f'group "{name}": unit is "{unit}", known are {", ".join(_MM)}.', path=path)
    T = _poses(held, name, path)
    T[:, :3, 3] *= _MM[unit]
    return np.arange(len(T)), _checked(T, name, path)


def _chosen(groups: list[str], wanted: str | None, path: Path) -> str:
    known = ", ".join(groups) or "none"
    if wanted is None:
        if RAW_GROUP in groups:
            return RAW_GROUP
        if len(groups) == 1:
            return groups[0]
        raise FormatError(
            f"has the trajectories: {known}.", path=path, hint="Name one of them with --group." if groups else None
        )
    if wanted not in groups:
        raise FormatError(f'has no trajectory "{wanted}"; it has {known}.', path=path)
    return wanted


def _data(group: Any, key: str, name: str, path: Path) -> Array | None:
    if key not in group:
        return None
    link = group.get(key, getlink=True)
    held = group[key] if type(link).__name__ == "HardLink" else None
    if held is None or getattr(held, "external", None) or getattr(held, "is_virtual", False):
        raise FormatError(f'group "{name}": "{key}" lies elsewhere, it must be in the file itself.', path=path)
    if not hasattr(held, "shape") or held.dtype.kind not in "fiu" or not held.shape or held.size > _MOST_NUMBERS:
        raise FormatError(f'group "{name}": "{key}" is not an array of at most {_MOST_NUMBERS} numbers.', path=path)
    return np.asarray(held[()], dtype=np.float64)


def _poses(held: dict[str, Array | None], name: str, path: Path) -> Array:
    """Return the poses (F, 4, 4) of the data sets, translations in the file's unit."""
    whole, t, rotations = held["transformations"], held["translations"], held["rotations"]
    if whole is not None:
        if whole.ndim != 3 or whole.shape[1:] != (4, 4):
            raise FormatError(f'group "{name}": "transformations" has shape {whole.shape}, not (N, 4, 4).', path=path)
        return whole
    if rotations is None:
        raise FormatError(f'group "{name}" has no "rotations".', path=path)
    if t.ndim != 2 or t.shape[1] != 3:
        raise FormatError(f'group "{name}": "translations" has shape {t.shape}, expected (N, 3).', path=path)
    count = len(t)
    if rotations.shape == (count, 3, 3):
        return make_transform(rotations, t)
    if rotations.shape != (count, 4):
        raise FormatError(
            f'group "{name}": "rotations" has shape {rotations.shape}, expected ({count}, 4) or ({count}, 3, 3).',
            path=path,
        )
    norm = np.linalg.norm(rotations, axis=1)
    if (norm < 1e-6).any():
        raise FormatError(f'group "{name}", row {int(norm.argmin()) + 1}: the quaternion is zero.', path=path)
    return make_transform(matrix_from_wxyz(rotations), t)


def _checked(T: Array, name: str, path: Path) -> Array:
    T[~np.isfinite(T).all((1, 2))] = np.nan
    present = np.flatnonzero(np.isfinite(T[:, 0, 0]))
    defect = rigidity_defect(T[present])
    if defect.size and defect.max() > _RIGID_TOLERANCE:
        row = int(present[defect.argmax()])
        raise FormatError(
            f'group "{name}", row {row + 1}: the pose is not rigid (off by {defect.max():.2g}, allowed '
            f"{_RIGID_TOLERANCE:g}).",
            path=path,
        )
    return T
