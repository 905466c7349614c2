"""Commands on rigs in stages: `encode` poses of edited stages as d, and `rebake` d and mandible of a shot to agree."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from typer import Argument, BadParameter, Option

from jawusd.base.arrays import Array
from jawusd.base.errors import JawusdError
from jawusd.cli import options
from jawusd.cli.motion import AuthoredMotion, Changes, kept_inside, read_pose_table
from jawusd.cli.output import emit
from jawusd.evaluator import JawRig
from jawusd.formats.atomic import refuse_existing
from jawusd.formats.poses import PARAMETER_COLUMNS, write_table
from jawusd.geometry import transform_points
from jawusd.plugins.conversion import SUFFIXES, converted

if TYPE_CHECKING:
    from jawusd.rig.rebake import StageMotion


MandiblePrim = Annotated[
    str | None, Option("--mandible", help="For a stage: prim above the mandible's meshes, if names do not identify it.")
]
SkullPrim = Annotated[str | None, Option("--skull", help="For a stage: prim above the meshes of skull or upper teeth.")]
#: Sources from which a motion can be read.
Origin = Literal["d", "mandible"]
_ORIGINS: dict[Origin, str] = {"d": "values of d", "mandible": "mandible's transforms"}


def encode(
    rig: options.RigArg,
    poses: Annotated[
        Path, Argument(help="CSV or JSON of poses, tracks.npz, or a stage, .fbx or .glb with the actor's meshes.")
    ],
    out: Annotated[Path, Option("-o", "--out", help="CSV of frame, d1, d2, d3, residual_mm, margin_mm.")] = Path(
        "d.csv"
    ),
    mandible: MandiblePrim = None,
    skull: SkullPrim = None,
    force: options.Force = False,
    prim: options.Prim = None,
    allow: options.Allow = None,
    as_json: options.Json = False,
) -> None:
    """Convert poses to the nearest parameters d, with their distances from the model.

    In a stage, the mandible may be moved by transforms, bones or a point cache; `jawusd rebake` writes the result back.
    FBX and glTF are read through Blender.
    """
    refuse_existing(out, force)
    loaded = options.load_named(rig, prim, poses)
    if holds_stage(poses):
        motion = read_stage_motion(loaded, rig, poses, prim, mandible, skull, "mandible")
        frames, d, residual_mm = motion.frames.astype(int), motion.d, motion.residual_mm
    else:
        frames, T = read_pose_table(poses)
        d, residual_mm = loaded.encode(T)
    known = np.isfinite(d).all(1)
    values = np.column_stack([d, residual_mm, loaded.margin(d)])
    write_table(out, ("frame", *PARAMETER_COLUMNS, "residual_mm", "margin_mm"), frames[known], values[known])
    head = f"{out}: {int(known.sum())} of {len(d)} poses"
    size: dict[str, float | None] = {"mean": None, "max": None}
    if known.any():
        mean, largest = float(residual_mm[known].mean()), float(residual_mm[known].max())
        size = {"mean": mean, "max": largest}
        head += f", {mean:.3f} mm from the model on average, {largest:.3f} mm at most"
    judged = judged_motion(loaded, frames, d, residual_mm)
    result = {**judged, "file": str(out), "poses": len(d), "encoded": int(known.sum()), "residual_mm": size}
    still = still_lines(judged["moved_mm"], len(d)) if holds_stage(poses) else []
    emit(result, as_json, [head, *judged_lines(judged)[1:], *still])


_STILL_MM = 0.01  # displacement below which a jaw counts as still: ten times the rounding error of single precision


def read_stage_motion(
    loaded: JawRig,
    rig: Path,
    stage: Path,
    prim: str | None,
    mandible: str | None,
    skull: str | None,
    origin: Origin | None,
) -> StageMotion:
    """Read a jaw motion from a stage: from the rig in the stage or, if it has none, by fitting the rig's meshes.

    Args:
        stage: a stage, or a file that Blender converts to one.
        prim: path of the rig's prim in the stage, or in the rig's file if the stage comes from Blender.
        mandible, skull: paths of the prims above the meshes of mandible and skull.
        origin: whether to use d or the mandible's transform if they disagree; see `motion_of_stage`.
    """
    from jawusd.rig import describe
    from jawusd.rig.rebake import motion_of_stage
    from jawusd.rig.stage_poses import carries_rig

    if stage.suffix.lower() in SUFFIXES:
        _refuse_model(rig)
        rate = float(describe(rig, prim)["fps"])
        with tempfile.TemporaryDirectory() as folder:
            try:
                return _fitted(loaded, rig, converted(stage, folder, rate), mandible, skull, prim)
            except JawusdError as error:
                error.path = str(stage)
                raise
    if mandible is None and skull is None and carries_rig(stage, prim):
        return motion_of_stage(stage, loaded, prim, origin)
    return _fitted(loaded, rig, stage, mandible or prim, skull or prim, None)


def holds_stage(path: Path) -> bool:
    """Return whether a file is a stage, or can be converted to one by Blender."""
    return path.suffix.lower() in (*options.USD_SUFFIXES, *SUFFIXES)


def _fitted(
    loaded: JawRig, rig: Path, stage: Path, mandible: str | None, skull: str | None, prim: str | None
) -> StageMotion:
    from jawusd.rig.rebake import StageMotion
    from jawusd.rig.stage_poses import fit_poses_of_stage

    _refuse_model(rig)
    if rig.resolve() == stage.resolve():
        message = f"the meshes of {stage} deform and must be fitted to those of the rig: give the rig before the stage."
        raise BadParameter(message, param_hint="RIG")
    found = fit_poses_of_stage(stage, rig, mandible, skull, prim)
    d, residual_mm = loaded.encode(found.T)
    return StageMotion(found.frames.astype(float), d, found.fps, "mandible", residual_mm, fitted=True)


def _refuse_model(rig: Path) -> None:
    if rig.suffix.lower() not in options.USD_SUFFIXES:
        raise BadParameter("must be the rig's USD file, because its meshes are needed.", param_hint="RIG")


def judged_motion(rig: JawRig, frames: Array, d: Array, residual_mm: Array) -> dict[str, float]:
    """Return statistics of a motion's distances from the model and from the bound."""
    known = np.isfinite(d).all(axis=1)
    margin = np.where(known, rig.margin(d), np.inf)
    outside = known & ~rig.is_inside(d)
    worst = int(np.argmin(margin))
    return {
        "frames": len(frames),
        "moved_mm": moved_mm(rig, d),
        "largest_residual_mm": float(np.nanmax(residual_mm, initial=0.0)),
        "off_model": int((residual_mm > rig.limits.residual_mm).sum()),
        "outside": int(outside.sum()),
        "beyond_tolerance": int((margin < -rig.tolerance_mm).sum()),
        "worst_frame": float(frames[worst]),
        "worst_margin_mm": float(margin[worst]),
    }


def moved_mm(rig: JawRig, d: Array) -> float:
    """Return the maximum displacement of a landmark from its position in the first pose of a motion d (F, 3) [mm]."""
    places = transform_points(rig.pose(d[np.isfinite(d).all(axis=1)]), rig.landmarks)
    return float(np.linalg.norm(places - places[:1], axis=-1).max(initial=0.0))


def still_lines(largest_mm: float, frames: int) -> list[str]:
    """Return a warning if the mandible of a stage does not move, as happens if drivers are exported without baking."""
    if largest_mm > _STILL_MM:
        return []
    return [f"the mandible does not move in {frames} frames: was it exported without baking? Bake it to keys first"]


def judged_lines(judged: dict[str, float]) -> list[str]:
    """Return `judged_motion` as text."""
    lines = [f"at most {judged['largest_residual_mm']:.3f} mm from the model"]
    if judged["off_model"]:
        lines.append(f"{judged['off_model']} of {judged['frames']} poses are farther from the model than measured ones")
    if judged["outside"]:
        where = f"worst at frame {judged['worst_frame']:g}, margin {judged['worst_margin_mm']:.2f} mm"
        lines.append(f"{judged['outside']} of {judged['frames']} samples lay outside the bound; {where}")
    return lines


def rebake(
    rig: Annotated[
        Path,
        Argument(
            help="The shot; or the rig, if STAGE is FBX, glTF or a stage with copies of the rig's meshes.",
            metavar="SHOT | RIG STAGE",
            callback=options.rig_of_folder,
        ),
    ],
    stage: Annotated[Path | None, Argument(help="Shot or animation layer, or an export of it.")] = None,
    out: Annotated[Path | None, Option("-o", "--out", help="Layer to write. Default: <shot>_baked.usdc.")] = None,
    root: Annotated[bool, Option("--root", help="Make the layer a new root that sublayers the shot.")] = False,
    origin: Annotated[Origin | None, Option("--from", help="Source to use if d and mandible disagree.")] = None,
    mandible: MandiblePrim = None,
    skull: SkullPrim = None,
    prim: Annotated[
        list[str] | None, Option("--prim", metavar="PRIM", help="Prim paths of the rigs to bake. Default: all.")
    ] = None,
    allow: options.Allow = None,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Make d and the mandible's transform agree, for all rigs of a shot, where only one of the two was edited.

    The layer written contains opinions for all rigs; add it to the sublayers of the shot. Motions are projected into
    the bound, and samples outside it are reported with their margin. If a stage has no rig but copies of its meshes,
    moved by transforms, bones or point caches, the layer is one over RIG. FBX and glTF are read through Blender.
    """
    shot = stage or rig
    out = out or shot.with_name(f"{shot.stem}_baked.usdc")
    refuse_existing(out, force)
    taken = []
    for path in _rigs_of(rig, stage, prim):
        loaded = options.load_named(rig, path, shot)
        found = read_stage_motion(loaded, rig, shot, path, mandible, skull, origin)
        motion, changes = kept_inside(loaded, AuthoredMotion(found.frames, found.d, found.fps))
        judged = judged_motion(loaded, found.frames, found.d, found.residual_mm)
        taken.append(_BakedRig(loaded, found, motion, changes, judged))
    stronger = _write_baked(out, rig, shot, taken, root, prim[0] if prim else None)
    actors = [{"prim": one.found.prim, "from": one.found.origin, **one.judged, **one.changes.figures} for one in taken]
    result = {"file": str(out), **(actors[0] if len(actors) == 1 else {}), "actors": actors, "stronger": stronger}
    emit(result, as_json, _baked_lines(out, shot, taken, stronger))


@dataclass(frozen=True)
class _BakedRig:
    """The motion of one rig of a shot: as read, as projected into the bound, and the changes made."""

    rig: JawRig
    found: StageMotion
    motion: AuthoredMotion
    changes: Changes
    judged: dict[str, float]


def _rigs_of(rig: Path, stage: Path | None, prims: list[str] | None) -> list[str | None]:
    """Return the prims to bake: those given, otherwise all rigs of the shot; None stands for the only rig or RIG."""
    if stage is not None and len(prims or ()) > 1:
        raise BadParameter("RIG STAGE bakes one rig; to bake several rigs, give only the shot.", param_hint="--prim")
    if prims or stage is not None:
        return [*prims] if prims else [None]
    from jawusd.rig.layout import rig_prims
    from jawusd.rig.read import find_rig_prim, open_stage

    opened = open_stage(rig)
    return [str(prim.GetPath()) for prim in rig_prims(opened)] or [str(find_rig_prim(opened, rig).GetPath())]


def _write_baked(
    out: Path, rig: Path, shot: Path, taken: Sequence[_BakedRig], root: bool, prim: str | None
) -> list[str]:
    """Write the layer; return the prims for which the shot's own layer has stronger opinions."""
    from jawusd.rig import write_animation
    from jawusd.rig.rebake import Rebaked, write_over, write_rebaked

    first = taken[0]
    motion = first.motion
    if first.found.fitted and prim is not None and shot.suffix.lower() not in options.USD_SUFFIXES:
        # in the other branches, `prim` is a path in the shot
        write_over(out, rig, first.rig, motion.frames, motion.d, first.found.fps, prim)
    elif first.found.fitted:
        write_animation(out, rig, motion.frames, motion.d, first.found.fps, rig=first.rig)
    else:
        known = [np.isfinite(one.motion.d).all(axis=1) for one in taken]
        given = [
            Rebaked(one.rig, one.motion.frames[seen], one.motion.d[seen], one.found.prim)
            for one, seen in zip(taken, known, strict=True)
        ]
        return write_rebaked(out, shot, given, root=root)
    return []


def _baked_lines(out: Path, shot: Path, taken: Sequence[_BakedRig], stronger: Sequence[str]) -> list[str]:
    lines = []
    for one in taken:
        first, last = float(one.motion.frames[0]), float(one.motion.frames[-1])
        head = f"{out}: {one.found.prim}: " if len(taken) > 1 else f"{out}: "
        lines.append(
            f"{head}frames {first:g} .. {last:g} at {one.found.fps:g} fps, from the {_ORIGINS[one.found.origin]}"
        )
        still = still_lines(one.judged["moved_mm"], len(one.found.d)) if one.found.origin == "mandible" else []
        lines += [*judged_lines(one.judged), *still, *one.changes.lines[1:]]
    if stronger:
        lines.append(f"{shot} itself has stronger opinions on {', '.join(stronger)}: its sublayers are weaker.")
        lines.append("Write a root above it with --root, or sublayer both with this layer first")
    return lines
