"""Read the motion of the jaw from a stage without a rig: from Xforms, bones or point caches of the actor's meshes.

Exporters change names, units, axes and hierarchy, and formats such as glTF split and reorder vertices. The meshes of
the rig are therefore identified by their number of vertices, or of distinct positions, and fitted in every frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Usd, UsdGeom, UsdSkel, Vt

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, FormatError
from jawusd.formats.mesh import Mesh
from jawusd.geometry.points import match_points, rigid_fit
from jawusd.geometry.se3 import se3_inverse, transform_points
from jawusd.rig.attributes import value_of
from jawusd.rig.geo import read_geometry
from jawusd.rig.layout import meshes_below, rig_prims
from jawusd.rig.motion_read import frames_of_stage
from jawusd.rig.read import find_rig_prim, open_stage
from jawusd.rig.untrusted import raises_format_error

_POINTS = 2000  # maximum number of fitted vertices per mesh, evenly spaced by index
# Maximum RMS distance of a fitted mesh. Exports in single precision, even in metres, stay far below it; other meshes
# that happen to have the same number of vertices exceed it.
_MAX_MISFIT_MM = 0.5
_SAME_POINT_MM = 0.02  # distance [mm] below which points coincide; far above rounding, below a scan's vertex spacing
_SKULL, _MANDIBLE = ("upper_teeth", "skull"), ("lower_teeth", "mandible")


class StagePoses(NamedTuple):
    """Poses fitted to a stage."""

    frames: NDArray[np.int64]  # frame numbers, shape (F,)
    T: Array  # T_skull_mandible [mm], shape (F, 4, 4)
    fps: float  # frames per second
    misfit_mm: float  # RMS distance of the fitted meshes from those of the stage, maximum over frames
    meshes: tuple[str, str]  # paths of the fitted prims of skull and mandible


def carries_rig(path: AnyPath, prim_path: str | None = None) -> bool:
    """Return whether a stage has a rig whose mandible is moved by transforms or bones, so that no fit is needed.

    Raises:
        RigError: The file is not a stage.
        FormatError: The given prim is not a rig, although others are.
    """
    stage = open_stage(path)
    rigs = rig_prims(stage)
    if rigs and prim_path is not None:
        rigs = [find_rig_prim(stage, path, prim_path)]
    meshes = [UsdGeom.Mesh(prim) for rig in rigs for prim in meshes_below(rig)]
    return bool(rigs) and not any(mesh.GetPointsAttr().ValueMightBeTimeVarying() for mesh in meshes)


@raises_format_error
def fit_poses_of_stage(
    path: AnyPath, actor: AnyPath, mandible: str | None = None, skull: str | None = None, rig_prim: str | None = None
) -> StagePoses:
    """Fit the meshes of an actor to a stage, which moves copies of them in any way, at every whole frame.

    Args:
        actor: The rig's own file, which contains the meshes in their coordinate frames.
        mandible: Prim below which the lower teeth or the mandible are searched; None to search the whole stage.
        skull: The same for the upper teeth or the skull.
        rig_prim: The rig's prim, if the file has several rigs.

    Raises:
        RigError: The file is not a stage.
        FormatError: No mesh with matching vertices, a mesh that does not fit, or no time range.
    """
    stage = open_stage(path)
    rest = read_geometry(actor, rig_prim, placeholders=True) | read_geometry(actor, rig_prim)
    places = [_find(stage, rest, names, below) for names, below in ((_SKULL, skull), (_MANDIBLE, mandible))]
    frames = frames_of_stage(stage)
    fitted, misfit_mm = np.empty((2, len(frames), 4, 4)), 0.0
    for k, frame in enumerate(frames.tolist()):
        seen = [place.points(Usd.TimeCode(frame)) for place in places]
        # one scale for skull and mandible: the stage may be in cm, or the actor may be scaled
        scale = _spread(seen[0]) / _spread(places[0].source)
        for i, (place, points) in enumerate(zip(places, seen, strict=True)):
            fitted[i, k] = rigid_fit(place.source, points / scale)
            residual = transform_points(fitted[i, k], place.source) - points / scale
            misfit_mm = max(misfit_mm, float(np.sqrt((residual**2).sum(axis=1).mean())))
    if not misfit_mm <= _MAX_MISFIT_MM:
        raise FormatError(
            f"its meshes {places[0].path} and {places[1].path} are up to {misfit_mm:.2f} mm from those of the rig; "
            f"at most {_MAX_MISFIT_MM} mm is allowed: they are other meshes, or deformed.",
            hint="Choose the prims of skull and mandible with --skull and --mandible.",
        )
    T = se3_inverse(fitted[0]) @ fitted[1]
    return StagePoses(frames, T, float(stage.GetTimeCodesPerSecond()), misfit_mm, (places[0].path, places[1].path))


def _spread(points: Array) -> float:
    """Return a measure of the size of a point set: the root of the sum of squared distances from the centroid."""
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum()))


class _StageMesh:
    """A mesh of a stage that was identified as a mesh of the rig."""

    def __init__(self, prim: Usd.Prim, source: Array, in_rig: NDArray[np.int64], in_stage: NDArray[np.int64]) -> None:
        self.path, self.source, self._chosen = str(prim.GetPath()), source[in_rig], in_stage
        self._mesh, self._skinning = UsdGeom.Mesh(prim), None
        root = UsdSkel.Root.Find(prim)
        if not root:
            return
        self._cache = UsdSkel.Cache()
        self._cache.Populate(root, Usd.TraverseInstanceProxies())
        skinning, skeleton = self._cache.GetSkinningQuery(prim), UsdSkel.BindingAPI(prim).GetInheritedSkeleton()
        if skinning and skeleton and skinning.HasJointInfluences():
            self._skinning, self._skeleton = skinning, self._cache.GetSkelQuery(skeleton)

    def points(self, time: Usd.TimeCode) -> Array:
        """Return the chosen vertices in the stage's world space, shape (n, 3)."""
        points, moved_by = self._mesh.GetPointsAttr().Get(time), self._mesh.GetPrim()
        if self._skinning is not None:
            points = Vt.Vec3fArray(points)
            transforms = self._skeleton.ComputeSkinningTransforms(time)
            self._skinning.ComputeSkinnedPoints(transforms, points, time)
            moved_by = self._skeleton.GetPrim()
        M = np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(moved_by))
        return np.array(points, dtype=np.float64)[self._chosen] @ M[:3, :3] + M[3, :3]


def _find(stage: Usd.Stage, rest: dict[str, Mesh], names: tuple[str, ...], below: str | None) -> _StageMesh:
    """Return the mesh of the stage that matches one of the named meshes of the rig, preferring teeth to bone."""
    if below is not None and not (Sdf.Path.IsValidPathString(below) and stage.GetPrimAtPath(below)):
        raise FormatError(f"has no prim {below}.")
    meshes = meshes_below(stage.GetPrimAtPath(below) if below is not None else stage.GetPseudoRoot())
    found = {str(prim.GetPath()): _used_points(prim) for prim in meshes}
    wanted = {name: rest[name] for name in names if name in rest}
    ambiguous: list[str] = []
    for name, mesh in wanted.items():
        alike = [prim for prim in meshes if len(found[str(prim.GetPath())].all) == len(mesh.vertices)]
        alike = alike or [prim for prim in meshes if found[str(prim.GetPath())].distinct == _distinct(mesh)]
        # upper and lower teeth may have equally many vertices; then decide by name
        named = [prim for prim in alike if _plain(name) in _plain(str(prim.GetPath()))] or alike
        if len(named) == 1:
            return _StageMesh(named[0], mesh.vertices, *_correspondence(mesh, found[str(named[0].GetPath())]))
        ambiguous = ambiguous or [str(prim.GetPath()) for prim in named]
    if ambiguous:
        raise FormatError(
            f"has several meshes with the vertices of the rig's {next(iter(wanted))}: {', '.join(ambiguous)}.",
            hint="Choose the prims of one actor with --skull and --mandible.",
        )
    sizes = " or ".join(f"{len(mesh.vertices)} ({name})" for name, mesh in wanted.items())
    where = f" below {below}" if below is not None else ""
    raise FormatError(
        f"has no mesh{where} with as many vertices as in the rig: {sizes}.",
        hint="Choose the prims of skull and mandible with --skull and --mandible. Export without merging vertices.",
    )


class _Points(NamedTuple):
    """Points of a mesh (n, 3), indices of points used by faces, and the number of distinct positions of these."""

    all: Array
    used: NDArray[np.int64]
    distinct: int


def _used_points(prim: Usd.Prim) -> _Points:
    mesh, first = UsdGeom.Mesh(prim), Usd.TimeCode.EarliestTime()
    points = np.array(value_of(mesh.GetPointsAttr(), first) or np.empty((0, 3)), dtype=np.float64)
    used = np.unique(np.array(value_of(mesh.GetFaceVertexIndicesAttr(), first) or [], dtype=np.int64))
    used = used[used < len(points)]
    return _Points(points, used, len(np.unique(points[used], axis=0)))


def _distinct(mesh: Mesh) -> int:
    return len(np.unique(mesh.vertices[np.unique(mesh.faces)], axis=0))


def _correspondence(mesh: Mesh, found: _Points) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return indices of corresponding vertices in a rig's mesh and in the stage, matched by shape or else by order."""
    used = np.unique(mesh.faces).astype(np.int64)
    spread = np.unique(np.linspace(0, len(used) - 1, _POINTS).astype(int))
    same = len(mesh.vertices) == len(found.all)
    if not same or not _in_order(mesh.vertices, found.all):
        matched = match_points(mesh.vertices[used], found.all[found.used], spread, _SAME_POINT_MM)
        if matched is not None:
            return used[spread], found.used[matched]
    chosen = np.unique(np.linspace(0, min(len(mesh.vertices), len(found.all)) - 1, _POINTS).astype(int))
    return chosen, chosen


def _in_order(source: Array, points: Array) -> bool:
    """Return whether points are the vertices of a mesh in the same order, up to a rigid motion and scale."""
    chosen = np.unique(np.linspace(0, len(source) - 1, _POINTS).astype(int))
    a, b = source[chosen], points[chosen]
    b = b * (_spread(a) / _spread(b))
    residual = transform_points(rigid_fit(a, b), a) - b
    return bool(np.sqrt((residual**2).sum(axis=1).mean()) <= _MAX_MISFIT_MM)


def _plain(name: str) -> str:
    return name.lower().replace("_", "")
