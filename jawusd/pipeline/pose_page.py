"""Write the web page of a rig that needs no server."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from jawusd.base.errors import explain_missing_packages
from jawusd.formats.mesh import Mesh
from jawusd.formats.report import ReplayPart
from jawusd.geometry.se3 import transform_points
from jawusd.pipeline.view import ContactView, rig_file, viewed_actor


@explain_missing_packages()
def write_page(path: str | os.PathLike[str], out: Path, prim: str | None = None) -> None:
    """Write a page that poses the rig at a path; the arguments and further errors are those of `viewed_actor`.

    Raises:
        OutputError: the file cannot be written.
        RigError: the contacts of the teeth cannot be computed from the rig's meshes.
        MissingDependencyError: a package is missing.
    """
    from jawusd.report.pose_page import PosePage, write_pose_page
    from jawusd.rig.read import describe
    from jawusd.rig.table import DEFAULT_SIZE, grid_axes, valid_box
    from jawusd.viewer.viewed import MOVING

    file = rig_file(path)
    actor = viewed_actor(file, prim)
    rig = actor.rig
    parts = []
    for name, mesh in actor.meshes.items():
        moves = name in MOVING
        T = rig.T_anatomical_skull @ (rig.T_rest if moves else np.eye(4))
        kind = {"teeth": "tooth", "gum": "gum"}.get(name.rpartition("_")[2], "bone")
        parts.append(ReplayPart(name, kind, moves, Mesh(transform_points(T, mesh.vertices), mesh.faces)))
    moving = next(mesh for name, mesh in actor.meshes.items() if name in MOVING)
    clip = None if actor.take is None else actor.load_clip(actor.take)
    painted = rig.contact is not None and {"upper_teeth", "lower_teeth"} <= set(actor.meshes)
    page = PosePage(
        name=actor.name,
        rig=rig,
        parts=tuple(parts),
        axes=grid_axes(rig, valid_box(rig), moving.vertices, DEFAULT_SIZE),
        take=np.zeros((0, 3)) if clip is None else clip.at(np.arange(clip.span[0], clip.span[1] + 1)),
        first=0 if clip is None else round(clip.span[0]),
        fps=actor.fps if clip is None else clip.fps,
        teeth=ContactView(file, rig, str(describe(file, prim)["prim"])).teeth() if painted else None,
    )
    write_pose_page(out, page)
