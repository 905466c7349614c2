"""Pictures of a face with freckles, drawn as dots: skin that slides and lags over the bone, without a renderer."""

from __future__ import annotations

import cv2
import numpy as np
from skin_shot import closed_share, slides

from jawusd.geometry import transform_points
from jawusd.meshes.surfaces import vertex_normals
from jawusd.synthetic.anatomy import Face, LipState
from jawusd.synthetic.exercises import record, smooth_noise, smoothed
from jawusd.synthetic.person import Person
from jawusd.synthetic.take import _head, build_cameras

_RANGE = np.array([0.35, 0.6, 0.6])  # of the jaw behind closed lips
_SEEN_MM = 3.5


class DottedFace:
    """A shot of one person; reads like `ColourFootage`.

    Attributes:
        cameras: by name.
        T_world_head, T_jaw: true poses (F, 4, 4).
        closed: how far the lips are closed, (F,).
        seen: frames in which teeth are visible, (F,).
    """

    def __init__(self, seed, frames=200, closings=((85, 120), (145, 185)), dots=900, size_px=(480, 360)):
        rng = np.random.default_rng([seed, 0xD07])
        self.person, self.rng = Person(seed), rng
        self.cameras = {camera.name: camera for camera in build_cameras(size_px)}
        take = record(self.person, frames + 24, seed)
        self.closed = closed_share(frames, closings)
        calm = smoothed(self.closed[:, None])
        controls = take.controls[24:] * (1 - calm * (1 - _RANGE))
        controls[:, 0] = np.maximum(controls[:, 0], 0.12 * np.clip(1 - calm[:, 0], 0, 1))  # teeth are in sight
        extra = 0.2 * smooth_noise(rng, frames, 8.0, 3)
        self.T_jaw = self.person.pose_with_extra(self.person.limit(controls), extra)
        self.T_world_head = _head(frames, rng)
        incisor = self.person.joint.incisor
        self.face = Face(incisor)
        low = transform_points(self.T_jaw, incisor[None])[:, 0, 1]
        self.opening_mm = incisor[1] - low
        self.seen = (self.opening_mm > _SEEN_MM) & (self.closed < 0.3)
        self.lips = [lip_state(share, y, incisor[1]) for share, y in zip(self.closed, low)]
        self.slide_mm = slides(self.face, self.lips, self.T_jaw, rng)
        first = len(self.slide_mm[0]) * (self.face.rows - 28) // self.face.rows  # vertex of the skin beside the lips
        faces = self.face.faces[self.face.faces.min(1) >= first]
        corners = self.vertices(0)[faces]
        # as densely as seen from the front
        area = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2])
        self.triangles = faces[rng.choice(len(faces), dots, p=area / area.sum())]
        weights = rng.uniform(0, 1, (dots, 2))
        weights = np.where(weights.sum(1, keepdims=True) > 1, 1 - weights, weights)
        self.weights = np.column_stack([1 - weights.sum(1), weights])
        self.grain = rng.normal(0, 2.0, (4, size_px[1], size_px[0]))
        self.radius_mm, self.dark = rng.uniform(0.4, 1.1, dots), rng.uniform(25, 70, dots)

    def vertices(self, frame):
        """Return the vertices of the face in the skull frame (V, 3) [mm]."""
        return self.face.posed(self.lips[frame], self.T_jaw[frame]) + self.slide_mm[frame]

    def at(self, frame):
        """Return the pictures (H, W, 3) of all cameras."""
        T, vertices = self.T_world_head[frame], self.vertices(frame)
        normals = -vertex_normals(vertices, self.face.faces)
        at, normal = (np.einsum("dk,dkj->dj", self.weights, of[self.triangles]) for of in (vertices, normals))
        facing = np.sign((normals[len(normals) // 2 :] @ [0, 0, 1.0]).sum())
        return {name: self._picture(camera, T, at, normal * facing, frame) for name, camera in self.cameras.items()}

    def walk(self, frames):
        """Yield frame numbers with their pictures."""
        for frame in frames:
            yield frame, self.at(frame)

    def _picture(self, camera, T, at, normal, frame):
        world, eye = transform_points(T, at), camera.centre_world()
        to = eye - world
        facing = ((normal @ T[:3, :3].T) * to).sum(1) / np.linalg.norm(to, axis=1)
        px = camera.project(world)
        size = camera.K[0, 0] / camera.depth(world)
        image = np.full((camera.size_px[1], camera.size_px[0]), 150, np.uint8)
        for k in np.flatnonzero(facing > 0.3):
            centre = np.rint(16 * px[k]).astype(int).tolist()
            radius = max(round(16 * self.radius_mm[k] * size[k]), 8)
            cv2.circle(image, centre, radius, 150 - self.dark[k], -1, cv2.LINE_AA, 4)
        noisy = cv2.GaussianBlur(image, (0, 0), 0.7) + self.grain[frame % 4]
        return np.repeat(np.clip(np.rint(noisy), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def lip_state(share, low, incisor_y):
    """Return lips that are closed by a share over a jaw whose lower incisal point is at some height [mm]."""
    meet = min(-0.8, 0.5 * low - 1.5)
    upper, lower = 8.2 * (1 - share) + share * (meet - 0.3), 8.2 * (1 - share) + share * (low - meet - 0.3)
    return LipState(float(upper), float(lower), 27.5 - 1.5 * float(share), 0.0)
