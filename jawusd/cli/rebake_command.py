"""The command `rebake`: write a layer in which d and the mandible's transform agree, for all jaws of a shot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from jawusd.cli.options import USD_SUFFIXES, Allow, Force, Json, load_named, rig_of_folder
from jawusd.cli.output import emit
from jawusd.cli.stage_commands import (
    MandiblePrim,
    SkullPrim,
    judged_lines,
    judged_motion,
    read_stage_motion,
    still_lines,
)
from jawusd.formats.atomic import refuse_existing

if TYPE_CHECKING:
    from jawusd.cli.motion import AuthoredMotion, Changes
    from jawusd.evaluator import JawRig
    from jawusd.rig.rebake import StageMotion

_ORIGINS = {"d": "values of d", "mandible": "mandible's transforms"}


class Origin(StrEnum):
    """Sources from which a motion can be read."""

    d = "d"
    mandible = "mandible"


def rebake(
    rig: Annotated[
        Path,
        typer.Argument(
            help="The shot; or the rig, if STAGE is FBX, glTF or a stage with copies of the rig's meshes.",
            metavar="SHOT | RIG STAGE",
            callback=rig_of_folder,
            show_default=False,
        ),
    ],
    stage: Annotated[
        Path | None, typer.Argument(help="Shot or animation layer, or an export of it.", show_default=False)
    ] = None,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Layer to write. Default: <shot>_baked.usdc.")] = None,
    root: Annotated[bool, typer.Option("--root", help="Make the layer a new root that sublayers the shot.")] = False,
    origin: Annotated[
        Origin | None, typer.Option("--from", help="Source to use if d and mandible disagree.", show_default=False)
    ] = None,
    mandible: MandiblePrim = None,
    skull: SkullPrim = None,
    prim: Annotated[
        list[str] | None,
        typer.Option(
            "--prim", metavar="PRIM", help="Prim paths of the rigs to bake. Default: all.", show_default=False
        ),
    ] = None,
    allow: Allow = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Make d and the mandible's transform agree, for all rigs of a shot, where only one of the two was edited.

    The layer written contains opinions for all rigs; add it to the sublayers of the shot. Motions are projected into
    the bound, and samples outside it are reported with their margin. If a stage has no rig but copies of its meshes,
    moved by transforms, bones or point caches, the layer is one over RIG. FBX and glTF are read through Blender.
    """
    shot = stage or rig
    out = out or shot.with_name(f"{shot.stem}_baked.usdc")
    refuse_existing(out, force)
    taken = [
        _bake_rig(rig, shot, one, mandible, skull, origin.value if origin else None)
        for one in _rigs_of(rig, stage, prim)
    ]
    stronger = _write_baked(out, rig, shot, taken, root, prim[0] if prim else None)
    actors = [{"prim": one.found.prim, "from": one.found.origin, **one.judged, **one.changes.figures} for one in taken]
    result = {"file": str(out), **(actors[0] if len(actors) == 1 else {}), "actors": actors, "stronger": stronger}
    emit(result, as_json, lambda: _baked_lines(out, shot, taken, stronger))


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
        raise typer.BadParameter(
            "RIG STAGE bakes one rig; to bake several rigs, give only the shot.", param_hint="--prim"
        )
    if prims or stage is not None:
        return [*prims] if prims else [None]
    from jawusd.rig.layout import rig_prims
    from jawusd.rig.read import find_rig_prim, open_stage

    opened = open_stage(rig)
    return [str(prim.GetPath()) for prim in rig_prims(opened)] or [str(find_rig_prim(opened, rig).GetPath())]


def _bake_rig(
    rig: Path,
    shot: Path,
    prim: str | None,
    mandible: str | None,
    skull: str | None,
    origin: Literal["d", "mandible"] | None,
) -> _BakedRig:
    from jawusd.cli.motion import AuthoredMotion, kept_inside

    loaded = load_named(rig, prim, shot)
    found = read_stage_motion(loaded, rig, shot, prim, mandible, skull, origin)
    motion, changes = kept_inside(loaded, AuthoredMotion(found.frames, found.d, found.fps))
    return _BakedRig(loaded, found, motion, changes, judged_motion(loaded, found.frames, found.d, found.residual_mm))


def _write_baked(
    out: Path, rig: Path, shot: Path, taken: Sequence[_BakedRig], root: bool, prim: str | None
) -> list[str]:
    """Write the layer; return the prims for which the shot's own layer has stronger opinions."""
    import numpy as np

    from jawusd.rig import write_animation
    from jawusd.rig.rebake import Rebaked, write_over, write_rebaked

    first = taken[0]
    motion = first.motion
    if (
        first.found.fitted and prim is not None and shot.suffix.lower() not in USD_SUFFIXES
    ):  # in the other branches, `prim` is a path in the shot
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
