"""Read how a skeleton moves the prims of a rig, as in the variant `motion = "skeleton"`."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from pxr import Gf, Usd, UsdGeom, UsdSkel

from jawusd.base.arrays import Array
from jawusd.base.errors import FormatError

# Entries of the transforms of two meshes of one bone differ by single precision: far less, at 100 mm from the origin.
_APART = 1e-4
_BIND_RIGIDLY = "Bind every mesh of the mandible to one joint, or give meshes with --mandible and --skull to be fitted."


class Bones:
    """Hold the skeletons that move the meshes below a prim."""

    def __init__(self, prim: Usd.Prim, bound: list[tuple[UsdSkel.SkinningQuery, UsdSkel.SkeletonQuery]]) -> None:
        self._prim, self._bound = prim, bound

    def keyed(self) -> list[Usd.Attribute]:
        """Return the attributes that move the joints."""
        animations = [UsdSkel.Animation(skeleton.GetAnimQuery().GetPrim()) for _, skeleton in self._bound]
        return [
            attribute
            for animation in animations
            if animation
            for attribute in (animation.GetTranslationsAttr(), animation.GetRotationsAttr(), animation.GetScalesAttr())
        ]

    def poses(self, actor: Usd.Prim, times: Iterable[Usd.TimeCode], path: object) -> Array:
        """Return the transforms (n, 4, 4) [mm] that carry the meshes' own points to the actor's frame, at n times.

        Raises:
            FormatError: A mesh is bent, not bound, or moved in another way than the others.
        """
        for mesh in self._meshes():
            if mesh.GetPath() not in {skinning.GetPrim().GetPath() for skinning, _ in self._bound}:
                raise FormatError(
                    f"bones move other meshes of {self._prim.GetPath()}, but not {mesh.GetPath()}.",
                    path=str(path),
                    hint=_BIND_RIGIDLY,
                )
        for skinning, _ in self._bound:
            if not skinning.IsRigidlyDeformed() or skinning.HasBlendShapes():
                raise FormatError(
                    f"bones or shapes bend {skinning.GetPrim().GetPath()}: only meshes moved as a whole are read.",
                    path=str(path),
                    hint=_BIND_RIGIDLY,
                )
        moved = np.array([[self._pose(*pair, actor, time) for time in times] for pair in self._bound])
        off = np.abs(moved - moved[:1]).max(axis=(1, 2, 3))
        if not off.max() <= _APART:
            paths = [str(self._bound[i][0].GetPrim().GetPath()) for i in (0, int(np.argmax(off)))]
            raise FormatError(
                f"bones move {paths[0]} and {paths[1]} in different ways.", path=str(path), hint=_BIND_RIGIDLY
            )
        first: Array = moved[0]
        return first

    def _meshes(self) -> list[Usd.Prim]:
        below = Usd.PrimRange(self._prim, Usd.TraverseInstanceProxies())
        return [prim for prim in below if prim.IsA(UsdGeom.Mesh)]

    @staticmethod
    def _pose(
        skinning: UsdSkel.SkinningQuery, skeleton: UsdSkel.SkeletonQuery, actor: Usd.Prim, time: Usd.TimeCode
    ) -> Array:
        moved = skinning.ComputeSkinnedTransform(skeleton.ComputeSkinningTransforms(time), time)
        placed = place_in(actor, skeleton.GetPrim(), UsdGeom.XformCache(time))
        return np.array(moved * placed).T  # USD multiplies rows from the left

    def foreign_joints(self) -> list[str]:
        """Return the joints that are animated, but that no skeleton has."""
        found = []
        for _, skeleton in self._bound:
            animation = skeleton.GetAnimQuery()
            moved = animation.GetJointOrder() if animation else []
            found += [str(joint) for joint in moved if joint not in skeleton.GetJointOrder()]
        return list(dict.fromkeys(found))


def place_in(actor: Usd.Prim, prim: Usd.Prim, cache: UsdGeom.XformCache) -> Gf.Matrix4d:
    """Return where a prim is in the frame of an actor above it, by way of the world where it does not follow it."""
    placed, resets = cache.ComputeRelativeTransform(prim, actor)
    if resets:
        placed = cache.GetLocalToWorldTransform(prim) * cache.GetLocalToWorldTransform(actor).GetInverse()
    return placed


def bones_of(prim: Usd.Prim) -> Bones | None:
    """Return the skeletons that move the meshes below a prim; None where none does."""
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
