"""Write the web page of a rig that needs no server."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jawusd.base.errors import CaptureError, explain_missing_packages
from jawusd.formats.mesh import Mesh
from jawusd.formats.report import ReplayPart
from jawusd.geometry.se3 import transform_points
from jawusd.pipeline.view import ContactView, rig_file, viewed_actor

if TYPE_CHECKING:
    from jawusd.report.pose_page import PageFootage

# Size of an image (width, height), maximum number of images per camera, and their JPEG quality: 1 MB per camera.
_TILE_PX, _MOST_IMAGES, _QUALITY = (320, 240), 150, 50


@explain_missing_packages()
def write_page(
    path: str | os.PathLike[str] | None, out: Path, prim: str | None = None, *, footage: bool = False
) -> None:
    """Write a page that poses the rig at a path, with the footage of its take if wanted; see `viewed_actor`.

    Raises:
        CaptureError: there is no footage, or it cannot be decoded.
        OutputError: the file cannot be written.
        RigError: the contacts of the teeth cannot be computed from the rig's meshes.
        MissingDependencyError: a package is missing.
    """
    from jawusd.report.pose_page import PosePage, write_pose_page
    from jawusd.rig.read import describe
    from jawusd.rig.table import DEFAULT_SIZE, grid_axes, valid_box
    from jawusd.viewer.readouts import GHOSTS, GHOSTS_APART_MM
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
        ghosts=(GHOSTS, GHOSTS_APART_MM),
        teeth=ContactView(file, rig, str(describe(file, prim)["prim"])).teeth() if painted else None,
        footage=_footage(file.parent) if footage else None,
    )
    write_pose_page(out, page)


def _footage(folder: Path) -> PageFootage:
    """Return the footage of a build's take, reduced in size and frame rate."""
    from jawusd.media.overlay import encode_jpeg
    from jawusd.pipeline.view_capture import take_footage
    from jawusd.report.pose_page import PageFootage

    taken = take_footage(folder, _TILE_PX)
    if taken is None:
        raise CaptureError(
            "the footage of the take is not available: this is not the folder of a build, or its capture was moved.",
            path=folder,
            hint="Build the rig again, or leave out --footage.",
        )
    first, last = taken.frames
    step = -(-(last - first + 1) // _MOST_IMAGES)
    images = {
        name: tuple(encode_jpeg(taken.picture(name, frame), _QUALITY) for frame in range(first, last + 1, step))
        for name in taken.cameras
    }
    return PageFootage(images, first, step)
