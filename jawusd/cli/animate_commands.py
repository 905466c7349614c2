"""Commands that write an animation layer, and fit or tabulate mappings of ARKit weights."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jawusd.cli.options import USD_SUFFIXES, Allow, Force, Json, Prim, RigArg, rig_of_folder
from jawusd.cli.output import emit
from jawusd.formats.atomic import refuse_existing

if TYPE_CHECKING:
    from jawusd.base.arrays import Array
    from jawusd.cli.motion import AuthoredMotion, Changes
    from jawusd.evaluator import JawRig
    from jawusd.formats.arkit import ArkitMapping, BlendShapes


Rate = Annotated[
    float | None,
    typer.Option(
        min=0.001,
        help="Frames per second; with --arkit, of the output. Default: from the keys or time codes, else from the rig.",
    ),
]
RetargetFrom = Annotated[
    Path | None,
    typer.Option(
        help="Rig for which the source was made; the source may then also be an animation layer.",
        callback=rig_of_folder,
        show_default=False,
    ),
]


def _source_motion(loaded: JawRig, rig: Path, source: Path, prim: str | None) -> AuthoredMotion:
    from jawusd.cli.motion import AuthoredMotion, read_motion
    from jawusd.cli.stage_commands import holds_stage, read_stage_motion

    if not holds_stage(source):
        return read_motion(loaded, source)
    own = None if source.suffix.lower() in USD_SUFFIXES else prim  # the rig's prim path in the stage may differ
    found = read_stage_motion(loaded, rig, source, own, None, None, None)
    return AuthoredMotion(found.frames, found.d, found.fps)


def _kept(loaded: JawRig, source: Path | None, motion: AuthoredMotion) -> tuple[AuthoredMotion, Changes]:
    """Return the motion moved inside the bound, and the changes; warn if a stage, FBX or glTF has no motion."""
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
        (arkit and retarget_from, "--retarget-from", "needs a source; ARKit weights do not belong to a rig."),
        (mapping and not arkit, "--mapping", "needs --arkit, whose weights it maps."),
        (resample and retarget_from, "--resample", "needs a source made for this rig; retarget first."),
        (prim and splines, "--splines", "cannot be combined with --prim."),
        (_is_glb(out) and prim, "--prim", "needs a layer; a .glb is made from the actor's own file."),
        (_is_glb(out) and splines, "--splines", "needs a layer, not a .glb."),
    )
    for conflict, option, why in conflicts:
        if conflict:
            raise typer.BadParameter(why, param_hint=option)


def _is_glb(path: Path) -> bool:
    return path.suffix.lower() == ".glb"


def _write(
    out: Path, rig: Path, loaded: JawRig, motion: AuthoredMotion, rate: float, prim: str | None, splines: Path | None
) -> tuple[AuthoredMotion, list[str]]:
    """Write a layer or a .glb, and optionally the keys as splines; return the motion written, and notes."""
    from jawusd.cli.motion import follow_curves, knots_of
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
    rig: RigArg,
    source: Annotated[
        Path | None,
        typer.Argument(help="keys.json, a CSV of d or of poses, a stage, .fbx or .glb.", show_default=False),
    ] = None,
    retarget_from: RetargetFrom = None,
    arkit: Annotated[
        Path | None,
        typer.Option(help="ARKit face capture instead of SOURCE: the CSV of Live Link Face.", show_default=False),
    ] = None,
    mapping: Annotated[
        Path | None,
        typer.Option(
            help="Mapping of the actor's ARKit weights to d, from arkit-fit or skin-fit. "
            "Default: fractions of the ranges.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[Path, typer.Option("-o", "--out", help="Animation layer, or .glb for the web.")] = Path("anim.usdc"),
    fps: Rate = None,
    resample: Annotated[
        float | None,
        typer.Option("--resample", min=0.001, help="Frames per second of the layer, if different from the source."),
    ] = None,
    splines: Annotated[Path | None, typer.Option(help="Also write the keys as USD splines, to this layer.")] = None,
    force: Force = False,
    prim: Prim = None,
    allow: Allow = None,
    as_json: Json = False,
) -> None:
    """Write an animation layer over a rig, or meshes and motion as .glb; frames clamped to the bound are reported."""
    import jawusd
    from jawusd.cli.animate_commands import read_face
    from jawusd.cli.motion import carried_over, emit_motion, resampled
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


_CLAMPED_MM = 0.005  # minimum distance for a frame to be listed; smaller distances would be printed as 0.00


def arkit_fit(
    rig: RigArg,
    face: Annotated[Path, typer.Argument(help="ARKit face capture, the CSV of Live Link Face.", show_default=False)],
    jaw: Annotated[
        Path,
        typer.Argument(
            help="The jaw of the same performance: tracks.npz, d.csv, or a table of poses.", show_default=False
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Mapping to write (JSON).")] = Path("arkit.json"),
    fps: Annotated[
        float | None,
        typer.Option(min=0.001, help="Frames per second of the face capture. Default: from its time codes."),
    ] = None,
    jaw_fps: Annotated[
        float | None,
        typer.Option(min=0.001, help="Frames per second of the jaw. Default: that of the tracks or the rig."),
    ] = None,
    offset: Annotated[
        float | None,
        typer.Option(
            help="Time from frame 0 of the jaw to the first row of the face [s]. Default: estimated from the opening."
        ),
    ] = None,
    force: Force = False,
    prim: Prim = None,
    allow: Allow = None,
    as_json: Json = False,
) -> None:
    """Fit the mapping from a subject's ARKit jaw weights to d, for `animate`; face and jaw must be captured together.

    In the take, the subject must open the jaw wide, and move it to both sides and forward.
    """
    import jawusd
    from jawusd.fitting.face import fit_arkit
    from jawusd.formats.arkit import read_arkit, save_mapping

    refuse_existing(out, force)
    loaded = jawusd.load(rig, prim=prim)
    times_s, d = _jaw_of_take(loaded, rig, jaw, jaw_fps, prim)
    found = fit_arkit(loaded, read_arkit(face, fps), times_s, d, offset)
    save_mapping(out, found.mapping)
    result = {
        "file": str(out),
        "frames": found.frames,
        "offset_s": found.offset_s,
        "error_mm": found.error_mm,
        "shares_error_mm": found.shares_error_mm,
    }
    emit(
        result,
        as_json,
        lambda: [
            f"{out}: from {found.frames} frames, the face starts {found.offset_s:.3f} s after the jaw's frame 0",
            f"held-out error at the incisal point {found.error_mm:.2f} mm; "
            f"by fractions of the ranges {found.shares_error_mm:.2f} mm",
        ],
    )


def arkit_table(
    rig: RigArg,
    out: Annotated[Path, typer.Option("-o", "--out", help="Table to write (CSV).")] = Path("joint.csv"),
    mapping: Annotated[
        Path | None,
        typer.Option(help="The actor's mapping, from arkit-fit. Default: fractions of the ranges.", show_default=False),
    ] = None,
    force: Force = False,
    prim: Prim = None,
    allow: Allow = None,
    as_json: Json = False,
) -> None:
    """Write the jaw joint's offset for each ARKit shape at half and full weight, for rigs that sum joint deltas.

    Offsets are in millimetres and degrees relative to the neutral face, about the point midway between the condyles,
    along the skull's axes.
    """
    import jawusd
    from jawusd.formats.poses import save_joint_table
    from jawusd.pipeline.bake import joint_deltas

    refuse_existing(out, force)
    loaded = jawusd.load(rig, prim=prim)
    rows = joint_deltas(loaded, None if mapping is None else _own_mapping(loaded, mapping))
    save_joint_table(out, rows)
    clamped = [row for row in rows if row.clamped_mm > _CLAMPED_MM]
    lines = [f"{out}: {len(rows)} rows"]
    lines += [f"{row.shape} {row.weight:g} lay {row.clamped_mm:.2f} mm outside the bound" for row in clamped]
    emit({"file": str(out), "rows": len(rows), "clamped": len(clamped)}, as_json, lambda: lines)


def _jaw_of_take(rig: JawRig, path: Path, source: Path, fps: float | None, prim: str | None) -> tuple[Array, Array]:
    """Return times [s], shape (N,), and d [mm], shape (N, 3), of tracks or a table."""
    import numpy as np

    from jawusd.cli.motion import read_pose_table
    from jawusd.formats.poses import read_poses_or_parameters
    from jawusd.formats.tracks import load_tracks

    if source.suffix != ".npz":
        frames, d = read_poses_or_parameters(source)
    else:
        frames, d = read_pose_table(source)
        fps = fps or load_tracks(source).meta.get("fps")
    if d.ndim > 2:
        d, _ = rig.encode(d)
    return np.asarray(frames, dtype=np.float64) / (fps or rate_of(path, prim)), d


def rate_of(rig: Path, prim: str | None) -> float:
    """Return the frame rate of a rig, for a jaw motion whose file does not state one.

    Raises:
        typer.BadParameter: the rig does not state a frame rate.
    """
    from jawusd.cli.options import USD_SUFFIXES
    from jawusd.rig import describe

    if rig.suffix.lower() not in USD_SUFFIXES:
        raise typer.BadParameter(
            "is needed: neither the jaw motion nor the rig states a frame rate.", param_hint="--jaw-fps"
        )
    return float(describe(rig, prim)["fps"])


def read_face(rig: JawRig, source: Path, fps: float | None, mapping: Path | None) -> AuthoredMotion:
    """Read the jaw motion of an ARKit face capture, by the subject's mapping or as fractions of the ranges of motion.

    Without a mapping, JawOpen = 1 is the full opening, and (JawLeft - JawRight) and JawForward are fractions of the
    ranges of motion at the current opening. Left is the subject's left.

    Args:
        source: CSV of Live Link Face.
        fps: frame rate of the motion [1/s]; None: the rate of the time codes.
        mapping: file written by `jawusd arkit-fit`, or by `jawusd skin-fit` from the same blend shapes; None: use
            fractions of the ranges of motion.

    Raises:
        FormatError: the file is invalid or has no row with a face, or the mapping belongs to another subject.
    """
    import numpy as np

    from jawusd.base.errors import FormatError
    from jawusd.cli.motion import AuthoredMotion
    from jawusd.formats.arkit import read_arkit, read_blend_shapes, shares_of

    if mapping is not None and mapping.suffix == ".npz":
        shapes = read_blend_shapes(source, fps)
        frames, rate, d = shapes.frames, shapes.fps, _by_skin(rig, shapes, source, mapping)
    else:
        capture = read_arkit(source, fps)
        frames, rate = capture.frames, capture.fps
        own = None if mapping is None else _own_mapping(rig, mapping)
        d = rig.denormalized(shares_of(capture.weights)) if own is None else own.d(capture.weights)
    if not np.isfinite(d).any():
        raise FormatError("no row has a face (BlendShapeCount is 0 in all rows).", path=source)
    return AuthoredMotion(frames, d, rate)


def _by_skin(rig: JawRig, shapes: BlendShapes, source: Path, path: Path) -> Array:
    """Return d [mm], shape (F, 3), estimated from all blend shapes of a face capture."""
    from jawusd.base.errors import FormatError
    from jawusd.evaluator.skin import load_skin

    skin = load_skin(path)
    _check_actor(rig, skin.actor, path)
    if skin.meta.get("names") != list(shapes.names):
        raise FormatError(
            f"has {len(shapes.names)} blend shapes; {path.name} was learned from {skin.columns} columns, whose names "
            "or order differ.",
            path=source,
        )
    return skin(shapes.weights).d


def _own_mapping(rig: JawRig, path: Path) -> ArkitMapping:
    from jawusd.formats.arkit import load_mapping

    own = load_mapping(path)
    _check_actor(rig, own.actor, path)
    return own


def _check_actor(rig: JawRig, actor: str, path: Path) -> None:
    from jawusd.base.errors import FormatError

    if actor != rig.actor:
        raise FormatError(
            f'is the mapping of "{actor}", but the rig is of "{rig.actor}"; parameters differ between subjects.',
            path=path,
            hint="Omit --mapping, or animate that subject's rig and use `jawusd retarget`.",
        )
