"""Export a motion of a rig as binary glTF: skull, mandible and teeth, with an animated mandible node."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import AnyPath, RigError
from jawusd.base.version import __version__
from jawusd.evaluator import JawRig
from jawusd.formats.gltf import Material, Node, Surface, save_glb
from jawusd.formats.mesh import Mesh, natural_colors
from jawusd.rig.animation import bake_times
from jawusd.rig.geo import MATERIAL_LOOKS, MESH_PATHS, linear_from_srgb, read_geometry, read_gum, vertex_normals
from jawusd.rig.layout import MANDIBLE, SKULL

_HIGHEST_FRAME = 100_000.0  # largest frame number at which single precision resolves a hundredth of a frame
_SCAN = "Scan"  # name of the material of scans, which is white because vertex colours are multiplied by its colour


def write_glb(out: AnyPath, actor: AnyPath, rig: JawRig, frames: ArrayLike, d: ArrayLike, fps: float) -> Path:
    """Write the meshes of an actor and its motion in the skull frame; frame 0 is at 0 s (see `frame_at_zero`).

    The mandible has a key at every whole frame, and more where interpolation would deviate from the model. The
    animation's `extras` state the frame rate, first and last frame, and the frame at 0 s.

    Args:
        actor: `actor.usda`, or another stage of one actor.
        frames: Increasing frame numbers (F,).
        d: Parameters (F, 3) [mm]; rows with NaN are interpolated linearly.

    Raises:
        RigError: There are no meshes, or no frame has parameters.
        OutputError: The file cannot be written.
    """
    out = Path(out)
    meshes = read_geometry(actor, placeholders=True)
    placeholders = set(meshes)
    meshes |= read_geometry(actor)
    gums = read_gum(actor)
    frames, d = np.asarray(frames, dtype=np.float64), np.asarray(d, dtype=np.float64)
    known = np.isfinite(d).all(axis=1)
    if not meshes:
        raise RigError("has no meshes to write.", path=actor)
    if not known.any():
        raise RigError("no frame has parameters; there is nothing to animate.", path=out)
    times, poses = bake_times(rig, frames[known], d[known], frames[[0, -1]])
    parts: dict[str, list[Surface]] = {SKULL: [], MANDIBLE: []}
    for name, mesh in meshes.items():
        folder, title = MESH_PATHS[name].rsplit("/", 1)
        base = "Placeholder" if name in placeholders else "Enamel" if name.endswith("teeth") else "Bone"
        parts[folder].append(_surface(title, mesh, base, gums.get(name)))
    zero = frame_at_zero(frames)
    clock = {"fps": fps, "frames": frames[[0, -1]].tolist(), "frame_at_zero": zero}
    nodes = [
        Node("Skull", np.eye(4), parts[SKULL]),
        Node("Mandible", rig.T_rest, parts[MANDIBLE], (times - zero) / fps, poses),
    ]
    materials = {key: Material(*look) for key, look in MATERIAL_LOOKS.items()}
    materials[_SCAN] = Material((1.0, 1.0, 1.0), MATERIAL_LOOKS["Enamel"][1])
    used = {key for surface in (*parts[SKULL], *parts[MANDIBLE]) for key in surface.parts}
    materials = {key: material for key, material in materials.items() if key in used}
    save_glb(out, str(rig.meta.get("actor") or "Actor"), materials, nodes, f"jawusd {__version__}", clock)
    return out


def frame_at_zero(frames: Array) -> float:
    """Return the frame at 0 s in the .glb of a take with frames (F,): frame 0, or the first one.

    glTF has no times before 0, and its single precision resolves no high frame numbers.
    """
    return 0.0 if frames[0] >= 0 and frames[-1] <= _HIGHEST_FRAME else float(frames[0])


def _surface(title: str, mesh: Mesh, base: str, gum: Mask | None) -> Surface:
    colors = natural_colors(mesh)
    base = base if colors is None else _SCAN
    faces, vertex = mesh.faces, np.arange(len(mesh.vertices))
    uv = None
    if mesh.uv is not None:
        faces, vertex, uv = _split(mesh.faces, mesh.uv)
    parts: dict[str, NDArray[np.int32]] = {base: faces}
    if gum is not None and colors is None:
        parts = {base: faces[~gum], "Gum": faces[gum]}
    linear = None if colors is None else linear_from_srgb(colors)[vertex]
    return Surface(title, mesh.vertices[vertex], vertex_normals(mesh)[vertex], parts, linear, uv)


def _split(faces: NDArray[np.int32], uv: Array) -> tuple[NDArray[np.int32], NDArray[np.int64], Array]:
    """Split vertices on texture seams: faces (F, 3), and per new vertex the old index (n,) and coordinates (n, 2)."""
    corners = np.column_stack([faces.reshape(-1), uv.reshape(-1, 2)])
    rows, index = np.unique(corners, axis=0, return_inverse=True)
    return index.reshape(-1, 3).astype(np.int32), rows[:, 0].astype(np.int64), rows[:, 1:]
