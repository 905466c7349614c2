"""How a scan looks: its colours and texture coordinates as primvars of its mesh, written and read."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, UsdGeom

from jawusd.base.arrays import Array
from jawusd.formats.mesh import Mesh, natural_colors
from jawusd.rig import _gf

_UV = "st"  # the name readers look for


def write_look(prim: UsdGeom.Mesh, mesh: Mesh, plain: tuple[float, float, float]) -> None:
    """Write displayColor, per vertex where the scan has natural colours, else the plain one; and texture coordinates.

    Args:
        plain: linear red, green, blue.
    """
    colors = natural_colors(mesh)
    if colors is None:
        prim.CreateDisplayColorAttr([plain])
    else:
        shown = prim.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
        shown.Set(_gf.vec3f_array(linear_from_srgb(colors)))
    if mesh.uv is not None:
        kind = Sdf.ValueTypeNames.TexCoord2fArray
        places = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(_UV, kind, UsdGeom.Tokens.faceVarying)
        places.Set(_gf.vec2f_array(mesh.uv.reshape(-1, 2)))


def hide_look(prim: UsdGeom.Mesh, mesh: Mesh, below: Mesh) -> None:
    """Keep the look of a weaker layer's mesh, which has other points, from showing through that of this one."""
    if natural_colors(mesh) is None and natural_colors(below) is not None:
        prim.GetDisplayColorPrimvar().SetInterpolation(UsdGeom.Tokens.constant)
    if mesh.uv is None and below.uv is not None:
        UsdGeom.PrimvarsAPI(prim).CreatePrimvar(_UV, Sdf.ValueTypeNames.TexCoord2fArray).GetAttr().Block()


def read_look(prim: UsdGeom.Mesh, vertices: int, faces: int) -> tuple[NDArray[np.uint8] | None, Array | None]:
    """Return colours per vertex (V, 3) and texture coordinates of the corners (F, 3, 2); None where there are none."""
    shown = prim.GetDisplayColorPrimvar()
    colors = _values(shown, (vertices, 3)) if shown.GetInterpolation() == UsdGeom.Tokens.vertex else None
    places = _values(UsdGeom.PrimvarsAPI(prim).GetPrimvar(_UV), (3 * faces, 2))
    return (
        None if colors is None else srgb_from_linear(colors),
        None if places is None else places.reshape(faces, 3, 2),
    )


def _values(primvar: UsdGeom.Primvar, shape: tuple[int, int]) -> Array | None:
    """Return the values of a primvar if they have a shape and are finite."""
    found = np.array((primvar.ComputeFlattened() if primvar else None) or (), dtype=np.float64)
    return found if found.shape == shape and np.isfinite(found).all() else None


def linear_from_srgb(colors: NDArray[np.uint8]) -> Array:
    """Return linear values 0 .. 1, as USD has them, of 8 bit sRGB ones (IEC 61966-2-1)."""
    coded = colors / 255.0
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(values: Array) -> NDArray[np.uint8]:
    """Return 8 bit sRGB values of linear ones (IEC 61966-2-1), those beyond 0 .. 1 clipped."""
    linear = np.clip(np.asarray(values, dtype=np.float64), 0.0, 1.0)
    coded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(255 * coded).astype(np.uint8)
