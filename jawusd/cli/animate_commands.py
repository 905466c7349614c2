"""Commands that write an animation layer, or tabulate ARKit shapes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from typer import Argument, BadParameter, Option

import jawusd
from jawusd.base.errors import FormatError
from jawusd.cli import options
from jawusd.cli.motion import (
    AuthoredMotion,
    carried_over,
    emit_motion,
    follow_curves,
    kept_inside,
    knots_of,
    read_motion,
    resampled,
)
from jawusd.cli.output import emit, refuse_any
from jawusd.cli.stage_commands import holds_stage, moved_mm, read_stage_motion, still_lines
from jawusd.evaluator import JawRig
from jawusd.formats.arkit import read_arkit, read_blend_shapes, shares_of
from jawusd.formats.atomic import refuse_existing
from jawusd.formats.poses import save_joint_table

Rate = Annotated[
    float | None,
    Option(
        min=0.001,
        help="Frames per second; with --arkit, of the output. Default: from the keys or time codes, else from the rig.",
    ),
]
RetargetFrom = Annotated[
    Path | None,
    Option(
        help="Rig for which the source was made; the source may then also be an animation layer.",
        callback=options.rig_of_folder,
    ),
]


def _source_motion(loaded: JawRig, rig: Path, source: Path, prim: str | None) -> AuthoredMotion:
    if not holds_stage(source):
        return read_motion(loaded, source)
    own = None if source.suffix.lower() in options.USD_SUFFIXES else prim  # the rig's prim path in the stage may differ
    found = read_stage_motion(loaded, rig, source, own, None, None, None)
    return AuthoredMotion(found.frames, found.d, found.fps)


def _is_glb(path: Path) -> bool:
    return path.suffix.lower() == ".glb"


def _write(
    out: Path, rig: Path, loaded: JawRig, motion: AuthoredMotion, rate: float, prim: str | None, splines: Path | None
) -> tuple[AuthoredMotion, list[str]]:
    """Write a layer or a .glb, and optionally the keys as splines; return the motion written, and notes."""
    from jawusd.rig import write_animation, write_splines
    from jawusd.rig.glb import frame_at_zero, write_glb
    from jawusd.rig.rebake import write_over

    knots = knots_of(loaded, motion)
    motion = follow_curves(loaded, motion, knots)
    if _is_glb(out):
        write_glb(out, rig, loaded, motion.frames, motion.d, rate)
        if zero := frame_at_zero(motion.frames):
            why = "glTF has no negative times, and its times are too coarse beyond frame 100000"
            return motion, [f"frame {zero:g} is at 0 s: {why}"]
    elif prim is not None:
        write_over(out, rig, loaded, motion.frames, motion.d, rate, prim)
    else:
        write_animation(out, rig, motion.frames, motion.d, rate)
    if splines is not None:
        write_splines(splines, out, knots.frames, knots.d, rate, knots.slopes, knots.curved)
    return motion, []


def animate(
    rig: options.RigArg,
    source: Annotated[Path | None, Argument(help="keys.json, a CSV of d or of poses, a stage, .fbx or .glb.")] = None,
    retarget_from: RetargetFrom = None,
    arkit: Annotated[
        Path | None, Option(help="ARKit face capture instead of SOURCE: the CSV of Live Link Face.")
    ] = None,
    mapping: Annotated[
        Path | None,
        Option(
            help="The actor's map from ARKit weights to d, written by arkit-fit or skin-fit. "
            "Default: fractions of the ranges."
        ),
    ] = None,
    out: Annotated[Path, Option("-o", "--out", help="Animation layer, or .glb for the web.")] = Path("anim.usdc"),
    fps: Rate = None,
    resample: Annotated[
        float | None,
        Option("--resample", min=0.001, help="Frames per second of the layer, if different from the source."),
    ] = None,
    splines: Annotated[Path | None, Option(help="Also write the keys as USD splines, to this layer.")] = None,
    force: options.Force = False,
    prim: options.Prim = None,
    allow: options.Allow = None,
    as_json: options.Json = False,
) -> None:
    """Write an animation layer over a rig, or meshes and motion as .glb; frames clamped to the bound are reported."""
    from jawusd.rig import describe

    options.refuse_conflicts(
        ((source is None) == (arkit is None), "SOURCE", "give either a source or --arkit."),
        (arkit and retarget_from, "--retarget-from", "needs a source; ARKit weights do not belong to a rig."),
        (mapping and not arkit, "--mapping", "needs --arkit, whose weights it maps."),
        (resample and retarget_from, "--resample", "needs a source made for this rig; retarget first."),
        (prim and splines, "--splines", "cannot be combined with --prim."),
        (_is_glb(out) and prim, "--prim", "needs a layer; a .glb is made from the actor's own file."),
        (_is_glb(out) and splines, "--splines", "needs a layer, not a .glb."),
    )
    refuse_any(force, out, splines)
    loaded = jawusd.load(rig, prim=prim)
    if source is not None and retarget_from is not None:
        motion, changes = carried_over(retarget_from, source, loaded)
    elif source is not None:
        motion = _source_motion(loaded, rig, source, prim)
    elif arkit is not None:
        motion = read_face(loaded, arkit, fps, mapping)
    rate = (arkit is None and fps) or motion.fps or describe(rig, prim)["fps"]
    if resample is not None:
        motion, rate = resampled(loaded, motion, rate, resample), resample
    if retarget_from is None:
        given = motion.d
        motion, changes = kept_inside(loaded, motion)
        if source is not None and holds_stage(source):
            changes.lines.extend(still_lines(moved_mm(loaded, given), len(given)))
    motion, said = _write(out, rig, loaded, motion, rate, prim, splines)
    changes.lines.extend(said)
    emit_motion(out, rate, motion, changes, as_json)


_CLAMPED_MM = 0.005  # minimum distance for a frame to be listed; smaller distances would be printed as 0.00


def arkit_table(
    rig: options.RigArg,
    out: Annotated[Path, Option("-o", "--out", help="Table to write (CSV).")] = Path("joint.csv"),
    mapping: Annotated[
        Path | None, Option(help="The actor's map, written by arkit-fit. Default: fractions of the ranges.")
    ] = None,
    force: options.Force = False,
    prim: options.Prim = None,
    allow: options.Allow = None,
    as_json: options.Json = False,
) -> None:
    """Write the jaw joint's offset for each ARKit shape at half and full weight, for rigs that sum joint deltas.

    Offsets are in millimetres and degrees relative to the neutral face, about the point midway between the condyles,
    along the skull's axes.
    """
    from jawusd.pipeline.bake import joint_deltas
    from jawusd.pipeline.skin import load_own_skin

    refuse_existing(out, force)
    loaded = jawusd.load(rig, prim=prim)
    rows = joint_deltas(loaded, None if mapping is None else load_own_skin(loaded, mapping))
    save_joint_table(out, rows)
    clamped = [row for row in rows if row.clamped_mm > _CLAMPED_MM]
    lines = [f"{out}: {len(rows)} rows"]
    lines += [f"{row.shape} {row.weight:g} lay {row.clamped_mm:.2f} mm outside the bound" for row in clamped]
    emit({"file": str(out), "rows": len(rows), "clamped": len(clamped)}, as_json, lines)


def rate_of(rig: Path, prim: str | None) -> float:
    """Return the frame rate of a rig, for a jaw motion whose file states none; raises typer.BadParameter."""
    from jawusd.rig import describe

    if rig.suffix.lower() not in options.USD_SUFFIXES:
        raise BadParameter("is needed: neither the jaw motion nor the rig states a frame rate.", param_hint="--jaw-fps")
    return float(describe(rig, prim)["fps"])


def read_face(rig: JawRig, source: Path, fps: float | None, mapping: Path | None) -> AuthoredMotion:
    """Read the jaw motion of an ARKit face capture, by the subject's map or as fractions of the ranges of motion.

    Without a mapping, JawOpen = 1 is the full opening, and (JawLeft - JawRight) and JawForward are fractions of the
    ranges of motion at the current opening. Left is the subject's left. Without `fps`, the time codes give the rate.
    Raises FormatError if no row has a face.
    """
    from jawusd.pipeline.skin import load_own_skin, own_columns

    if mapping is not None:
        face, skin = read_blend_shapes(source, fps), load_own_skin(rig, mapping)
        frames, rate, d = face.frames, face.fps, skin(own_columns(skin, mapping, face, source)).d
    else:
        face = read_arkit(source, fps)
        frames, rate, d = face.frames, face.fps, rig.denormalized(shares_of(face.X))
    if not np.isfinite(d).any():
        raise FormatError("no row has a face (BlendShapeCount is 0 in all rows).", path=source)
    return AuthoredMotion(frames, d, rate)
