"""The studio of the synthetic person: three cameras about 200 mm from the mouth, and a chessboard."""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.geometry import Camera, make_transform, se3_inverse, so3_exp
from jawusd.synthetic.soft_tissue import Surface
from jawusd.synthetic.surfaces import grid_faces

#: The scan frame to the world (the frame of the first camera: x right, y down, z forward) with the head at rest.
T_WORLD_SCAN = make_transform(np.diag([1.0, -1.0, -1.0]), [0.0, -14.0, 214.0])
BOARD_COLUMNS, BOARD_ROWS, SQUARE_MM = 9, 6, 8.0
# Focal length over picture width, and per camera: direction from the mouth [deg left, deg up], radial and tangential
# distortion, offset of the principal point and of the focal length in shares of the picture width.
_FOCAL = 1.494
_CAMERAS = (
    ((0.0, 0.0), (-0.031, 0.012, 0.0003, -0.0004, 0.0), (0.0043, -0.0031), 1.000),
    ((37.0, 9.0), (-0.027, 0.009, -0.0005, 0.0002, 0.0), (-0.0043, 0.0031), 1.005),
    ((-38.0, -6.0), (-0.034, 0.015, 0.0002, 0.0005, 0.0), (0.0026, 0.0048), 0.994),
)


def build_cameras(size_px: tuple[int, int]) -> list[Camera]:
    """Return the three cameras; the world is the frame of the first one."""
    width, height = size_px
    target = (T_WORLD_SCAN @ [0.0, -14.0, -6.0, 1.0])[:3]
    cameras = []
    for k, ((left, up), distortion, shift, zoom) in enumerate(_CAMERAS):
        a, b = np.deg2rad([left, up])
        # The subject's left is on the right side of the first camera's picture.
        turn = so3_exp([0.0, -a, 0.0]) @ so3_exp([-b, 0.0, 0.0])
        T_world_cam = np.eye(4)
        if k:
            T_world_cam = make_transform(turn, target - turn @ [0.0, 0.0, 206.0 + 3.0 * k])
        focal = _FOCAL * width * zoom
        K = np.array(
            [
                [focal, 0.0, width / 2 - 0.5 + shift[0] * width],
                [0.0, focal, height / 2 - 0.5 + shift[1] * width],
                [0.0, 0.0, 1.0],
            ]
        )
        cameras.append(Camera(f"cam{k}", size_px, K, np.array(distortion), se3_inverse(T_world_cam)))
    return cameras


def board() -> Surface:
    """Return the chessboard with a white rim, origin at its middle, x along the columns, facing -z."""
    columns, rows = BOARD_COLUMNS + 3, BOARD_ROWS + 3
    vertices, colors = [], []
    for i in range(rows):
        for j in range(columns):
            x, y = np.array([j - columns / 2, i - rows / 2]) * SQUARE_MM
            vertices += [[x + u, y + v, 0.0] for v in (0.0, SQUARE_MM) for u in (0.0, SQUARE_MM)]
            rim = i in (0, rows - 1) or j in (0, columns - 1)
            colors += [[0.03] * 3 if (i + j) % 2 == 0 and not rim else [0.85] * 3] * 4
    quads = len(vertices) // 4
    faces = (grid_faces(2, 2, closed=False)[None] + 4 * np.arange(quads)[:, None, None]).reshape(-1, 3)
    n = len(vertices)
    return Surface(np.array(vertices), faces.astype(np.int32), np.array(colors), np.zeros(n), np.zeros(n), np.zeros(n))


def board_poses(n: int, rng: np.random.Generator) -> Array:
    """Return n random poses T_world_board (n, 4, 4) near the place of the mouth, in view of all cameras."""
    centre = (T_WORLD_SCAN @ [0.0, -12.0, -10.0, 1.0])[:3]
    tilt = rng.uniform(-1.0, 1.0, (n, 3)) * np.deg2rad([24.0, 22.0, 14.0])
    shift = rng.uniform(-1.0, 1.0, (n, 3)) * [14.0, 8.0, 18.0]
    R = so3_exp(tilt)
    # Every second pose is turned by 180 degrees.
    R[1::2] = R[1::2] @ np.diag([-1.0, -1.0, 1.0])
    return make_transform(R, centre + shift)
