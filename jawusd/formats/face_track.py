"""Jaw motion of a face model in its own frame, as the model's solver writes it.

An npz file (numpy, without pickles) with one row per frame:

    jaw_pose         (F, 3)     rotation vectors about the jaw joint [rad] (FLAME, SMPL-X), or (F, 1, 3)
    jaw_translation  (F, 3)     translations of the jaw [model units]; optional
    joint            (3,)       jaw joint [model units]; optional if the alignment states it
    T_model_jaw      (F, 4, 4)  instead of these: motions of the jaw, translations in model units
    frames           (F,)       frame numbers; optional, default 0, 1, 2, ...

The identity is the closed mouth with the teeth in occlusion. Other arrays are ignored. A CSV or JSON table of matrices
(see `jawusd.formats.poses`) is read as `T_model_jaw`.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import FormatError
from jawusd.base.npz import read_arrays, take
from jawusd.formats.alignment import Alignment
from jawusd.formats.poses import read_poses
from jawusd.geometry import make_transform, se3_inverse, so3_exp

_JOINT_HINT = 'Store it as "joint" in the npz file, or state it in the correspondences of `jawusd align`.'


@dataclass(frozen=True, eq=False)
class JawTrack:
    """The jaw motion of a face model.

    Attributes:
        frames: frame numbers (F,).
        T_model_jaw: motions of the jaw in the model's frame, translations in model units, shape (F, 4, 4).
    """

    frames: Array
    T_model_jaw: Array

    def poses(self, alignment: Alignment, T_rest: Array) -> Array:
        """Return T_skull_mandible (F, 4, 4) [mm], given the pose of the closed bite (4, 4).

        With S = `T_skull_model`, ``T_skull_mandible = S T_model_jaw S^-1 T_rest``.
        """
        motion = self.T_model_jaw.copy()
        motion[:, :3, 3] *= alignment.unit_mm
        poses: Array = alignment.matrix @ motion @ se3_inverse(alignment.matrix) @ T_rest
        return poses


def read_jaw_track(path: str | os.PathLike[str], joint: tuple[float, float, float] | None) -> JawTrack:
    """Read the jaw motion of a face model.

    Args:
        joint: jaw joint of the model [model units], if the file does not contain it.

    Raises:
        FormatError: the file has no jaw motion, an array has a wrong shape, or there is no joint.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz":
        numbers, T = read_poses(path)
        return JawTrack(numbers.astype(np.float64), T)
    arrays = read_arrays(path)
    if "T_model_jaw" in arrays:
        T = take(arrays, "T_model_jaw", (None, 4, 4), path).astype(np.float64)
    elif "jaw_pose" in arrays:
        T = _turned(arrays, joint, path)
    else:
        raise FormatError('has neither "jaw_pose" nor "T_model_jaw".', path=path)
    count = np.arange(len(T), dtype=np.float64)
    frames = take(arrays, "frames", (len(T),), path).astype(np.float64) if "frames" in arrays else count
    return JawTrack(frames, T)


def _turned(arrays: dict[str, Array], joint: tuple[float, float, float] | None, path: Path) -> Array:
    if arrays["jaw_pose"].ndim == 3:
        arrays = {**arrays, "jaw_pose": arrays["jaw_pose"][:, 0]}
    R = so3_exp(take(arrays, "jaw_pose", (None, 3), path).astype(np.float64))
    if "joint" not in arrays and joint is None:
        raise FormatError('has "jaw_pose" but no "joint".', path=path, hint=_JOINT_HINT)
    j = take(arrays, "joint", (3,), path).astype(np.float64) if "joint" in arrays else np.array(joint)
    shift = take(arrays, "jaw_translation", (len(R), 3), path) if "jaw_translation" in arrays else np.zeros(3)
    return make_transform(R, j - R @ j + shift)
