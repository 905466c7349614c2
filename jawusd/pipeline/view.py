"""Show an actor and its motions in the viewer, or write them as a web page that needs no server."""

from __future__ import annotations

import re
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import AnyPath, CaptureError, FormatError, OutputError, RigError, explain_missing_packages
from jawusd.evaluator import JawRig
from jawusd.formats.atomic import refuse_existing
from jawusd.formats.keys import DEFAULT_FPS
from jawusd.formats.mesh import Mesh
from jawusd.geometry import transform_points
from jawusd.pipeline.state import recorded_verdict

if TYPE_CHECKING:
    from jawusd.meshes.contact import ContactMap, Teeth
    from jawusd.viewer.address import FirstPage
    from jawusd.viewer.motion import Clip
    from jawusd.viewer.server import Viewer
    from jawusd.viewer.viewed import ViewedActor, ViewedFootage

CAPTURED = "captured take"  # name under which the captured motion is listed among an actor's motions
CAPTURE_FILE = "capture.toml"
_TRACKS, _BAKED = "tracks.npz", "anim_capture.usdc"
_ANIMATION = re.compile(r"anim[A-Za-z0-9_-]{0,100}\.usd[ac]?")
_MOST_FACES = 8_000  # maximum number of faces of a mesh; browsers without a GPU render it smoothly


@explain_missing_packages()
def open_viewer(
    path: AnyPath | None,
    host: str,
    port: int,
    prim: str | None = None,
    *,
    play: bool = True,
    first: FirstPage | None = None,
) -> Viewer:
    """Serve the rig at a path to browsers; raises like `viewed_actor` and `PageServer`, and MissingDependencyError.

    With `play`, pages play the captured take, if there is one, when they are opened; `first` has served the page on the
    address so far.
    """
    from jawusd.viewer.server import Viewer

    return Viewer(partial(viewed_actor, path, prim), host, port, play=play, first=first)


def viewed_actor(path: AnyPath | None, prim: str | None = None) -> ViewedActor:
    """Load a rig for the viewer.

    Args:
        path: `actor.usda`, another layer or package that contains the rig, or the folder of a build; None: the example
            rig that ships with jawusd.
        prim: path of the rig's prim, if a stage has several; motions are then layers over the stage.

    Raises:
        FormatError, RigError: the file is not USD or not a rig, or the rig has no geometry.
    """
    from jawusd.rig.geo import read_geometry
    from jawusd.rig.read import describe, load_rig
    from jawusd.viewer.viewed import ViewedActor

    path = rig_file(path)
    rig, about = load_rig(path, prim), describe(path, prim)
    place, fps = about["prim"], float(about["fps"] or DEFAULT_FPS)
    return ViewedActor(
        name=str(about["actor"] or path.stem),
        rig=rig,
        meshes=screen_meshes(path, place),
        placeholders=frozenset(read_geometry(path, place, placeholders=True)),
        fps=fps,
        folder=path.parent,
        clip_names=partial(motion_names, path.parent),
        take=next((name for name in (CAPTURED, _BAKED) if name in motion_names(path.parent)), None),
        load_clip=partial(load_motion, path.parent, rig, fps, prim=prim),
        save_layer=partial(save_motion, path, rig, prim=prim),
        contacts=None if rig.contact is None else ContactView(path, rig, place).draw,
        verdict=recorded_verdict(path.parent) or "",
        footage=_footage(path.parent),
    )


def _footage(folder: Path) -> ViewedFootage | None:
    """Return the footage of a captured take; packages that read captures are loaded only for folders with tracks."""
    if not (folder / _TRACKS).is_file():
        return None
    from jawusd.pipeline.view_capture import take_footage

    return take_footage(folder)


def is_capture(path: Path) -> bool:
    """Return whether a path is a capture, not a rig."""
    return path.suffix == ".toml" or (path / CAPTURE_FILE).is_file()


def rig_file(path: AnyPath | None) -> Path:
    """Return the file of a rig, given that file or the folder of a build; None: the example rig."""
    if path is None:
        from jawusd.rig.layout import EXAMPLE_RIG

        return EXAMPLE_RIG
    path = Path(path)
    return path / "actor.usda" if path.is_dir() else path


class ContactView:
    """Renders the contacts of a rig's teeth; the scans are loaded when the first image is drawn."""

    def __init__(self, path: Path, rig: JawRig, prim: str) -> None:
        self._path, self._rig, self._prim = path, rig, prim

    @cached_property
    def _map(self) -> ContactMap:
        from jawusd.meshes.contact import ContactMap

        return ContactMap(self.teeth())

    def teeth(self) -> Teeth:
        """Return both arches as solids; raises RigError if the rig's meshes do not allow it."""
        from jawusd.pipeline.contact import teeth_of
        from jawusd.rig.geo import read_geometry

        return teeth_of(self._rig, read_geometry(self._path, self._prim))

    @explain_missing_packages()
    def draw(self, d: Array) -> NDArray[np.uint8]:
        """Return an image, RGB (h, w, 3), of both arches at d (3,) [mm]; raises like `teeth`."""
        return self._map.draw(self._rig.pose(d))


def screen_meshes(path: Path, prim: str) -> dict[str, Mesh]:
    """Return the decimated meshes of a rig, placeholders included, by the viewer's names; gum is separate.

    Raises RigError if the rig has neither a mandible nor lower teeth.
    """
    from jawusd.rig.geo import read_geometry, read_gum
    from jawusd.viewer.viewed import for_view

    meshes = read_geometry(path, prim) | read_geometry(path, prim, placeholders=True)
    gum = read_gum(path, prim)
    if not {"mandible", "lower_teeth"} & set(meshes):
        raise RigError("has no mandible to show.", path=path)
    parted: dict[str, Mesh] = {}
    for name, mesh in meshes.items():
        if name in gum:
            parted[name] = part_of(mesh, ~gum[name])
            parted[name.replace("teeth", "gum")] = part_of(mesh, gum[name])
        else:
            parted[name] = mesh
    return {name: for_view(mesh, _MOST_FACES) for name, mesh in parted.items() if len(mesh.faces)}


def part_of(mesh: Mesh, chosen: Mask) -> Mesh:
    """Return the faces of a mesh selected by a Boolean mask (F,), with the vertices that they use."""
    used, faces = np.unique(mesh.faces[chosen], return_inverse=True)
    colors = None if mesh.colors is None else mesh.colors[used]
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32), colors)


def motion_names(folder: Path) -> tuple[str, ...]:
    """Return the motions in the folder of an actor: the take, and layers named anim*."""
    layers = sorted(path.name for path in folder.iterdir() if _ANIMATION.fullmatch(path.name) and path.is_file())
    return ((CAPTURED,) if (folder / _TRACKS).is_file() else ()) + tuple(layers)


def load_motion(folder: Path, rig: JawRig, fps: float, name: str, *, prim: str | None = None) -> Clip:
    """Read one of the motions listed by `motion_names`, with its poses encoded as parameters.

    Raises FormatError or RigError if there is no such motion, or if it cannot be read.
    """
    from jawusd.formats.tracks import load_tracks
    from jawusd.rig.motion_read import read_poses_of_stage
    from jawusd.rig.read import describe
    from jawusd.viewer.motion import Clip

    if name not in motion_names(folder):
        raise FormatError(f'there is no motion called "{name}" here.', path=folder)
    if name == CAPTURED:
        tracks = load_tracks(folder / _TRACKS)
        frames, poses = tracks.frames, tracks.T_upper_lower
    else:
        frames, poses = read_poses_of_stage(folder / name, prim)
        fps = float(describe(folder / name, prim)["fps"])
    d, _ = rig.encode(poses)
    return Clip.of(name, frames, d, fps)


def save_motion(actor: Path, rig: JawRig, name: str, clip: Clip, overwrite: bool, *, prim: str | None = None) -> Path:
    """Write a motion as the animation layer anim*.usda or anim*.usdc in the folder of an actor or stage.

    Raises OutputError also if the name is not allowed or taken, or if the rig ships with jawusd.
    """
    from jawusd.rig.animation import write_animation
    from jawusd.rig.layout import EXAMPLE_RIG
    from jawusd.rig.rebake import write_over

    if not _ANIMATION.fullmatch(name):
        raise OutputError(f'"{name}" is not a valid name: use anim, then letters, digits, _ or -, then .usdc or .usda.')
    target = actor.parent / name
    if actor.parent.samefile(EXAMPLE_RIG.parent):
        raise OutputError(
            "animations are not written beside the example rig that ships with jawusd.",
            path=actor.parent,
            hint="Copy that folder, and view the copy.",
        )
    refuse_existing(target, overwrite)
    if prim is not None:
        return write_over(target, actor, rig, clip.frames, clip.d, clip.fps, prim)
    return write_animation(target, actor, clip.frames, clip.d, clip.fps, rig=rig)


# Size of an image (width, height), maximum number of images per camera, and their JPEG quality: 1 MB per camera.
_TILE_PX, _MOST_IMAGES, _QUALITY = (320, 240), 150, 50


@explain_missing_packages()
def write_page(path: AnyPath | None, out: Path, prim: str | None = None, *, footage: bool = False) -> None:
    """Write a page that poses the rig at a path, with the footage of its take if wanted; raises like `viewed_actor`.

    Raises CaptureError if there is no footage, RigError if contacts cannot be computed, and OutputError.
    """
    from jawusd.formats.report import ReplayPart
    from jawusd.report.jaw_pages import PosePage, write_pose_page
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
        footage=_page_footage(file.parent) if footage else None,
    )
    write_pose_page(out, page)


def _page_footage(folder: Path) -> dict[str, object]:
    """Return the footage of a build's take for pose.js, reduced in size and frame rate."""
    from jawusd.media.overlay import encode_jpeg
    from jawusd.pipeline.view_capture import take_footage
    from jawusd.report.templates import base64_text

    taken = take_footage(folder, _TILE_PX)
    if taken is None:
        raise CaptureError(
            "the footage of the take is not available: this is not the folder of a build, or its capture was moved.",
            path=folder,
            hint="Build the rig again, or leave out --footage.",
        )
    first, last = taken.frames
    step = -(-(last - first + 1) // _MOST_IMAGES)
    frames = range(first, last + 1, step)
    images = {
        name: [base64_text(encode_jpeg(taken.picture(name, frame), _QUALITY)) for frame in frames]
        for name in taken.cameras
    }
    return {"cameras": images, "first": first, "step": step}
