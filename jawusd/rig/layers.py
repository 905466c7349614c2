"""Build USD layers in memory, convert numpy arrays to their values, and write them atomically.

Other modules do not convert Gf and Vt types themselves. numpy side: column vectors (`p_a = T_a_b @ p_b`), quaternions
(w, x, y, z), C-contiguous. USD side: row vectors.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdUtils, Vt

from jawusd.base.arrays import Array
from jawusd.base.errors import OutputError, RigError
from jawusd.base.inputs import check_path
from jawusd.base.version import __version__
from jawusd.formats.atomic import atomic_path
from jawusd.geometry.so3 import continuous_wxyz
from jawusd.rig.layout import ACTOR, PROXY_SUFFIX


def double_array(values: ArrayLike) -> Vt.DoubleArray:
    """Return an array of any shape as a flat Vt.DoubleArray, row-major."""
    return Vt.DoubleArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float64).reshape(-1))


def float_array(values: ArrayLike) -> Vt.FloatArray:
    """Return an array of any shape as a flat Vt.FloatArray, row-major; rounds to float32."""
    return Vt.FloatArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32).reshape(-1))


def int_array(values: ArrayLike) -> Vt.IntArray:
    """Return an integer array of any shape as a flat Vt.IntArray, row-major."""
    return Vt.IntArray.FromNumpy(np.ascontiguousarray(values, dtype=np.int32).reshape(-1))


def vec3f_array(values: ArrayLike) -> Vt.Vec3fArray:
    """Return points or normals (n, 3) as a Vt.Vec3fArray; rounds to float32."""
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))


def vec2f_array(values: ArrayLike) -> Vt.Vec2fArray:
    """Return pairs (n, 2) as a Vt.Vec2fArray; rounds to float32."""
    return Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))


def translations(T: ArrayLike) -> list[Gf.Vec3d]:
    """Return the translations [mm] of transforms (n, 4, 4)."""
    return [Gf.Vec3d(*t) for t in np.asarray(T, dtype=np.float64)[:, :3, 3].tolist()]


def rotations(T: ArrayLike) -> list[Gf.Quatd]:
    """Return the rotations of transforms (n, 4, 4) as unit quaternions without sign flips between neighbours."""
    return [Gf.Quatd(w, x, y, z) for w, x, y, z in continuous_wxyz(np.asarray(T)[:, :3, :3]).tolist()]


def row_matrix(T: ArrayLike) -> Gf.Matrix4d:
    """Return a transform (4, 4) for column vectors as a Gf.Matrix4d, which acts on row vectors."""
    return Gf.Matrix4d(np.asarray(T, dtype=np.float64).T.tolist())


T = TypeVar("T")

# Part of the warning that OpenUSD 26.11 issues for every spline it writes.
_SPLINE_WARNING = "inner looping is deprecated"


def new_layer(fps: float | None = None, default_prim: str = ACTOR) -> Sdf.Layer:
    """Return an anonymous layer with the units of all jawusd files: Y up, millimetres; None leaves the rate unset."""
    layer = Sdf.Layer.CreateAnonymous(".usda")
    root = layer.pseudoRoot
    root.SetInfo(UsdGeom.Tokens.upAxis, UsdGeom.Tokens.y)
    root.SetInfo(UsdGeom.Tokens.metersPerUnit, 0.001)
    layer.defaultPrim = Sdf.Path(default_prim).name
    layer.customLayerData = {"creator": f"jawusd {__version__}"}
    if fps is not None:
        layer.timeCodesPerSecond = fps
        layer.framesPerSecond = fps
    return layer


def rename_actor(layer: Sdf.Layer, name: str, before: str = Sdf.Path(ACTOR).name, files: str = ".*") -> Sdf.Layer:
    """Rename the actor's prims and joints in an anonymous layer, in place, update all paths to them, and return it.

    `before` is the current name. Prim paths in references and payloads to files that match a pattern are renamed too.
    """
    renamed_prims = {Sdf.Path(f"/{before}{end}"): Sdf.Path(f"/{name}{end}") for end in ("", PROXY_SUFFIX)}

    def renamed(path: Sdf.Path) -> Sdf.Path:
        first = path.GetPrefixes()[0] if path.GetPrefixes() else path
        return path.ReplacePrefix(first, renamed_prims.get(first, first))

    def renamed_arc(arc: Sdf.Reference | Sdf.Payload) -> Sdf.Reference | Sdf.Payload:
        if not re.fullmatch(files, arc.assetPath):
            return arc
        more = (arc.customData,) if isinstance(arc, Sdf.Reference) else ()
        return type(arc)(arc.assetPath, renamed(arc.primPath), arc.layerOffset, *more)

    def visit(path: Sdf.Path) -> None:
        spec = layer.GetPrimAtPath(path) if path.IsPrimVariantSelectionPath() else layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.RelationshipSpec):
            _replace(spec.targetPathList, renamed)
        elif isinstance(spec, Sdf.AttributeSpec):
            _replace(spec.connectionPathList, renamed)
            if spec.name == "joints" and spec.default is not None:
                spec.default = Vt.TokenArray([_joint(joint, name, before) for joint in spec.default])
        elif isinstance(spec, Sdf.PrimSpec) and not path.IsAbsoluteRootPath():
            _replace(spec.referenceList, renamed_arc)
            _replace(spec.payloadList, renamed_arc)
            _replace(spec.inheritPathList, renamed)

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    for prim in list(layer.rootPrims):
        prim.name = renamed(prim.path).name
    if layer.defaultPrim == before:
        layer.defaultPrim = name
    return layer


def _replace(items: object, change: Callable[[T], T]) -> None:
    """Apply a function to each item of an OpenUSD list op, in place."""
    for group in ("explicitItems", "prependedItems", "appendedItems", "addedItems", "deletedItems"):
        old = list(getattr(items, group))
        new = [change(item) for item in old]
        if new != old:
            setattr(items, group, new)


def _joint(joint: str, name: str, before: str) -> str:
    """Return the path of a joint with the actor's name prefixed to each of its parts."""
    return "/".join(f"{name}_{part.removeprefix(f'{before}_')}" for part in joint.split("/"))


def stage_of(layer: Sdf.Layer) -> Usd.Stage:
    """Return a stage whose root is an anonymous layer, for schema classes; raises RigError if OpenUSD fails to."""
    stage = Usd.Stage.Open(layer, load=Usd.Stage.LoadNone)
    if stage is None:
        raise RigError("OpenUSD could not open an anonymous layer.")
    return stage


def define_prim(layer: Sdf.Layer, path: str, type_name: str) -> Sdf.PrimSpec:
    """Define a prim of a type in a layer and return its spec; an existing spec is redefined."""
    spec = Sdf.CreatePrimInLayer(layer, path)
    spec.specifier = Sdf.SpecifierDef
    spec.typeName = type_name
    return spec


def apply_schemas(spec: Sdf.PrimSpec, *names: str) -> None:
    """Apply schemas to a prim spec, as plain metadata: the schema plugin is not needed."""
    schemas = Sdf.TokenListOp()
    schemas.prependedItems = list(names)
    spec.SetInfo("apiSchemas", schemas)


def set_attribute(
    spec: Sdf.PrimSpec,
    name: str,
    type_name: Sdf.ValueTypeName,
    value: object,
    *,
    animated: bool = False,
    custom: bool = True,
) -> Sdf.AttributeSpec:
    """Write an attribute with its default value, uniform unless animated; Blender imports only `custom` attributes."""
    variability = Sdf.VariabilityVarying if animated else Sdf.VariabilityUniform
    attribute = Sdf.AttributeSpec(spec, name, type_name, variability, declaresCustom=custom)
    attribute.default = value
    return attribute


def set_relationship(spec: Sdf.PrimSpec, name: str, target: str | Sdf.Path, *, custom: bool = True) -> None:
    """Write a relationship to a prim."""
    relationship = Sdf.RelationshipSpec(spec, name, custom=custom)
    relationship.targetPathList.explicitItems = [Sdf.Path(target)]


def add_variants(actor: Sdf.PrimSpec, name: str, selected: str, *others: str) -> Sdf.VariantSetSpec:
    """Add a variant set with empty variants to a prim spec, and select one."""
    variants = Sdf.VariantSetSpec(actor, name)
    for variant in (selected, *others):
        Sdf.VariantSpec(variants, variant)
    actor.variantSetNameList.prependedItems = [name]
    actor.variantSelections[name] = selected
    return variants


def add_pose(prim: Usd.Prim, T: Array) -> None:
    """Add translate and orient ops to a prim, with a default pose (4, 4); a matrix op would shear between frames."""
    xform = UsdGeom.Xformable(prim)
    xform.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(translations(T[None])[0])
    xform.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(rotations(T[None])[0])


def relative_path(target: Path, layer: Path) -> str:
    """Return the asset path of a file in a layer: relative to the layer's folder, starting with a dot."""
    relative = Path(os.path.relpath(target.resolve(), layer.resolve().parent)).as_posix()
    return relative if relative.startswith(".") else f"./{relative}"


@contextlib.contextmanager
def without_warning(words: str) -> Iterator[None]:
    """Suppress OpenUSD's warnings that contain these words; other warnings are issued at the end of the block."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        other = [found.commentary for found in delegate.TakeUncoalescedDiagnostics() if words not in found.commentary]
        del delegate
        for commentary in other:
            Tf.Warn(commentary)


def write_layer(layer: Sdf.Layer, path: Path) -> Path:
    """Write a layer to a file atomically, and reload the file's layer if it is open in this process.

    Raises:
        OutputError: The file cannot be written, its name does not end in .usda, .usdc or .usd, or OpenUSD does not
            support its path.
    """
    path = Path(path)
    if path.suffix.lower() not in (".usda", ".usdc", ".usd"):  # OpenUSD writes text into files of any other name
        raise OutputError("the name of a USD layer must end in .usdc, .usda or .usd.", path=path)
    check_path(path, OutputError)
    with atomic_path(path) as temporary:
        try:
            with without_warning(_SPLINE_WARNING):
                written = layer.Export(str(temporary))
        except Tf.ErrorException:  # OpenUSD's message names a line of its source code, not the reason
            written = False
        if not written:
            raise OutputError("could not be written; is the disk full? Any previous file is unchanged.", path=path)
    # OpenUSD caches layers by name: without a reload, stages opened later would show the old content.
    in_use = Sdf.Layer.Find(str(path.resolve())) or Sdf.Layer.Find(str(path))
    if in_use is not None:
        in_use.Reload(force=True)
    return path
