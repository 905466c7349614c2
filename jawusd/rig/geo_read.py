"""Read the meshes of a rig back from its geometry layer."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from pxr import UsdGeom

from jawusd.errors import RigError
from jawusd.formats.mesh import Mesh
from jawusd.geometry.arrays import Mask
from jawusd.rig.geo import MESH_PATHS
from jawusd.rig.read import open_stage
from jawusd.rig.untrusted import blames_file


@blames_file(0)
def read_geometry(path: str | os.PathLike[str]) -> dict[str, Mesh]:
    """Read the meshes of `geo.usdc`.

    Args:
        path: the layer.

    Returns:
        Meshes by the names of `geo.MESH_PATHS`, skull ones in the skull frame, mandible ones in the mandible frame
        [mm], with the layer's single precision; those the rig does not have are missing, and so is a placeholder.

    Raises:
        RigError: not a USD file, or a mesh that is not made of triangles.
    """
    return _read(path, placeholders=False)


def read_placeholders(path: str | os.PathLike[str]) -> dict[str, Mesh]:
    """Return the meshes that only stand in for anatomy; else as `read_geometry`."""
    return _read(path, placeholders=True)


def _read(path: str | os.PathLike[str], *, placeholders: bool) -> dict[str, Mesh]:
    stage = open_stage(path)
    found = {}
    for name, prim_path in MESH_PATHS.items():
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(prim_path))
        if not mesh or bool(mesh.GetPrim().GetAttribute("jaw:placeholder").Get()) != placeholders:
            continue
        counts = np.array(mesh.GetFaceVertexCountsAttr().Get() or [])
        if not counts.size or (counts != 3).any():
            raise RigError(f"{prim_path} must be made of triangles.", path=Path(path))
        vertices = np.array(mesh.GetPointsAttr().Get(), dtype=np.float64)
        faces = np.array(mesh.GetFaceVertexIndicesAttr().Get(), dtype=np.int32).reshape(-1, 3)
        found[name] = Mesh(vertices, faces)
    return found


@blames_file(0)
def read_gum(path: str | os.PathLike[str]) -> dict[str, Mask]:
    """Read which faces of the teeth meshes are gum.

    Args:
        path: the layer.

    Returns:
        Per face, shape (F,), by the names of `geo.MESH_PATHS`; meshes without such a subset are missing.

    Raises:
        RigError: not a USD file.
    """
    stage = open_stage(path)
    found = {}
    for name, prim_path in MESH_PATHS.items():
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(prim_path))
        subset = UsdGeom.Subset(stage.GetPrimAtPath(f"{prim_path}/{prim_path.rsplit('/', 1)[1]}Gum"))
        if mesh and subset:
            gum = np.zeros(len(mesh.GetFaceVertexCountsAttr().Get()), dtype=bool)
            gum[np.array(subset.GetIndicesAttr().Get())] = True
            found[name] = gum
    return found
