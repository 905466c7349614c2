"""Cameras that lie on their side or hang upside down."""

from dataclasses import replace

import numpy as np

from jawusd.geometry import Camera


def turned(camera: Camera) -> Camera:
    """Return a camera whose image is turned counter-clockwise by a quarter: (x, y) becomes (y, width - 1 - x)."""
    turn = np.eye(4)
    turn[:2, :2] = [[0.0, 1.0], [-1.0, 0.0]]
    (fx, _, cx), (_, fy, cy), _ = camera.K
    K = np.array([[fy, 0.0, cy], [0.0, fx, camera.size_px[0] - 1 - cx], [0.0, 0.0, 1.0]])
    lens = np.array(camera.distortion)
    if len(lens):
        lens[2:4] = -lens[3], lens[2]
    return replace(camera, size_px=camera.size_px[::-1], K=K, distortion=lens, T_cam_world=turn @ camera.T_cam_world)
