"""A synthetic person with closed teeth: scans in frames of their own, and lines as drawn in photographs."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from subjects.bite import build_bite
from subjects.dentition import without_gum
from subjects.traits import draw_traits

from jawusd.geometry import make_transform, random_rotation, se3_inverse, so3_exp, transform_point
from jawusd.meshes.raster import draw_depth_labels, project
from jawusd.photographs import align, search

SIZE, FOCAL = (720, 540), 1500.0
VIEWS = {"front": 0.0, "left": 0.9, "right": -0.9}  # yaw


class Mouth:
    """A person of the population: both crowns moved to frames of their own, and pictures of the teeth together."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        self.bite = build_bite(replace(draw_traits(seed), gums="crowns"))
        self.T_own = [make_transform(random_rotation(rng), rng.normal(size=3) * 20) for _ in range(2)]
        self.meshes = []
        for arch, T in zip((self.bite.upper, self.bite.lower), self.T_own):
            crowns = without_gum(arch)
            self.meshes.append(replace(crowns, vertices=crowns.vertices @ T[:3, :3].T + T[:3, 3], colors=None))
        self.T_upper_lower = self.T_own[0] @ se3_inverse(self.T_own[1])
        self.incisor = transform_point(self.T_own[1], self.bite.incisor)

    def pose(self, yaw):
        """Return T_cam_world of a view; the world is the frame of the bite."""
        R = so3_exp([0.08, 0, 0]) @ np.diag([1.0, -1.0, -1.0]) @ so3_exp([0, yaw, 0])
        return make_transform(R, np.array([0.0, -2.0, 150.0]) - R @ [0.0, 0.0, -15.0])

    def draw(self, yaw):
        """Return lines as a person draws them, 3 px wide: where one tooth, gum or nothing meets another tooth."""
        K = np.array([[FOCAL, 0, 359.5], [0, FOCAL, 269.5], [0, 0, 1]])
        depth, labels = np.zeros(SIZE[::-1], np.float32), np.zeros(SIZE[::-1], np.uint8)
        for r, arch in enumerate((self.bite.upper, self.bite.lower)):
            points = np.empty((len(arch.mesh.vertices), 3), np.float32)
            project(arch.mesh.vertices.astype(np.float32), (K @ self.pose(yaw)[:3]).astype(np.float32), points)
            numbers = arch.tooth[arch.mesh.faces[:, 0]]
            for tooth in np.unique(numbers):
                label = 0 if tooth == 0 else int(tooth) + 20 + 40 * r
                draw_depth_labels(points, arch.mesh.faces[numbers == tooth], 0, 0, False, depth, labels, label)
        edge = np.zeros(labels.shape, np.uint8)
        edge[:, 1:][labels[:, 1:] != labels[:, :-1]] = 255
        edge[1:][labels[1:] != labels[:-1]] = 255
        return cv2.dilate(edge, np.ones((2, 2), np.uint8))

    def off_mm(self, T_upper_lower):
        """Return how far a bite puts the lower incisal point from where it is."""
        return float(
            np.linalg.norm(
                transform_point(T_upper_lower, self.incisor) - transform_point(self.T_upper_lower, self.incisor)
            )
        )

    def with_gum(self):
        """Return the scans with gum, which says which side of either row is up, painted."""
        out = []
        for arch, T in zip((self.bite.upper, self.bite.lower), self.T_own):
            mesh = arch.mesh
            out.append(replace(mesh, vertices=mesh.vertices @ T[:3, :3].T + T[:3, 3]))
        return out


def search_little(monkeypatch):
    """Search few directions, from small pictures, of scans whose gum says what is up."""
    monkeypatch.setattr(search, "_YAW", np.radians([-50.0, 0.0, 50.0]))
    monkeypatch.setattr(search, "_PITCH", np.radians([0.0]))
    monkeypatch.setattr(search, "_ROLL", np.radians([0.0]))
    monkeypatch.setattr(search, "_CANDIDATES", 3)
    monkeypatch.setattr(search, "_FINALISTS", 1)
    monkeypatch.setattr(search, "_UP_MM", (0.0,))
    monkeypatch.setattr(search, "_SLIDES", 2)
    monkeypatch.setattr(align, "_STAGES", ((0.25, (2.5, 2.0, 2.0, 1.5)), (0.5, (1.5, 1.2, 1.0, 1.0, 1.0))))
