"""The UsdSkel variant of an actor: the jaw as a bone with keys, for tools that edit skeletons but not rigs."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pxr import Kind, Sdf, Usd, UsdSkel, Vt

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.geometry.anatomy import LANDMARKS
from jawusd.geometry.se3 import make_transform, se3_inverse, transform_points
from jawusd.rig import _gf
from jawusd.rig.geo import MESH_PATHS
from jawusd.rig.layers import define_prim, named_after, new_layer, stage_of, write_layer
from jawusd.rig.layout import ACTOR, GEO, GEO_FILE, MANDIBLE, MOTION, SKEL_FILE, SKELETON, SKULL, TRANSFORMS

_TYPES = Sdf.ValueTypeNames

JOINTS = ("skull", "skull/jaw")
SKEL, KEYS = f"{ACTOR}/Skel", f"{ACTOR}/Skel/Motion"
_SKEL_IN_GEO = f"{GEO}/Skel"


def write_skel(
    out: str | os.PathLike[str],
    rig: JawRig,
    mesh_names: list[str],
    fps: float,
    frames: ArrayLike | None = None,
    d: ArrayLike | None = None,
    prim_name: str = Sdf.Path(ACTOR).name,
) -> Path:
    """Write the skeleton beside `geo.usdc`, whose meshes it binds rigidly to two joints.

    The joint `skull/jaw` sits midway between the condyles and carries one key per frame; it has no d1, d2, d3 and
    no bounds.

    Args:
        out: File to write, in the folder of `geo.usdc`.
        mesh_names: The meshes in `geo.usdc`, names as in `MESH_PATHS`.
        frames: Frame numbers (F,), increasing; without them the jaw stays in the closed bite.
        d: Parameters (F, 3) [mm]; rows with NaN get no key.
        prim_name: Of the actor's prim; joints have it in front.

    Raises:
        OutputError: The file cannot be written.
    """
    layer = new_layer(fps)
    root = define_prim(layer, ACTOR, "SkelRoot")
    root.kind = Kind.Tokens.component
    stage = stage_of(layer)
    _define_skeleton(stage, _hinge(rig))
    keys = _define_motion(stage, rig, frames, d)
    if keys is not None:
        layer.startTimeCode, layer.endTimeCode = float(keys[0]), float(keys[-1])
    _bind(layer, rig, [Sdf.Path(MESH_PATHS[name]) for name in mesh_names], Sdf.Path(SKEL), Sdf.Path(MANDIBLE))
    root.payloadList.prependedItems = [Sdf.Payload(f"./{GEO_FILE}")]
    del stage
    return write_layer(named_after(layer, prim_name), Path(out))


def offer_skeleton(layer: Sdf.Layer, rig: JawRig, meshes: Iterable[str]) -> None:
    """Give the actor of an animation layer the variants `transforms`, which is selected and empty, and `skeleton`.

    The bones and their keys are those of `actor_skel.usdc` beside the layer, by reference. The prim above the meshes
    becomes the SkelRoot: a variant cannot change the type that `actor.usda` itself gives to the actor.

    Args:
        meshes: Paths of the meshes that follow the bones.
    """
    actor = Sdf.CreatePrimInLayer(layer, ACTOR)
    variants = Sdf.VariantSetSpec(actor, MOTION)
    Sdf.VariantSpec(variants, TRANSFORMS)
    Sdf.VariantSpec(variants, SKELETON)
    actor.variantSetNameList.prependedItems = [MOTION]
    actor.variantSelections[MOTION] = TRANSFORMS
    inside = Sdf.Path(ACTOR).AppendVariantSelection(MOTION, SKELETON)

    def place(path: str) -> Sdf.Path:
        return Sdf.Path(path).ReplacePrefix(Sdf.Path(ACTOR), inside)

    # overs all: without the payload there is nothing to move
    Sdf.CreatePrimInLayer(layer, place(GEO)).typeName = "SkelRoot"
    skeleton = Sdf.CreatePrimInLayer(layer, place(_SKEL_IN_GEO))
    skeleton.referenceList.prependedItems = [Sdf.Reference(f"./{SKEL_FILE}", SKEL)]
    # what lies beside the meshes inherits the binding of the prims above, as proxies do in the variant with both
    paths = [place(path) for path in (SKULL, MANDIBLE, *meshes)]
    _bind(layer, rig, paths, Sdf.Path(_SKEL_IN_GEO), place(MANDIBLE))


def joint_poses(rig: JawRig, d: Array) -> Array:
    """Return the joint `skull/jaw` in skull coordinates, shape (n, 4, 4), for parameters (n, 3) [mm].

    It moves as D hinge, D = pose rest^-1: a vertex bound at rest is carried to D rest p = pose p.
    """
    moved = rig.pose(d) @ se3_inverse(rig.T_rest)
    return make_transform(moved[:, :3, :3], (moved @ _hinge(rig))[:, :3, 3])


def _hinge(rig: JawRig) -> Array:
    """Return the joint in the closed bite, midway between the condyles, in the skull's axes, shape (4, 4) [mm]."""
    condyles = [LANDMARKS.index(name) for name in ("condyle_left", "condyle_right")]
    return make_transform(np.eye(3), transform_points(rig.T_rest, rig.landmarks[condyles]).mean(axis=0))


def _define_skeleton(stage: Usd.Stage, hinge: Array) -> None:
    skeleton = UsdSkel.Skeleton.Define(stage, SKEL)
    rest = Vt.Matrix4dArray([_gf.row_matrix(np.eye(4)), _gf.row_matrix(hinge)])
    skeleton.CreateJointsAttr(Vt.TokenArray(JOINTS))
    skeleton.CreateBindTransformsAttr(rest)
    skeleton.CreateRestTransformsAttr(rest)
    binding = UsdSkel.BindingAPI.Apply(skeleton.GetPrim())
    binding.CreateAnimationSourceRel().SetTargets([Sdf.Path(KEYS)])


def _define_motion(stage: Usd.Stage, rig: JawRig, frames: ArrayLike | None, d: ArrayLike | None) -> Array | None:
    """Define the animation of the joint skull/jaw and return its key frames."""
    motion = UsdSkel.Animation.Define(stage, KEYS)
    motion.CreateJointsAttr(Vt.TokenArray([JOINTS[1]]))
    motion.CreateScalesAttr(Vt.Vec3hArray([(1, 1, 1)]))
    translations, rotations = motion.CreateTranslationsAttr(), motion.CreateRotationsAttr()
    translations.Set(_gf.vec3f_array(_hinge(rig)[None, :3, 3]))
    rotations.Set(_gf.quatf_arrays(np.eye(4)[None])[0])
    if frames is None or d is None:
        return None
    frames, d = np.asarray(frames, dtype=np.float64), np.asarray(d, dtype=np.float64)
    known = np.isfinite(d).all(axis=1)
    joint = joint_poses(rig, d[known])
    for frame, T, rotation in zip(frames[known].tolist(), joint, _gf.quatf_arrays(joint), strict=True):
        translations.Set(_gf.vec3f_array(T[None, :3, 3]), frame)
        rotations.Set(rotation, frame)
    return frames[known] if known.any() else None


def _bind(layer: Sdf.Layer, rig: JawRig, meshes: Iterable[Sdf.Path], skeleton: Sdf.Path, mandible: Sdf.Path) -> None:
    """Bind meshes of the payload, which is not loaded here, rigidly to the joints: those of the mandible to the jaw."""
    # The bind transforms place the meshes; Blender would apply the ops of the payload on top.
    order = Sdf.AttributeSpec(
        Sdf.CreatePrimInLayer(layer, mandible), "xformOpOrder", _TYPES.TokenArray, Sdf.VariabilityUniform
    )
    order.default = Vt.TokenArray()
    for path in meshes:
        moves = path.HasPrefix(mandible)
        _bind_mesh(Sdf.CreatePrimInLayer(layer, path), skeleton, rig.T_rest if moves else np.eye(4), int(moves))


def _bind_mesh(mesh: Sdf.PrimSpec, skeleton: Sdf.Path, bind: Array, joint: int) -> None:
    schemas = Sdf.TokenListOp()
    schemas.prependedItems = ["SkelBindingAPI"]
    mesh.SetInfo("apiSchemas", schemas)
    relationship = Sdf.RelationshipSpec(mesh, "skel:skeleton", custom=False)
    relationship.targetPathList.explicitItems = [skeleton]
    matrix = Sdf.AttributeSpec(mesh, "primvars:skel:geomBindTransform", _TYPES.Matrix4d)
    matrix.default = _gf.row_matrix(bind)
    values = (("jointIndices", _TYPES.IntArray, Vt.IntArray([joint])), ("jointWeights", _TYPES.FloatArray, [1.0]))
    for name, type_name, value in values:
        primvar = Sdf.AttributeSpec(mesh, f"primvars:skel:{name}", type_name)
        primvar.default = value
        primvar.SetInfo("interpolation", "constant")
        primvar.SetInfo("elementSize", 1)
