"""Jaw poses of parametric face models (FLAME, SMPL-X): axis-angle about a joint, as T_skull_mandible."""

from __future__ import annotations

import torch
from torch import Tensor

from jawusd.evaluator.formula import anchored_motion
from jawusd.evaluator.operations import triple
from jawusd.solvers.motion import OPERATIONS, transforms


def jaw_pose_from_axis_angle(
    axis_angle: Tensor,
    translation: Tensor | None,
    *,
    joint: Tensor,
    T_skull_model: Tensor,
    T_rest: Tensor,
    unit_mm: float = 1000.0,
) -> Tensor:
    """Return the jaw poses of a face model whose jaw turns about a joint.

    Such models move jaw vertices by ``v -> R (v - j) + j + t`` in the model's frame (Li et al. 2017, FLAME; Pavlakos et
    al. 2019, SMPL-X); with the mouth closed, R = I and t = 0. In the skull frame, S = T_skull_model,
    ``T_skull_mandible = S [R, j - R j + t] S^-1 T_rest``.

    Args:
        axis_angle: Rotation vectors of the jaw [rad], shape (..., 3).
        translation: Translation t of the jaw [model units], shape (..., 3); None for models that only turn it.
        joint: The jaw joint j of the face with the mouth closed [model units], shape (3,).
        T_skull_model: Rigid alignment of the model's frame with the skull (upper teeth scan) frame, in mm, (4, 4).
        T_rest: Pose of the closed bite, `JawRig.T_rest`, shape (4, 4).
        unit_mm: Length of a model unit; both models count in metres.

    Returns:
        T_skull_mandible [mm], shape (..., 4, 4).
    """
    batch = axis_angle.shape[:-1]
    omega = axis_angle.reshape(-1, 3)
    moved = torch.zeros_like(omega) if translation is None else translation.reshape(-1, 3) * unit_mm
    turn, shift, anchor = (triple(x.split(1, dim=-1)) for x in (omega, moved, joint * unit_mm))
    turned = transforms(anchored_motion(turn, shift, anchor, OPERATIONS))
    T = T_skull_model @ turned @ torch.linalg.inv(T_skull_model) @ T_rest
    return T.reshape(*batch, 4, 4)
