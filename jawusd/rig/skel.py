"""The UsdSkel variant of an actor: the jaw as an animated joint, for tools that edit skeletons but do not support rigs.

Written for every actor, and read from stages in which bones move the meshes (`motion = "skeleton"`).
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdSkel, Vt

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, FormatError
from jawusd.evaluator import JawRig
from jawusd.geometry.anatomy import LANDMARKS
from jawusd.geometry.se3 import make_transform, se3_inverse, transform_points
from jawusd.rig import layers, layout
from jawusd.rig.geo import MESH_PATHS

_TYPES = Sdf.ValueTypeNames

JOINTS = ("skull", "skull/jaw")
SKEL, KEYS = f"{layout.ACTOR}/Skel", f"{layout.ACTOR}/Skel/Motion"
_SKEL_IN_GEO = f"{layout.GEO}/Skel"
SAME_MOTION = 1e-4  # maximum difference of matrix entries of meshes that move together, far above rounding [mm or 1]
_BIND_RIGIDLY = "Bind every mesh of the mandible to one joint, or name meshes to be fitted with --mandible and --skull."


def write_skel(
    out: AnyPath,
    rig: JawRig,
    mesh_names: list[str],
    fps: float,
    frames: ArrayLike | None = None,
    d: ArrayLike | None = None,
    prim_name: str = Sdf.Path(layout.ACTOR).name,
) -> Path:
    """Write the skeleton layer next to `geo.usdc`, whose meshes it binds rigidly to two joints, without d and bounds.

    The joint `skull/jaw` is midway between the condyles and has one key per frame (F,) with d (F, 3) [mm], none where d
    is NaN; without frames, the teeth stay closed. Names of meshes are those of `MESH_PATHS`. Names of joints begin with
    that of the actor's prim.

    Raises:
        OutputError: The file cannot be written.
    """
    layer = layers.new_layer(fps)
    root = layers.define_prim(layer, layout.ACTOR, "SkelRoot")
    root.kind = Kind.Tokens.component
    stage = layers.stage_of(layer)
    _define_skeleton(stage, _hinge(rig))
    keys = _define_motion(stage, rig, frames, d)
    if keys is not None:
        layer.startTimeCode, layer.endTimeCode = float(keys[0]), float(keys[-1])
    _bind(layer, rig, [Sdf.Path(MESH_PATHS[name]) for name in mesh_names], Sdf.Path(SKEL), Sdf.Path(layout.MANDIBLE))
    root.payloadList.prependedItems = [Sdf.Payload(f"./{layout.GEO_FILE}")]
    del stage
    return layers.write_layer(layers.rename_actor(layer, prim_name), Path(out))


def add_skeleton_variant(layer: Sdf.Layer, rig: JawRig, meshes: Iterable[str]) -> None:
    """Add the variants `transforms` (selected, empty) and `skeleton` to the actor of an animation layer, for meshes.

    Joints and keys are referenced from `actor_skel.usdc` next to the layer. The prim above the meshes becomes the
    SkelRoot, because a variant cannot change the type of the actor's prim, which `actor.usda` sets.
    """
    actor = Sdf.CreatePrimInLayer(layer, layout.ACTOR)
    layers.add_variants(actor, layout.MOTION, layout.TRANSFORMS, layout.SKELETON)
    inside = Sdf.Path(layout.ACTOR).AppendVariantSelection(layout.MOTION, layout.SKELETON)

    def in_variant(path: str) -> Sdf.Path:
        return Sdf.Path(path).ReplacePrefix(Sdf.Path(layout.ACTOR), inside)

    # all specs are overs: the meshes are defined in the payload
    Sdf.CreatePrimInLayer(layer, in_variant(layout.GEO)).typeName = "SkelRoot"
    skeleton = Sdf.CreatePrimInLayer(layer, in_variant(_SKEL_IN_GEO))
    skeleton.referenceList.prependedItems = [Sdf.Reference(f"./{layout.SKEL_FILE}", SKEL)]
    # the prims above the meshes are bound too, so that proxies next to the meshes inherit the binding
    paths = [in_variant(path) for path in (layout.SKULL, layout.MANDIBLE, *meshes)]
    _bind(layer, rig, paths, Sdf.Path(_SKEL_IN_GEO), in_variant(layout.MANDIBLE))


def joint_poses(rig: JawRig, d: Array) -> Array:
    """Return the transforms of the joint `skull/jaw` in skull coordinates, shape (n, 4, 4), for parameters (n, 3) [mm].

    The joint moves by D = pose rest^-1, because a vertex p bound at rest then moves to D rest p = pose p.
    """
    moved = rig.pose(d) @ se3_inverse(rig.T_rest)
    return make_transform(moved[:, :3, :3], (moved @ _hinge(rig))[:, :3, 3])


def _hinge(rig: JawRig) -> Array:
    """Return the joint's rest transform (4, 4) [mm]: midway between the condyles, with the skull's axes."""
    condyles = [LANDMARKS.index(name) for name in ("condyle_left", "condyle_right")]
    return make_transform(np.eye(3), transform_points(rig.T_rest, rig.landmarks[condyles]).mean(axis=0))


def _define_skeleton(stage: Usd.Stage, hinge: Array) -> None:
    skeleton = UsdSkel.Skeleton.Define(stage, SKEL)
    rest = Vt.Matrix4dArray([layers.row_matrix(np.eye(4)), layers.row_matrix(hinge)])
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
    translations.Set(layers.vec3f_array(_hinge(rig)[None, :3, 3]))
    rotations.Set(Vt.QuatfArray([Gf.Quatf(1.0)]))
    if frames is None or d is None:
        return None
    frames, d = np.asarray(frames, dtype=np.float64), np.asarray(d, dtype=np.float64)
    known = np.isfinite(d).all(axis=1)
    joint = joint_poses(rig, d[known])
    for frame, T, rotation in zip(frames[known].tolist(), joint, layers.rotations(joint), strict=True):
        translations.Set(layers.vec3f_array(T[None, :3, 3]), frame)
        rotations.Set(Vt.QuatfArray([Gf.Quatf(rotation)]), frame)
    return frames[known] if known.any() else None


def _bind(layer: Sdf.Layer, rig: JawRig, meshes: Iterable[Sdf.Path], skeleton: Sdf.Path, mandible: Sdf.Path) -> None:
    """Bind the payload's meshes rigidly to the joints, those of the mandible to the jaw; the payload is not loaded."""
    # The bind transforms place the meshes. The empty op order keeps Blender from applying the payload's ops as well.
    moved = Sdf.CreatePrimInLayer(layer, mandible)
    layers.set_attribute(moved, "xformOpOrder", _TYPES.TokenArray, Vt.TokenArray(), custom=False)
    for path in meshes:
        is_moving = path.HasPrefix(mandible)
        bind = rig.T_rest if is_moving else np.eye(4)
        _bind_mesh(Sdf.CreatePrimInLayer(layer, path), skeleton, bind, int(is_moving))


def _bind_mesh(mesh: Sdf.PrimSpec, skeleton: Sdf.Path, bind: Array, joint: int) -> None:
    layers.apply_schemas(mesh, "SkelBindingAPI")
    layers.set_relationship(mesh, "skel:skeleton", skeleton, custom=False)
    write = partial(layers.set_attribute, mesh, animated=True, custom=False)
    write("primvars:skel:geomBindTransform", _TYPES.Matrix4d, layers.row_matrix(bind))
    values = (("jointIndices", _TYPES.IntArray, Vt.IntArray([joint])), ("jointWeights", _TYPES.FloatArray, [1.0]))
    for name, type_name, value in values:
        primvar = write(f"primvars:skel:{name}", type_name, value)
        primvar.SetInfo("interpolation", "constant")
        primvar.SetInfo("elementSize", 1)


class Bones:
    """Skeletons that move the meshes below a prim."""

    def __init__(self, prim: Usd.Prim, bound: list[tuple[UsdSkel.SkinningQuery, UsdSkel.SkeletonQuery]]) -> None:
        self._prim, self._bound = prim, bound

    def animated_attributes(self) -> list[Usd.Attribute]:
        """Return the attributes that animate the joints."""
        animations = [UsdSkel.Animation(skeleton.GetAnimQuery().GetPrim()) for _, skeleton in self._bound]
        return [
            attribute
            for animation in animations
            if animation
            for attribute in (animation.GetTranslationsAttr(), animation.GetRotationsAttr(), animation.GetScalesAttr())
        ]

    def poses(self, actor: Usd.Prim, times: Iterable[Usd.TimeCode]) -> Array:
        """Return transforms (n, 4, 4) [mm] from the meshes to the actor at n times.

        Raises FormatError if a mesh is deformed, not bound, or moves differently from the others.
        """
        for mesh in layout.meshes_below(self._prim):
            if mesh.GetPath() not in {skinning.GetPrim().GetPath() for skinning, _ in self._bound}:
                raise FormatError(
                    f"bones move other meshes of {self._prim.GetPath()}, but not {mesh.GetPath()}.", hint=_BIND_RIGIDLY
                )
        for skinning, _ in self._bound:
            if not skinning.IsRigidlyDeformed() or skinning.HasBlendShapes():
                raise FormatError(
                    f"bones or blend shapes deform {skinning.GetPrim().GetPath()}: only rigid motion can be read.",
                    hint=_BIND_RIGIDLY,
                )
        moved = np.array([[self._pose(*pair, actor, time) for time in times] for pair in self._bound])
        difference = np.abs(moved - moved[:1]).max(axis=(1, 2, 3))
        if not difference.max() <= SAME_MOTION:
            paths = [str(self._bound[i][0].GetPrim().GetPath()) for i in (0, int(np.argmax(difference)))]
            raise FormatError(f"bones move {paths[0]} and {paths[1]} differently.", hint=_BIND_RIGIDLY)
        first: Array = moved[0]
        return first

    @staticmethod
    def _pose(
        skinning: UsdSkel.SkinningQuery, skeleton: UsdSkel.SkeletonQuery, actor: Usd.Prim, time: Usd.TimeCode
    ) -> Array:
        moved = skinning.ComputeSkinnedTransform(skeleton.ComputeSkinningTransforms(time), time)
        placed = transform_in_actor(actor, skeleton.GetPrim(), UsdGeom.XformCache(time))
        return np.array(moved * placed).T  # USD multiplies row vectors from the left

    def foreign_joints(self) -> list[str]:
        """Return the animated joints that no skeleton has."""
        found = []
        for _, skeleton in self._bound:
            animation = skeleton.GetAnimQuery()
            moved = animation.GetJointOrder() if animation else []
            found += [str(joint) for joint in moved if joint not in skeleton.GetJointOrder()]
        return list(dict.fromkeys(found))


def transform_in_actor(actor: Usd.Prim, prim: Usd.Prim, cache: UsdGeom.XformCache) -> Gf.Matrix4d:
    """Return the transform of a prim in the frame of its actor, even if the prim resets the transform stack."""
    placed, resets = cache.ComputeRelativeTransform(prim, actor)
    if resets:
        placed = cache.GetLocalToWorldTransform(prim) * cache.GetLocalToWorldTransform(actor).GetInverse()
    return placed


def bones_of(prim: Usd.Prim) -> Bones | None:
    """Return the skeletons that move the meshes below a prim; None if there are none."""
    root = UsdSkel.Root.Find(prim)
    if not root:
        return None
    instances = Usd.TraverseInstanceProxies()
    cache = UsdSkel.Cache()
    cache.Populate(root, instances)
    bound = [
        (skinning, cache.GetSkelQuery(binding.GetSkeleton()))
        for binding in cache.ComputeSkelBindings(root, instances)
        for skinning in binding.GetSkinningTargets()
        if skinning.GetPrim().GetPath().HasPrefix(prim.GetPath())
    ]
    return Bones(prim, bound) if bound else None
