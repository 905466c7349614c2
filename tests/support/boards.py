"""Cameras looking at boards, projected and drawn by OpenCV: what calibration is tested against."""

from __future__ import annotations

import cv2
import numpy as np

from jawusd.capture.boards import BoardDetections
from jawusd.formats.capture import Boards, Capture
from jawusd.geometry import Camera, make_transform, se3_inverse, so3_exp

SIZE = (640, 480)
CENTRE = np.array([0.0, 0.0, 200.0])


def studio(size=SIZE, focal=900.0, lens=(-0.05, 0.03)):
    """Return three cameras 200 mm from a point; the first is the world."""
    cameras = []
    for k, yaw in enumerate((0.0, 0.6, -0.55)):
        R = so3_exp([0.05 * k, yaw, 0.02 * k])
        T_world_cam = make_transform(R, CENTRE - R @ CENTRE)
        K = np.array([[focal + 7 * k, 0, size[0] / 2 + 5 * k], [0, focal + 5 * k, size[1] / 2 - 4 * k], [0, 0, 1]])
        cameras.append(Camera(f"c{k}", size, K, np.array([*lens, 0, 0, 0]), se3_inverse(T_world_cam)))
    return cameras


def poses(count, rng, centre=CENTRE, tilt=0.45):
    """Draw T_world_board."""
    return make_transform(
        so3_exp(rng.uniform(-tilt, tilt, (count, 3))), centre + rng.uniform(-1, 1, (count, 3)) * [12, 8, 15]
    )


def corner_grid(boards):
    """Return inner corners row by row about the middle, by plain loops."""
    return np.array(
        [
            [(i - (boards.cols - 1) / 2) * boards.square_mm, (j - (boards.rows - 1) / 2) * boards.square_mm, 0.0]
            for j in range(boards.rows)
            for i in range(boards.cols)
        ]
    )


def opencv_pixels(camera, points_world):
    """Project with OpenCV."""
    R, t = camera.T_cam_world[:3, :3], camera.T_cam_world[:3, 3]
    return cv2.projectPoints(points_world, cv2.Rodrigues(R)[0], t, camera.K, camera.distortion)[0].reshape(-1, 2)


def detections(cameras, boards, T_world_board, rng, noise_px=0.1):
    """Return what a detector would find."""
    grid = corner_grid(boards)
    corners = np.array(
        [[opencv_pixels(c, grid @ T[:3, :3].T + T[:3, 3]) for T in T_world_board] for c in cameras]
    ) + rng.normal(0, noise_px, (len(cameras), len(T_world_board), len(grid), 2))
    names = tuple(c.name for c in cameras)
    nothing = {name: [] for name in names}
    return BoardDetections(
        names, tuple(c.size_px for c in cameras), np.arange(len(T_world_board)), corners, nothing, nothing, ()
    )


def chessboard(boards, px_per_square=60):
    """Draw a chessboard with a white rim; return it and the affine map from board mm to its pixels."""
    cells = np.indices((boards.rows + 1, boards.cols + 1)).sum(0) % 2
    image = np.kron(cells, np.ones((px_per_square, px_per_square))) * 200 + 30
    return _rimmed(image.astype(np.uint8), boards, px_per_square)


def charuco(boards, px_per_square=60, legacy=False):
    """Draw a ChArUco board with a white rim, as `chessboard`; legacy: as OpenCV did before version 4.6."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, boards.dictionary))
    size = (boards.cols + 1, boards.rows + 1)
    board = cv2.aruco.CharucoBoard(size, boards.square_mm, boards.marker_mm, dictionary)
    board.setLegacyPattern(legacy)
    image = board.generateImage((size[0] * px_per_square, size[1] * px_per_square), marginSize=0)
    return _rimmed(image, boards, px_per_square)


def _rimmed(image, boards, px):
    padded = cv2.copyMakeBorder(image, px, px, px, px, cv2.BORDER_CONSTANT, value=230)
    scale = px / boards.square_mm
    # The middle of the board lies between pixels: pixel centres are integers.
    middle = [(padded.shape[1] - 1) / 2, (padded.shape[0] - 1) / 2]
    return padded, np.array([[scale, 0, middle[0]], [0, scale, middle[1]], [0, 0, 1]])


def photograph(camera, T_world_board, texture, to_texture):
    """Return the picture a distortion-free camera takes of a board (a homography, twice oversampled)."""
    T = camera.T_cam_world @ T_world_board
    H = camera.K @ T[:3][:, [0, 1, 3]] @ np.linalg.inv(to_texture)
    twice = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1.0]])
    size = (camera.size_px[0] * 2, camera.size_px[1] * 2)
    image = cv2.warpPerspective(texture, twice @ H, size, flags=cv2.INTER_AREA, borderValue=110)
    return cv2.resize(image, camera.size_px, interpolation=cv2.INTER_AREA)


def capture_of(cameras, boards, folder, bootstrap=None):
    """Return a capture with these boards."""
    return Capture(
        folder=folder, name="x", fps=24, scans={"upper_teeth": "u.ply", "lower_teeth": "l.ply"},
        cameras=[{"name": c.name, "video": folder / "x.mp4"} for c in cameras],
        boards=boards, bootstrap=bootstrap,
    )  # fmt: skip


def board(pattern="chessboard", cols=9, rows=6, square_mm=5.0, videos=("a", "b", "c"), **more):
    """Return a board description."""
    return Boards(pattern=pattern, cols=cols, rows=rows, square_mm=square_mm, videos=videos, **more)
