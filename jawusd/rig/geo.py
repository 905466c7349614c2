"""The geometry payload: skull, teeth and mandible with normals, materials, colours and texture coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdShade

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import AnyPath, RigError
from jawusd.formats.mesh import Mesh, crown_face_mask, natural_colors, without_loose
from jawusd.meshes import surfaces
from jawusd.rig import layers
from jawusd.rig.attributes import value_of
from jawusd.rig.layers import add_pose, define_prim, new_layer, set_attribute, stage_of
from jawusd.rig.layout import ACTOR, GEO, MANDIBLE, MATERIALS, SKULL, rig_prims
from jawusd.rig.placeholder import Estimate
from jawusd.rig.read import find_rig_prim, open_stage
from jawusd.rig.untrusted import raises_format_error

# Mesh names differ from those of their parents, because Blender merges an Xform with its only child, keeping its name.
MESH_PATHS = {
    "skull": f"{SKULL}/SkullMesh",
    "upper_teeth": f"{SKULL}/UpperTeethMesh",
    "mandible": f"{MANDIBLE}/MandibleMesh",
    "lower_teeth": f"{MANDIBLE}/LowerTeethMesh",
}
_REQUIRED = ("upper_teeth", "lower_teeth")

# base colour (linear RGB) and roughness
MATERIAL_LOOKS = {
    "Enamel": ((0.85, 0.80, 0.70), 0.25),
    "Gum": ((0.55, 0.16, 0.15), 0.45),
    "Bone": ((0.75, 0.68, 0.54), 0.70),
    "Placeholder": ((0.35, 0.45, 0.60), 0.90),
}
_UV = "st"  # the conventional name of the primvar


def write_look(prim: UsdGeom.Mesh, mesh: Mesh, plain: tuple[float, float, float]) -> None:
    """Write a scan's texture coordinates and, as displayColor, its natural colours per vertex or a plain linear RGB."""
    colors = natural_colors(mesh)
    if colors is None:
        prim.CreateDisplayColorAttr([plain])
    else:
        shown = prim.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
        shown.Set(layers.vec3f_array(linear_from_srgb(colors)))
    if mesh.uv is not None:
        kind = Sdf.ValueTypeNames.TexCoord2fArray
        places = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(_UV, kind, UsdGeom.Tokens.faceVarying)
        places.Set(layers.vec2f_array(mesh.uv.reshape(-1, 2)))


def hide_look(prim: UsdGeom.Mesh, mesh: Mesh, below: Mesh) -> None:
    """Override the primvars that only the weaker layer's mesh `below` has, because they belong to other points."""
    if natural_colors(mesh) is None and natural_colors(below) is not None:
        prim.GetDisplayColorPrimvar().SetInterpolation(UsdGeom.Tokens.constant)
    if mesh.uv is None and below.uv is not None:
        UsdGeom.PrimvarsAPI(prim).CreatePrimvar(_UV, Sdf.ValueTypeNames.TexCoord2fArray).GetAttr().Block()


def read_look(prim: UsdGeom.Mesh, vertices: int, faces: int) -> tuple[NDArray[np.uint8] | None, Array | None]:
    """Return vertex colours (V, 3) and texture coordinates of face corners (F, 3, 2); None if missing."""
    shown = prim.GetDisplayColorPrimvar()
    colors = _values(shown, (vertices, 3)) if shown.GetInterpolation() == UsdGeom.Tokens.vertex else None
    places = _values(UsdGeom.PrimvarsAPI(prim).GetPrimvar(_UV), (3 * faces, 2))
    return (
        None if colors is None else srgb_from_linear(colors),
        None if places is None else places.reshape(faces, 3, 2),
    )


def _values(primvar: UsdGeom.Primvar, shape: tuple[int, int]) -> Array | None:
    """Return the values of a primvar; None if their shape is not the expected one or they are not finite."""
    found = np.array((primvar.ComputeFlattened() if primvar else None) or (), dtype=np.float64)
    return found if found.shape == shape and np.isfinite(found).all() else None


def linear_from_srgb(colors: NDArray[np.uint8]) -> Array:
    """Convert 8-bit sRGB colours to linear values 0 .. 1, as USD stores them (IEC 61966-2-1)."""
    coded = colors / 255.0
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(values: Array) -> NDArray[np.uint8]:
    """Convert linear colours to 8-bit sRGB (IEC 61966-2-1), clipped to 0 .. 1."""
    linear = np.clip(np.asarray(values, dtype=np.float64), 0.0, 1.0)
    coded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(255 * coded).astype(np.uint8)


def build_geometry(meshes: Mapping[str, Mesh], T_rest: Array, estimate: Estimate | None = None) -> Sdf.Layer:
    """Build the layer with all meshes under /Actor.

    Args:
        meshes: as in `bake_rig`, but `skull` and `mandible` may be missing [mm].
        T_rest: T_skull_mandible with the teeth closed, shape (4, 4): the mandible's default pose.
        estimate: The estimated bones among the meshes, which are marked as placeholders; None without any.

    Raises:
        RigError: An unknown or missing mesh, or a mesh without faces or with values that are not finite.
    """
    check_meshes(meshes)
    layer = new_layer()
    for path, type_name in (
        (ACTOR, "Xform"),
        (MATERIALS, "Scope"),
        (GEO, "Scope"),
        (SKULL, "Xform"),
        (MANDIBLE, "Xform"),
    ):
        define_prim(layer, path, type_name)
    stage = stage_of(layer)
    for path in (SKULL, MANDIBLE):
        Usd.ModelAPI(stage.GetPrimAtPath(path)).SetKind(Kind.Tokens.subcomponent)
    add_pose(stage.GetPrimAtPath(MANDIBLE), T_rest)
    replaced = () if estimate is None else estimate.bones
    used = [name for name in MATERIAL_LOOKS if name != "Placeholder" or replaced]
    materials = {name: _material(stage, name) for name in used}
    for name, path in MESH_PATHS.items():
        if name in meshes:
            base = "Enamel" if name.endswith("teeth") else "Placeholder" if name in replaced else "Bone"
            _define_mesh(stage, path, meshes[name], materials, base)
    if estimate is not None:
        for name in estimate.bones:
            _mark_placeholder(layer.GetPrimAtPath(MESH_PATHS[name]), name, estimate)
    return layer


def _mark_placeholder(mesh: Sdf.PrimSpec, name: str, estimate: Estimate) -> None:
    """Mark a mesh as a placeholder in all metadata that programs display."""
    text = f"Not anatomy: a placeholder estimated from the scans; there was no mesh. Condyles: {estimate.condyles}."
    mesh.SetInfo("displayName", f"{name.capitalize()} (placeholder)")
    mesh.SetInfo("documentation", text)
    mesh.customData = {"placeholder": True}
    set_attribute(mesh, "jaw:placeholder", Sdf.ValueTypeNames.Bool, True)
    set_attribute(mesh, "jaw:placeholder:condyles", Sdf.ValueTypeNames.String, estimate.condyles)
    if estimate.error_mm is not None:
        set_attribute(mesh, "jaw:placeholder:condyleError", Sdf.ValueTypeNames.Double, estimate.error_mm)


def extent(vertices: Array) -> Array:
    """Return the lower and upper corner, shape (2, 3), of the bounding box of points (n, 3)."""
    return np.stack([vertices.min(axis=0), vertices.max(axis=0)])


def check_meshes(meshes: Mapping[str, Mesh]) -> None:
    """Check the meshes of a rig; raises RigError as `build_geometry` does."""
    unknown = sorted(set(meshes) - set(MESH_PATHS))
    if unknown:
        raise RigError(f"there is no mesh called {unknown[0]!r}; it must be one of {', '.join(MESH_PATHS)}.")
    for name in _REQUIRED:
        if name not in meshes:
            raise RigError(f"the {name} mesh is missing; a rig needs both teeth scans.")
    for name, mesh in meshes.items():
        if not len(mesh.faces) or not np.isfinite(mesh.vertices).all():
            raise RigError(f"the {name} mesh has no faces or has vertices that are not finite.")


def _material(stage: Usd.Stage, name: str) -> UsdShade.Material:
    color, roughness = MATERIAL_LOOKS[name]
    material = UsdShade.Material.Define(stage, f"{MATERIALS}/{name}")
    surface = UsdShade.Shader.Define(stage, f"{MATERIALS}/{name}/Surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*color))
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(roughness)
    surface.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    return material


def _define_mesh(
    stage: Usd.Stage, path: str, mesh: Mesh, materials: Mapping[str, UsdShade.Material], base: str
) -> None:
    prim = UsdGeom.Mesh.Define(stage, path)
    prim.CreatePointsAttr(layers.vec3f_array(mesh.vertices))
    prim.CreateFaceVertexIndicesAttr(layers.int_array(mesh.faces))
    prim.CreateFaceVertexCountsAttr(layers.int_array(np.full(len(mesh.faces), 3)))
    prim.CreateExtentAttr(layers.vec3f_array(extent(mesh.vertices)))
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateDoubleSidedAttr(True)  # meshes are double-sided, because scans are open surfaces
    prim.CreateNormalsAttr(layers.vec3f_array(vertex_normals(mesh)[mesh.faces.reshape(-1)]))
    prim.SetNormalsInterpolation(UsdGeom.Tokens.faceVarying)
    gum = ~crown_face_mask(mesh) if base == "Enamel" else np.zeros(len(mesh.faces), dtype=bool)
    write_look(prim, mesh, MATERIAL_LOOKS[base][0])
    binding = UsdShade.MaterialBindingAPI.Apply(prim.GetPrim())
    binding.Bind(materials[base])
    if gum.any():
        for name, faces in (("Gum", gum), ("Enamel", ~gum)):
            subset = binding.CreateMaterialBindSubset(
                f"{prim.GetPrim().GetName()}{name}", layers.int_array(np.flatnonzero(faces))
            )
            UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(materials[name])
        binding.SetMaterialBindSubsetsFamilyType(UsdGeom.Tokens.partition)


def vertex_normals(mesh: Mesh) -> Array:
    """Return smooth unit normals, shape (V, 3): face normals weighted by area."""
    normals = surfaces.vertex_normals(mesh.vertices, mesh.faces)
    # vertices whose faces are all degenerate get an arbitrary unit vector
    return np.where(np.linalg.norm(normals, axis=1, keepdims=True) > 0.5, normals, [0.0, 1.0, 0.0])


@raises_format_error
def read_geometry(path: AnyPath, prim_path: str | None = None, *, placeholders: bool = False) -> dict[str, Mesh]:
    """Read the meshes of a rig by the names of `MESH_PATHS`: either scanned anatomy or placeholders.

    Skull and upper teeth are in the skull frame, mandible and lower teeth in the mandible frame [mm], in single
    precision as stored, with the colours and texture coordinates of the scan.

    Args:
        path: A layer or package with the meshes, or a stage that references them.
        prim_path: The rig's prim; None: the only rig, or the default prim of a layer without rigs.
        placeholders: Whether to read placeholders.

    Raises:
        RigError: The file is not USD, or a mesh with faces other than triangles.
    """
    stage = open_stage(path)
    found = {}
    for name, place in _mesh_paths(stage, path, prim_path).items():
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(place))
        if not mesh or bool(mesh.GetPrim().GetAttribute("jaw:placeholder").Get()) != placeholders:
            continue
        counts = np.array(value_of(mesh.GetFaceVertexCountsAttr()) or [])
        if not counts.size or (counts != 3).any():
            raise RigError(f"{place} has faces that are not triangles.")
        points, corners = (value_of(a) for a in (mesh.GetPointsAttr(), mesh.GetFaceVertexIndicesAttr()))
        vertices = np.array(points, dtype=np.float64)
        faces = np.array(corners, dtype=np.int32).reshape(-1, 3)
        colors, uv = read_look(mesh, len(vertices), len(faces))
        read = Mesh(vertices, faces, colors, uv=uv)
        vertices, colors = without_loose(read.vertices, read.faces, read.colors)
        found[name] = replace(read, vertices=vertices, colors=colors)
    return found


@raises_format_error
def read_gum(path: AnyPath, prim_path: str | None = None) -> dict[str, Mask]:
    """Return masks of gum faces (F,) of teeth meshes with a gum subset, by `MESH_PATHS`; raises RigError if not USD."""
    stage = open_stage(path)
    found = {}
    for name, place in _mesh_paths(stage, path, prim_path).items():
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(place))
        subset = UsdGeom.Subset(stage.GetPrimAtPath(f"{place}/{place.rsplit('/', 1)[1]}Gum"))
        if mesh and subset:
            gum = np.zeros(np.size(np.array(value_of(mesh.GetFaceVertexCountsAttr()))), dtype=np.bool_)
            gum[np.array(value_of(subset.GetIndicesAttr()))] = True
            found[name] = gum
    return found


def _mesh_paths(stage: Usd.Stage, path: AnyPath, prim_path: str | None) -> dict[str, str]:
    if prim_path is None:
        default = stage.GetDefaultPrim()
        prim_path = str((default if default and not rig_prims(stage) else find_rig_prim(stage, path)).GetPath())
    return {name: prim_path + path.removeprefix(ACTOR) for name, path in MESH_PATHS.items()}
