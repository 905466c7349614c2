"""Face captures: the command `arkit-fit`, and their jaw as a motion for `animate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jawusd.cli.options import Allow, Force, Json, Prim, RigArg
from jawusd.cli.output import emit
from jawusd.formats.atomic import refuse_existing

if TYPE_CHECKING:
    from jawusd.base.arrays import Array
    from jawusd.cli.motion import AuthoredMotion
    from jawusd.evaluator import JawRig
    from jawusd.formats.arkit import ArkitMapping

_CLAMPED_MM = 0.005  # what is less shows as 0.00


def arkit_fit(
    rig: RigArg,
    face: Annotated[Path, typer.Argument(help="ARKit face capture, the CSV of Live Link Face.", show_default=False)],
    jaw: Annotated[
        Path,
        typer.Argument(
            help="The jaw of the same performance: tracks.npz, d.csv, or a table of poses.", show_default=False
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="The mapping (JSON).")] = Path("arkit.json"),
    fps: Annotated[
        float | None, typer.Option(min=0.001, help="Frames per second of the face; else from its time codes.")
    ] = None,
    jaw_fps: Annotated[
        float | None, typer.Option(min=0.001, help="Frames per second of the jaw; else the tracks', or the rig's.")
    ] = None,
    offset: Annotated[
        float | None,
        typer.Option(help="Seconds from the jaw's frame 0 to the face's first row; else found from the opening."),
    ] = None,
    force: Force = False,
    prim: Prim = None,
    allow: Allow = None,
    as_json: Json = False,
) -> None:
    """Learn what a person's ARKit jaw weights mean from face and jaw captured together, for `animate --mapping`.

    The performance must open wide and move to both sides and forward.
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
            f"incisal point {found.error_mm:.2f} mm off where not learned from, by shares {found.shares_error_mm:.2f}",
        ],
    )


def arkit_table(
    rig: RigArg,
    out: Annotated[Path, typer.Option("-o", "--out", help="The table (CSV).")] = Path("joint.csv"),
    mapping: Annotated[
        Path | None,
        typer.Option(help="The actor's own mapping, from arkit-fit; else shares of the ranges.", show_default=False),
    ] = None,
    force: Force = False,
    prim: Prim = None,
    allow: Allow = None,
    as_json: Json = False,
) -> None:
    """Write what the jaw joint does for each ARKit shape at half and full weight, for rigs that add up joint deltas.

    Millimetres and degrees relative to the neutral face, about the point midway between the condyles, skull axes.
    """
    import jawusd
    from jawusd.formats.poses import save_joint_table
    from jawusd.pipeline.joint_table import joint_deltas

    refuse_existing(out, force)
    loaded = jawusd.load(rig, prim=prim)
    rows = joint_deltas(loaded, None if mapping is None else _own_mapping(loaded, mapping))
    save_joint_table(out, rows)
    clamped = [row for row in rows if row.clamped_mm > _CLAMPED_MM]
    lines = [f"{out}: {len(rows)} rows"]
    lines += [f"{row.shape} {row.weight:g} lay {row.clamped_mm:.2f} mm outside the bound" for row in clamped]
    emit({"file": str(out), "rows": len(rows), "clamped": len(clamped)}, as_json, lambda: lines)


def _jaw_of_take(rig: JawRig, path: Path, source: Path, fps: float | None, prim: str | None) -> tuple[Array, Array]:
    """Return times [s] (N,) and d [mm] (N, 3) of tracks or a table."""
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
    return np.asarray(frames, dtype=np.float64) / (fps or _rate_of(path, prim)), d


def _rate_of(rig: Path, prim: str | None) -> float:
    from jawusd.cli.options import USD_SUFFIXES
    from jawusd.rig import describe

    if rig.suffix.lower() not in USD_SUFFIXES:
        raise typer.BadParameter(
            "is needed: neither the jaw nor the rig's file tells the rate.", param_hint="--jaw-fps"
        )
    return float(describe(rig, prim)["fps"])


def read_face(rig: JawRig, source: Path, fps: float | None, mapping: Path | None) -> AuthoredMotion:
    """Read the jaw of an ARKit face capture by the person's own mapping, or as shares of the person's own ranges.

    As shares, JawOpen 1 is the full opening; JawLeft less JawRight, and JawForward, are shares of the reach to that
    side at that opening. Left is the subject's left.

    Args:
        source: CSV of Live Link Face.
        fps: frames per second of the motion, None for the rate of the time codes.
        mapping: file of `jawusd arkit-fit`, None for shares.

    Raises:
        FormatError: not such a file, no row with a face, or the mapping of another person.
    """
    import numpy as np

    from jawusd.base.errors import FormatError
    from jawusd.cli.motion import AuthoredMotion
    from jawusd.formats.arkit import read_arkit, shares_of

    capture = read_arkit(source, fps)
    if mapping is None:
        d = rig.denormalized(shares_of(capture.weights))
    else:
        d = _own_mapping(rig, mapping).d(capture.weights)
    if not np.isfinite(d).any():
        raise FormatError("no row has a face (BlendShapeCount is 0 in all of them).", path=source)
    return AuthoredMotion(capture.frames, d, capture.fps)


def _own_mapping(rig: JawRig, path: Path) -> ArkitMapping:
    from jawusd.base.errors import FormatError
    from jawusd.formats.arkit import load_mapping

    own, actor = load_mapping(path), str(rig.meta.get("actor", ""))
    if own.actor != actor:
        raise FormatError(
            f'is the mapping of "{own.actor}", the rig is of "{actor}"; d means other movements of another person.',
            path=path,
            hint="Leave --mapping out, or animate that person's rig and carry it over with `jawusd retarget`.",
        )
    return own
