"""Commands on rigs among other files: stages edited elsewhere come back to d, rigs get names of their own."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from jawusd.cli.options import USD_SUFFIXES, Allow, Force, Json, Prim, RigArg, load_named, rig_of_folder
from jawusd.cli.output import emit
from jawusd.errors import JawusdError
from jawusd.formats.atomic import refuse_existing

if TYPE_CHECKING:
    from jawusd.cli.motion import AuthoredMotion, Changes
    from jawusd.evaluator import JawRig
    from jawusd.geometry.arrays import Array
    from jawusd.rig.rebake import StageMotion


MandiblePrim = Annotated[
    str | None,
    typer.Option("--mandible", help="Of a stage: prim that holds the mandible's meshes, where names do not tell."),
]
SkullPrim = Annotated[str | None, typer.Option("--skull", help="The same of skull or upper teeth.")]


class Origin(StrEnum):
    """Name what a motion can be read from."""

    d = "d"
    mandible = "mandible"


def encode(
    rig: RigArg,
    poses: Annotated[
        Path,
        typer.Argument(
            help="CSV or JSON of poses, tracks.npz, or a stage, .fbx or .glb with the actor's meshes.",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="CSV of frame, d1, d2, d3, residual_mm, margin_mm.")] = Path(
        "d.csv"
    ),
    mandible: MandiblePrim = None,
    skull: SkullPrim = None,
    force: Force = False,
    prim: Prim = None,
    allow: Allow = None,
    as_json: Json = False,
) -> None:
    """Find the parameters d whose poses are nearest to given ones, and how far these are from the model.

    Of a stage, the mandible may be moved by transforms, bones or a point cache; `jawusd rebake` writes it back. FBX and
    glTF are read through Blender.
    """
    import numpy as np

    from jawusd.cli.motion import read_pose_table
    from jawusd.formats.poses import PARAMETER_COLUMNS, write_table

    refuse_existing(out, force)
    loaded = load_named(rig, prim, poses)
    if holds_stage(poses):
        motion = read_stage_motion(loaded, rig, poses, prim, mandible, skull, "mandible")
        frames, d, residual_mm = motion.frames.astype(int), motion.d, motion.residual_mm
    else:
        frames, T = read_pose_table(poses)
        d, residual_mm = loaded.encode(T)
    known = np.isfinite(d).all(1)
    margin_mm = loaded.margin(d)
    values = np.column_stack([d, residual_mm, margin_mm])
    write_table(out, ("frame", *PARAMETER_COLUMNS, "residual_mm", "margin_mm"), frames[known], values[known])
    residual = residual_mm[known]
    size = {
        "mean": float(residual.mean()) if residual.size else None,
        "max": float(residual.max()) if residual.size else None,
    }
    judged = judged_motion(loaded, frames, d, residual_mm)
    result = {**judged, "file": str(out), "poses": len(d), "encoded": int(known.sum()), "residual_mm": size}
    head = f"{out}: {result['encoded']} of {len(d)} poses, residual {size}"
    emit(result, as_json, lambda: [head, *judged_lines(judged)[1:]])


def rebake(
    rig: Annotated[
        Path,
        typer.Argument(
            help="The shot; or before a stage that holds copies of a rig's meshes, FBX or glTF: the rig.",
            metavar="SHOT | RIG STAGE",
            callback=rig_of_folder,
            show_default=False,
        ),
    ],
    stage: Annotated[
        Path | None, typer.Argument(help="Shot or animation layer, or what was exported of it.", show_default=False)
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Layer to write; <shot>_baked.usdc if not given.")
    ] = None,
    root: Annotated[bool, typer.Option("--root", help="Let the layer be a new root: it sublayers the shot.")] = False,
    origin: Annotated[
        Origin | None, typer.Option("--from", help="What counts where d and mandible disagree.", show_default=False)
    ] = None,
    mandible: MandiblePrim = None,
    skull: SkullPrim = None,
    prim: Annotated[
        list[str] | None,
        typer.Option(
            "--prim", help="Which rigs of the shot: paths of their prims; all if not given.", show_default=False
        ),
    ] = None,
    allow: Allow = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Give the rigs of a shot the d and the mandible that belong together, where only one was keyed or moved.

    One layer holds the opinions for all rigs, to be sublayered by the shot. Motions are brought inside the bound; what
    lay outside is reported with its margin. A stage without the rig, that holds copies of its meshes, moved by
    transforms, bones or point caches, gives a layer over RIG. FBX and glTF are read through Blender.
    """
    shot = stage or rig
    out = out or shot.with_name(f"{shot.stem}_baked.usdc")
    refuse_existing(out, force)
    taken = [
        _taken(rig, shot, one, mandible, skull, origin.value if origin else None) for one in _rigs_of(rig, stage, prim)
    ]
    stronger = _write_baked(out, rig, shot, taken, root, prim[0] if prim else None)
    actors = [{"prim": one.found.prim, "from": one.found.origin, **one.judged, **one.changes.figures} for one in taken]
    result = {"file": str(out), **(actors[0] if len(actors) == 1 else {}), "actors": actors, "stronger": stronger}
    emit(result, as_json, lambda: _baked_lines(out, shot, taken, stronger))


@dataclass(frozen=True)
class _Taken:
    """Hold what one rig of a shot is given: as found, inside the bound, and what was changed for that."""

    rig: JawRig
    found: StageMotion
    motion: AuthoredMotion
    changes: Changes
    judged: dict[str, float]


def _rigs_of(rig: Path, stage: Path | None, prims: list[str] | None) -> list[str | None]:
    """Return which rigs are baked: those named, else all of a shot; None for the only one, or for that of RIG."""
    if stage is not None and len(prims or ()) > 1:
        raise typer.BadParameter("RIG STAGE bakes one rig; several are baked with the shot alone.", param_hint="--prim")
    if prims or stage is not None:
        return [*prims] if prims else [None]
    from jawusd.rig.read import find_rig_prim, open_stage
    from jawusd.rig.schema import rig_prims

    opened = open_stage(rig)
    return [str(prim.GetPath()) for prim in rig_prims(opened)] or [str(find_rig_prim(opened, rig).GetPath())]


def _taken(
    rig: Path,
    shot: Path,
    prim: str | None,
    mandible: str | None,
    skull: str | None,
    origin: Literal["d", "mandible"] | None,
) -> _Taken:
    from jawusd.cli.motion import AuthoredMotion, kept_inside

    loaded = load_named(rig, prim, shot)
    found = read_stage_motion(loaded, rig, shot, prim, mandible, skull, origin)
    motion, changes = kept_inside(loaded, AuthoredMotion(found.frames, found.d, found.fps))
    return _Taken(loaded, found, motion, changes, judged_motion(loaded, found.frames, found.d, found.residual_mm))


def _write_baked(out: Path, rig: Path, shot: Path, taken: Sequence[_Taken], root: bool, prim: str | None) -> list[str]:
    """Write the layer; return what is stronger than it in the shot's own layer."""
    import numpy as np

    from jawusd.rig import write_animation
    from jawusd.rig.rebake import Rebaked, write_over, write_rebaked

    first = taken[0]
    motion = first.motion
    if first.found.fitted and prim is not None and shot.suffix.lower() not in USD_SUFFIXES:  # else it is the shot's
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


def _baked_lines(out: Path, shot: Path, taken: Sequence[_Taken], stronger: Sequence[str]) -> list[str]:
    lines = []
    for one in taken:
        first, last = float(one.motion.frames[0]), float(one.motion.frames[-1])
        head = f"{out}: {one.found.prim}: " if len(taken) > 1 else f"{out}: "
        lines.append(
            f"{head}frames {first:g} .. {last:g} at {one.found.fps:g} fps, from the {_ORIGINS[one.found.origin]}"
        )
        lines += [*judged_lines(one.judged), *one.changes.lines[1:]]
    if stronger:
        lines.append(
            f"{shot} itself says something else of {', '.join(stronger)}: a layer that it sublayers is weaker."
        )
        lines.append("Write a root above it with --root, or sublayer both, this layer first")
    return lines


def publish(
    source: Annotated[
        Path,
        typer.Argument(help="Folder of a rig, with actor.usda, or a shot.", metavar="FOLDER|SHOT", show_default=False),
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder to write to, or of a shot the .usdz.", show_default=False)
    ],
    prefix: Annotated[
        str | None, typer.Option(help="Start of every file's name; the actor's name if not given.", show_default=False)
    ] = None,
    force: Force = False,
    allow: Allow = None,
    as_json: Json = False,
) -> None:
    """Copy a rig under file names of its own, so that actors can be packed together; or pack a whole shot as .usdz."""
    from jawusd.rig.package import write_package
    from jawusd.rig.publish import publish_rig

    refuse_existing(out, force)
    if not source.is_dir():
        if out.suffix.lower() != ".usdz" or prefix is not None:
            raise typer.BadParameter("of a shot, name a .usdz and no prefix.", param_hint="--out")
        files = [str(write_package(out, source))]
    else:
        files = [str(path) for path in publish_rig(source, out, prefix)]
    emit({"files": files}, as_json, lambda: files)


_ORIGINS = {"d": "values of d", "mandible": "mandible's transforms"}


def read_stage_motion(
    loaded: JawRig,
    rig: Path,
    stage: Path,
    prim: str | None,
    mandible: str | None,
    skull: str | None,
    origin: Literal["d", "mandible"] | None,
) -> StageMotion:
    """Read the motion of a jaw from any stage: of the rig it carries, or else of the rig's meshes fitted to it.

    Args:
        loaded, rig: The rig and its file.
        stage: A stage, or a file that Blender makes one of.
        prim: Which rig, where the stage has several, or the rig's file if the stage comes from Blender.
        mandible, skull: Prims to look below for the meshes.
        origin: What counts, see `motion_of_stage`.

    Raises:
        JawusdError: no such motion.
    """
    from jawusd.plugins.conversion import SUFFIXES, converted
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
    """Tell whether a file is a stage, or one that Blender makes a stage of."""
    from jawusd.plugins.conversion import SUFFIXES

    return path.suffix.lower() in (*USD_SUFFIXES, *SUFFIXES)


def _fitted(
    loaded: JawRig, rig: Path, stage: Path, mandible: str | None, skull: str | None, prim: str | None
) -> StageMotion:
    from jawusd.rig.layout import ACTOR
    from jawusd.rig.rebake import StageMotion
    from jawusd.rig.stage_poses import fit_poses_of_stage

    _refuse_model(rig)
    if rig.resolve() == stage.resolve():
        message = f"meshes of {stage} deform, and are fitted to those of the rig: name the rig before it."
        raise typer.BadParameter(message, param_hint="RIG")
    found = fit_poses_of_stage(stage, rig, mandible, skull, prim or ACTOR)
    d, residual_mm = loaded.encode(found.T)
    return StageMotion(found.frames.astype(float), d, found.fps, "mandible", residual_mm, fitted=True)


def _refuse_model(rig: Path) -> None:
    if rig.suffix.lower() not in USD_SUFFIXES:
        raise typer.BadParameter("must be the rig's USD file here: its meshes are fitted.", param_hint="RIG")


def judged_motion(rig: JawRig, frames: Array, d: Array, residual_mm: Array) -> dict[str, float]:
    """Return how far a motion is from the model and from the bound."""
    import numpy as np

    known = np.isfinite(d).all(axis=1)
    margin = np.where(known, rig.margin(d), np.inf)
    outside = known & ~rig.is_inside(d)
    worst = int(np.argmin(margin))
    return {
        "frames": len(frames),
        "largest_residual_mm": float(np.nanmax(residual_mm, initial=0.0)),
        "off_model": int((residual_mm > rig.limits.residual_mm).sum()),
        "outside": int(outside.sum()),
        "beyond_tolerance": int((margin < -rig.tolerance_mm).sum()),
        "worst_frame": float(frames[worst]),
        "worst_margin_mm": float(margin[worst]),
    }


def judged_lines(judged: dict[str, float]) -> list[str]:
    """Return the same in words."""
    lines = [f"at most {judged['largest_residual_mm']:.3f} mm from the model"]
    if judged["off_model"]:
        lines.append(f"{judged['off_model']} of {judged['frames']} poses are farther from the model than measured ones")
    if judged["outside"]:
        where = f"worst at frame {judged['worst_frame']:g}, margin {judged['worst_margin_mm']:.2f} mm"
        lines.append(f"{judged['outside']} of {judged['frames']} samples lay outside the bound; {where}")
    return lines
