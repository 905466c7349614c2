"""Rotations, rigid motions, cameras and the anatomical frame.

Conventions of the whole package:

* ``T_a_b`` maps b-coordinates to a-coordinates, ``p_a = T_a_b @ p_b``; column vectors, float64, shape (..., 4, 4).
* A twist is ``(omega [rad], v [mm])``, rotation first, and ``T = se3_exp(twist)``.
* Lengths are in mm, angles in rad, image coordinates in px with the centre of the top-left pixel at (0, 0).

Imports only `base` and numpy.
"""

from jawusd.geometry.anatomy import (
    LANDMARKS,
    anatomical_frame,
    bite_normal,
    find_landmarks,
    landmark_frame,
    mandible_metric,
)
from jawusd.geometry.camera import Camera
from jawusd.geometry.points import rigid_fit, rigid_fits, triangulate
from jawusd.geometry.se3 import (
    make_transform,
    orthonormalise,
    relative_pose,
    rigidity_defect,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_left_jacobian,
    se3_left_jacobian_inverse,
    se3_log,
    transform_point,
    transform_points,
)
from jawusd.geometry.so3 import (
    hat,
    matrix_from_wxyz,
    random_rotation,
    so3_exp,
    so3_left_jacobian,
    so3_left_jacobian_inverse,
    so3_log,
    wxyz_from_matrix,
)

__all__ = [
    "LANDMARKS",
    "Camera",
    "anatomical_frame",
    "bite_normal",
    "find_landmarks",
    "hat",
    "landmark_frame",
    "make_transform",
    "mandible_metric",
    "matrix_from_wxyz",
    "orthonormalise",
    "random_rotation",
    "relative_pose",
    "rigid_fit",
    "rigid_fits",
    "rigidity_defect",
    "se3_adjoint",
    "se3_exp",
    "se3_inverse",
    "se3_left_jacobian",
    "se3_left_jacobian_inverse",
    "se3_log",
    "so3_exp",
    "so3_left_jacobian",
    "so3_left_jacobian_inverse",
    "so3_log",
    "transform_point",
    "transform_points",
    "triangulate",
    "wxyz_from_matrix",
]
