"""A small mouth made in code: two arches of bumpy teeth with gum, cameras, and the masks they give."""

from __future__ import annotations

import cv2
import numpy as np

from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera, make_transform, se3_exp, se3_inverse, so3_exp
from jawusd.meshes.raster import draw_depth_labels, project

RED, GREY = (215, 45, 40), (150, 150, 150)
TEETH = 8
SIZE_PX = (640, 400)


def _tooth(centre: np.ndarray, turn_rad: float, half_mm: np.ndarray, rng: np.random.Generator) -> tuple:
    """Return a closed rounded box with a few bumps, winding outwards."""
    across, around = 14, 20
    a, b = np.meshgrid(np.linspace(0, np.pi, across + 1)[1:-1], np.linspace(0, 2 * np.pi, around, endpoint=False))
    ring = np.stack([np.sin(a.T) * np.cos(b.T), np.cos(a.T), np.sin(a.T) * np.sin(b.T)], -1).reshape(-1, 3)
    points = np.concatenate([[[0, 1, 0]], ring, [[0, -1, 0]]])
    points = np.sign(points) * np.abs(points) ** 0.7
    bumps = 1 + 0.06 * np.sin(points @ rng.normal(size=(3, 3)) * 4).sum(1, keepdims=True)
    points = points * bumps * half_mm @ so3_exp(np.array([0, turn_rad, 0])).T + centre
    faces = [[0, 1 + (j + 1) % around, 1 + j] for j in range(around)]
    for i in range(across - 2):
        for j in range(around):
            p, q = 1 + i * around + j, 1 + i * around + (j + 1) % around
            faces += [[p, q, p + around], [q, q + around, p + around]]
    last, base = len(points) - 1, 1 + (across - 2) * around
    faces += [[last, base + j, base + (j + 1) % around] for j in range(around)]
    return points, np.array(faces)


def _gum(curve: np.ndarray, radius_mm: float) -> tuple:
    """Return an open tube along a curve in the horizontal plane."""
    around = 16
    along = np.gradient(curve, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along, [0, 1, 0])
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    ring = side[:, None] * np.cos(angle)[None, :, None] + np.array([0, 1, 0]) * np.sin(angle)[None, :, None]
    points = (curve[:, None] + radius_mm * ring).reshape(-1, 3)
    faces = []
    for i in range(len(curve) - 1):
        for j in range(around):
            p, q = i * around + j, i * around + (j + 1) % around
            faces += [[p, p + around, q], [q, p + around, q + around]]
    return points, np.array(faces)


def arch(upper: bool, seed: int = 0, painted: bool = True) -> Mesh:
    """Return one row of eight teeth in a common scan frame: x left, y up, z forward, in mm."""
    rng = np.random.default_rng(seed + upper)
    sign = 1.0 if upper else -1.0
    x = np.linspace(-1, 1, TEETH) * (20.0 if upper else 18.5)
    depth = 0.045 if upper else 0.05
    parts, colors = [], []
    for k, across in enumerate(x):
        half = np.array([3.1 - 0.05 * abs(across) + 0.3 * rng.random(), 5.0 + rng.random(), 2.6])
        centre = np.array([across, sign * 4.6, -depth * across**2 - (0.0 if upper else 1.5)])
        parts.append(_tooth(centre, np.arctan(2 * depth * across), half, rng))
        colors.append(np.tile(RED, (len(parts[k][0]), 1)))
    t = np.linspace(-1.15, 1.15, 40) * x.max()
    line = np.column_stack([t, np.full(40, sign * 10.5), -depth * t**2 - (0.0 if upper else 1.5)])
    parts.append(_gum(line, 4.0))
    colors.append(np.tile(GREY, (len(parts[-1][0]), 1)))
    starts = np.cumsum([0, *(len(p) for p, _ in parts)])
    vertices = np.concatenate([p for p, _ in parts])
    faces = np.concatenate([f + s for (_, f), s in zip(parts, starts)])
    return Mesh(vertices, faces, np.concatenate(colors).astype(np.uint8) if painted else None)


def make_cameras(yaw_deg: tuple[float, ...] = (0.0, 35.0, -35.0), distortion: float = 0.0) -> list[Camera]:
    """Return cameras 200 mm in front of the mouth, named cam0, cam1, ...; about 6 px/mm."""
    out = []
    for k, yaw in enumerate(np.radians(yaw_deg)):
        # Look along -z of the mouth with y up: a half turn about x, after the yaw.
        R = so3_exp(np.array([np.pi, 0, 0])) @ so3_exp(np.array([0, yaw, 0])) @ so3_exp(np.array([0.1 * (k % 2), 0, 0]))
        K = np.array([[1250.0, 0, SIZE_PX[0] / 2 - 3.3], [0, 1250.0, SIZE_PX[1] / 2 + 2.1], [0, 0, 1]])
        coefficients = np.array([distortion, 0, 0, 0, 0]) if distortion else np.zeros(0)
        out.append(Camera(f"cam{k}", SIZE_PX, K, coefficients, make_transform(R, [0, 0, 200.0])))
    return out


def jaw_poses(times: int | np.ndarray, seed: int = 3) -> np.ndarray:
    """Return T_world_upper, T_world_lower of a nodding head that opens its mouth, shape (count, 2, 4, 4).

    Args:
        times: instants in frames, or how many frames from 0 on.
        seed: seed of the head's motion.
    """
    rng = np.random.default_rng(seed)
    wave = rng.normal(size=(6,)) * [0.02, 0.03, 0.02, 0.8, 0.6, 0.8]
    times = np.arange(times) if np.ndim(times) == 0 else times
    out = np.empty((len(times), 2, 4, 4))
    for k, t in enumerate(times):
        head = se3_exp(wave * np.sin(0.25 * t + np.arange(6)))
        opening = 4.0 + 3.0 * np.sin(0.3 * t)
        jaw = se3_exp([0.012 * opening, 0.004 * np.sin(t / 3), 0, 0.3 * np.sin(t / 4), -0.6 * opening, 0.1 * opening])
        out[k] = head, head @ jaw
    return out


def render_masks(
    meshes: tuple[Mesh, Mesh],
    poses: np.ndarray,
    camera: Camera,
    lips_mm: tuple[float, float] | None = None,
    noise_px: float = 0.0,
    rng: np.random.Generator | None = None,
    fine: int = 3,
    grown_px: float = 0.0,
    smooth_px: float = 3.0,
) -> np.ndarray:
    """Return the visible crowns of both rows as soft masks, (2, h, w) uint8.

    Args:
        meshes: upper and lower.
        poses: T_world_upper, T_world_lower, shape (2, 4, 4).
        camera: without distortion.
        lips_mm: heights above and below which lips hide everything, in the head's frame at its front teeth.
        noise_px: standard deviation of a smooth error of the outline.
        rng: source of that error.
        fine: sub-pixels per side; odd, or thresholding the result at one half would widen it.
        grown_px: how far the outline lies outside of the teeth.
        smooth_px: standard deviation of the Gaussian filter that makes the error smooth.
    """
    width, height = camera.size_px
    big = camera.scaled((width * fine, height * fine))
    depth = np.zeros((height * fine, width * fine), np.float32)
    labels = np.zeros(depth.shape, np.uint8)
    for r, mesh in enumerate(meshes):
        points = np.empty((len(mesh.vertices), 3), np.float32)
        matrix = (big.projection_matrix() @ poses[r]).astype(np.float32)
        project(mesh.vertices.astype(np.float32), matrix, points)
        red = mesh.colors[mesh.faces[:, 0], 0] > 200 if mesh.colors is not None else np.ones(len(mesh.faces), bool)
        for faces, label in ((mesh.faces[red], r + 1), (mesh.faces[~red], r + 3)):
            draw_depth_labels(points, np.ascontiguousarray(faces), 0, 0, False, depth, labels, label)
    masks = np.stack([labels == 1, labels == 2])
    if lips_mm is not None:
        for height_mm, above in zip(lips_mm, (True, False)):
            edge = big.project((poses[0] @ [0, height_mm, 3.0, 1.0])[:3])[1]
            rows = np.arange(depth.shape[0])
            masks[:, rows < edge if above else rows > edge] = False
    out = np.stack([cv2.resize(m.astype(np.uint8) * 255, (width, height), interpolation=cv2.INTER_AREA) for m in masks])
    return np.stack([_shaken(m, noise_px, grown_px, smooth_px, rng) for m in out]) if noise_px else out


def _shaken(
    mask: np.ndarray, sigma_px: float, grown_px: float, smooth_px: float, rng: np.random.Generator
) -> np.ndarray:
    """Move the outline of a mask by a smooth random field, and outwards."""
    inside = (mask > 127).astype(np.uint8)
    signed = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
    signed = np.where(inside > 0, signed - 0.5, signed + 0.5)
    field = cv2.GaussianBlur(rng.normal(size=mask.shape), (0, 0), smooth_px)
    signed = signed + grown_px + field * sigma_px / field.std()
    return np.clip(127.5 + 255 * signed, 0, 255).astype(np.uint8)


def disturbed(poses: np.ndarray, mm: float, rad: float, rng: np.random.Generator) -> np.ndarray:
    """Return poses moved by mm and turned by rad in random directions about the front teeth, shape (2, 4, 4)."""
    out = []
    for pose in poses:
        twist = rng.normal(size=6)
        twist[:3] *= rad / np.linalg.norm(twist[:3])
        twist[3:] *= mm / np.linalg.norm(twist[3:])
        to = make_transform(np.eye(3), -pose[:3, 3])
        out.append(se3_inverse(to) @ se3_exp(twist) @ to @ pose)
    return np.stack(out)


def vertex_error_mm(mesh: Mesh, pose: np.ndarray, truth: np.ndarray) -> float:
    """Return the mean distance between the vertices under two poses."""
    change = pose - truth
    return float(np.linalg.norm(mesh.vertices @ change[:3, :3].T + change[:3, 3], axis=1).mean())
