"""The command `animate`: keys, tables, face captures and stages become an animation layer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jawusd.cli.options import USD_SUFFIXES, Allow, Force, Json, Prim, RigArg, rig_of_folder
from jawusd.formats.atomic import refuse_existing

if TYPE_CHECKING:
    from jawusd.cli.motion import AuthoredMotion, Changes
    from jawusd.evaluator import JawRig

Rate = Annotated[
    float | None,
    typer.Option(
        min=0.001, help="Frames per second; of --arkit those wanted; else from the keys or time codes, or the rig's."
    ),
]
RetargetFrom = Annotated[
    Path | None,
    typer.Option(
        help="Rig the source was made for; also animation layers then.", callback=rig_of_folder, show_default=False
    ),
]


def _source_motion(loaded: JawRig, rig: Path, source: Path, prim: str | None) -> AuthoredMotion:
    from jawusd.cli.motion import AuthoredMotion, read_motion
    from jawusd.cli.stage_commands import holds_stage, read_stage_motion

    if not holds_stage(source):
        return read_motion(loaded, source)
    own = None if source.suffix.lower() in USD_SUFFIXES else prim  # a stage may have the rig elsewhere
    found = read_stage_motion(loaded, rig, source, own, None, None, None)
    return AuthoredMotion(found.frames, found.d, found.fps)


def _kept(loaded: JawRig, source: Path | None, motion: AuthoredMotion) -> tuple[AuthoredMotion, Changes]:
    """Return the motion inside the bound and what was changed; a stage, FBX or glTF in which nothing moves is named."""
    from jawusd.cli.motion import kept_inside
    from jawusd.cli.stage_commands import holds_stage, moved_mm, still_lines

    kept, changes = kept_inside(loaded, motion)
    if source is not None and holds_stage(source):
        changes.lines.extend(still_lines(moved_mm(loaded, motion.d), len(motion.d)))
    return kept, changes


def _refuse_conflicts(
    source: Path | None,
    arkit: Path | None,
    retarget_from: Path | None,
    mapping: Path | None,
    resample: float | None,
    prim: str | None,
    splines: Path | None,
    out: Path,
) -> None:
    conflicts = (
        ((source is None) == (arkit is None), "SOURCE", "give either a source or --arkit."),
        (arkit and retarget_from, "--retarget-from", "goes with a source; weights of --arkit are nobody's."),
        (mapping and not arkit, "--mapping", "says what the weights of --arkit mean; give both."),
        (resample and retarget_from, "--resample", "goes with a source of this rig; retarget first."),
        (prim and splines, "--splines", "goes with the actor's own file, not with --prim."),
        (_is_glb(out) and prim, "--prim", "goes with a layer; a .glb is made of the actor's own file."),
        (_is_glb(out) and splines, "--splines", "goes with a layer, not with a .glb."),
    )
    for conflict, option, why in conflicts:
        if conflict:
            raise typer.BadParameter(why, param_hint=option)


def _is_glb(path: Path) -> bool:
    return path.suffix.lower() == ".glb"


def _write(
    out: Path, rig: Path, loaded: JawRig, motion: AuthoredMotion, rate: float, prim: str | None, splines: Path | None
) -> tuple[AuthoredMotion, list[str]]:
    """Write a layer or a .glb, and the keys as splines; return the motion written and what to say about it."""
    from jawusd.cli.motion import follow_curves, knots_of
    from jawusd.rig import write_animation, write_splines
    from jawusd.rig.glb import frame_at_zero, write_glb
    from jawusd.rig.rebake import write_over

    knots = knots_of(loaded, motion)
    motion = follow_curves(loaded, motion, knots)
    if _is_glb(out):
        write_glb(out, rig, loaded, motion.frames, motion.d, rate)
        if zero := frame_at_zero(motion.frames):
            why = "glTF has no times before 0, and none fine enough beyond frame 100000"
            return motion, [f"frame {zero:g} is at 0 s: {why}"]
    elif prim is not None:
        write_over(out, rig, loaded, motion.frames, motion.d, rate, prim)
    else:
        write_animation(out, rig, motion.frames, motion.d, rate)
    if splines is not None:
        write_splines(splines, out, knots.frames, knots.d, rate, knots.slopes, knots.curved)
    return motion, []


def animate(
    rig: RigArg,
    source: Annotated[
        Path | None,
        typer.Argument(help="keys.json, a CSV of d or of poses, a stage, .fbx or .glb.", show_default=False),
    ] = None,
    retarget_from: RetargetFrom = None,
    arkit: Annotated[
        Path | None, typer.Option(help="Instead: ARKit face capture, the CSV of Live Link Face.", show_default=False)
    ] = None,
    mapping: Annotated[
        Path | None,
        typer.Option(
            help="The actor's own mapping of --arkit, from arkit-fit; else shares of the ranges.", show_default=False
        ),
    ] = None,
    out: Annotated[Path, typer.Option("-o", "--out", help="Animation layer, or .glb for the web.")] = Path("anim.usdc"),
    fps: Rate = None,
    resample: Annotated[
        float | None,
        typer.Option("--resample", min=0.001, help="Frames per second of the layer, where the source has others."),
    ] = None,
    splines: Annotated[Path | None, typer.Option(help="Also write the keys as USD splines, to this layer.")] = None,
    force: Force = False,
    prim: Prim = None,
    allow: Allow = None,
    as_json: Json = False,
) -> None:
    """Write an animation layer over a rig, or meshes and motion as .glb; clamping to the bound is reported."""
    import jawusd
    from jawusd.cli.face_commands import read_face
    from jawusd.cli.motion import carried_over, emit_motion
    from jawusd.cli.resampling import resampled
    from jawusd.rig import describe

    _refuse_conflicts(source, arkit, retarget_from, mapping, resample, prim, splines, out)
    for path in filter(None, (out, splines)):
        refuse_existing(path, force)
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
        motion, changes = _kept(loaded, source, motion)
    motion, said = _write(out, rig, loaded, motion, rate, prim, splines)
    changes.lines.extend(said)
    emit_motion(out, rate, motion, changes, as_json)
