"""Judge the jaw motion of a face model (FLAME, SMPL-X, any) that is aligned with a rig."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, FormatError
from jawusd.evaluator import JawRig
from jawusd.evaluator.verdicts import Verdicts
from jawusd.formats.alignment import Alignment, motion_of_points, read_jaw_track
from jawusd.formats.atomic import write_text_atomic
from jawusd.geometry import se3_inverse, transform_points

# Number of standard deviations of the alignment error by which thresholds are widened.
_WIDENED = 2.0


class JudgedFace(NamedTuple):
    """The verdicts on a face track."""

    frames: Array  # frame numbers, shape (F,)
    verdicts: Verdicts  # one entry per frame
    alignment_mm: Array  # rms displacement of the landmarks that the expected error of the alignment causes [mm], (F,)
    widened_mm: float  # distance by which both thresholds were widened for it [mm]


def judge_jaw_track(
    rig: JawRig,
    path: AnyPath,
    alignment: Alignment,
    residual_mm: float | None = None,
    tolerance_mm: float | None = None,
) -> JudgedFace:
    """Judge the jaw motion of a face model.

    The thresholds are widened by two standard deviations of the error that the alignment causes in the median frame;
    wrong poses, where it is larger, do not widen them much.

    Args:
        path: see `jawusd.formats.alignment`.
        residual_mm, tolerance_mm: thresholds to widen; default: those of the rig.

    Raises:
        FormatError: the file has no jaw motion, or the alignment belongs to another actor.
    """
    if alignment.actor != rig.actor:
        raise FormatError(
            f'the alignment is of "{alignment.actor}", but the rig is of "{rig.actor}".',
            hint="Run `jawusd align` with this rig.",
        )
    frames, motion = read_jaw_track(path, alignment.joint)
    T = alignment.jaw_poses(motion, rig.T_rest)
    error = alignment_error_mm(rig, T, alignment)
    widened = _WIDENED * float(np.median(error)) if len(error) else 0.0
    limits = rig.limits.replaced(residual_mm, tolerance_mm, None)
    verdicts = rig.validate(
        T, residual_limit_mm=limits.residual_mm + widened, tolerance_mm=limits.tolerance_mm + widened
    )
    return JudgedFace(frames, verdicts, error, widened)


def alignment_error_mm(rig: JawRig, T_skull_mandible: Array, alignment: Alignment) -> Array:
    """Return the rms displacement (F,) [mm] that an alignment error causes at the landmarks, for poses (F, 4, 4).

    The motion D = T T_rest^-1 becomes A D A^-1, where A is the error. To first order, a landmark p is displaced by
    J(D p) xi - R_D J(p) xi, with J of `motion_of_points` and xi the error. In closed bite, the displacement is zero.
    """
    closed = transform_points(rig.T_rest, rig.landmarks)
    D = T_skull_mandible @ se3_inverse(rig.T_rest)
    moved = transform_points(T_skull_mandible, rig.landmarks)
    J = motion_of_points(moved) - D[:, None, :3, :3] @ motion_of_points(closed)
    squared: Array = np.einsum("flij,jk,flik->f", J, np.array(alignment.covariance), J) / len(closed)
    return np.sqrt(squared)


def save_verdicts(path: AnyPath, judged: JudgedFace) -> None:
    """Write the verdicts as CSV, atomically; raises OutputError if that fails."""
    lines = ["frame,valid,verdict,residual_mm,margin_mm,d1,d2,d3,alignment_mm"]
    v = judged.verdicts
    for frame, ok, words, *numbers in zip(
        judged.frames, v.valid, v.words(), v.residual_mm, v.margin_mm, *v.d.T, judged.alignment_mm, strict=True
    ):
        shown = ",".join(f"{number:.4f}" for number in numbers)
        lines.append(f'{frame:g},{int(ok)},"{words}",{shown}')
    write_text_atomic(path, "\n".join([*lines, ""]))
