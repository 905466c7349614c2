"""The person in the studio: surfaces with colours and labels, posed at an instant of a take, drawn by the renderer."""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.mesh import Mesh
from jawusd.geometry import transform_points
from jawusd.synthetic.anatomy import PersonAnatomy
from jawusd.synthetic.dental_arch import DentalArch
from jawusd.synthetic.person import Person
from jawusd.synthetic.render import LOWER_TEETH, UPPER_TEETH, Picture, Renderer
from jawusd.synthetic.soft_tissue import Face, LipState, Surface, palate, tongue
from jawusd.synthetic.take import Take

_ENAMEL = np.array([0.80, 0.745, 0.63])
_GUM = np.array([0.56, 0.22, 0.21])
# Canines are yellower, and enamel darkens towards the gum.
_CANINE_TINT = np.array([0.975, 0.955, 0.91])


class Scene:
    """All surfaces of one person, ready to be drawn."""

    def __init__(self, person: Person, anatomy: PersonAnatomy, renderer: Renderer) -> None:
        """Add the person's surfaces to the renderer."""
        self._renderer = renderer
        self.anatomy = anatomy
        self._face = Face(person.joint.incisor)
        for name, arch, label in (("upper", anatomy.upper, UPPER_TEETH), ("lower", anatomy.lower, LOWER_TEETH)):
            crowns, gum = _arch_surfaces(arch)
            renderer.add(f"{name} teeth", crowns, label)
            renderer.add(f"{name} gum", gum)
        face = self._face
        vertices = face.posed(LipState(8.2, 8.2, 27.5, 0.0), np.eye(4))
        renderer.add("face", Surface(vertices, face.faces, face.colors, face.gloss, face.skin, face.inside))
        renderer.add("palate", palate())
        renderer.add("tongue", tongue(0.0, 0.0, 0.0))

    def pose(self, take: Take, index: int) -> dict[str, Array]:
        """Shape lips and tongue for an instant of a take and return the surfaces' poses T_world_part, (4, 4) each."""
        T_jaw, head = take.T_skull_mandible[index], take.T_world_skull[index]
        self._renderer.move("face", self._face.posed(take.lips[index], T_jaw))
        self._renderer.move("tongue", tongue(*take.tongue_mm[index]).vertices)
        jaw = head @ T_jaw
        return {
            "upper teeth": head, "upper gum": head, "palate": head, "face": head,
            "lower teeth": jaw, "lower gum": jaw, "tongue": jaw,
        }  # fmt: skip

    def draw(
        self, camera: int, take: Take, index: int, poses: dict[str, Array], jitter_px: tuple[Array, Array] | None
    ) -> Picture:
        """Draw an instant; `poses` as returned by `pose` for it, `jitter_px` as for `Renderer.render`."""
        return self._renderer.render(camera, poses, take.T_world_skull[index], float(take.light[index]), jitter_px)

    def occluders(self, take: Take, index: int) -> list[Mesh]:
        """Return everything that can hide a tooth at an instant, in world coordinates [mm]."""
        T_jaw, head = take.T_skull_mandible[index], take.T_world_skull[index]
        tongue_now = tongue(*take.tongue_mm[index])
        parts = (
            (head, self.anatomy.upper.mesh),
            (head @ T_jaw, self.anatomy.lower.mesh),
            (head, Mesh(self._face.posed(take.lips[index], T_jaw), self._face.faces)),
            (head @ T_jaw, Mesh(tongue_now.vertices, tongue_now.faces)),
        )
        return [Mesh(transform_points(T, mesh.vertices), mesh.faces) for T, mesh in parts]


def _arch_surfaces(arch: DentalArch) -> tuple[Surface, Surface]:
    """Crowns and gum of an arch in natural colours."""
    tooth = arch.tooth != 0
    first_gum = int(np.argmin(tooth))
    vertices, faces = arch.mesh.vertices, arch.mesh.faces
    crown_faces = faces[faces[:, 0] < first_gum]
    gum_faces = faces[faces[:, 0] >= first_gum] - first_gum
    colors = np.tile(_ENAMEL, (first_gum, 1))
    for k in np.unique(arch.tooth[:first_gum]):
        own = arch.tooth[:first_gum] == k
        height = np.abs(vertices[:first_gum][own, 1])
        share = (height - height.min()) / np.ptp(height)  # 0 at the end towards the other jaw
        colors[own] *= 1.0 - 0.16 * share[:, None] * np.array([0.6, 0.8, 1.3])
        if abs(k) == 3:
            colors[own] *= _CANINE_TINT
    n, m = first_gum, len(vertices) - first_gum
    crowns = Surface(vertices[:n], crown_faces, colors, np.full(n, 0.5), np.zeros(n), np.ones(n))
    gum = Surface(vertices[n:], gum_faces, np.tile(_GUM, (m, 1)), np.full(m, 0.4), np.full(m, 0.3), np.ones(m))
    return crowns, gum
