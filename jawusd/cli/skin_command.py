"""The commands `skin-fit` and `arkit-fit`, which learn jaw motion from faces."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jawusd.cli.options import Allow, Force, Json, LengthUnit, Prim, RigArg, UnitOption
from jawusd.cli.output import emit
from jawusd.formats.atomic import refuse_existing

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jawusd.evaluator.skin import Skin
    from jawusd.formats.face_table import FaceTable

_GUESSES = {"chin": "a chin rigid with the bone", "mean": "the mean d", "carried": "the last d"}


TakeArg = Annotated[
    Path,
    typer.Argument(
        help="The jaw of a take: tracks.npz, the CSV of solve, or a table of d or poses.", show_default=False
    ),
]
FaceArg = Annotated[
    Path,
    typer.Argument(
        help="The face of the same take: C3D, TRC or another marker table, the CSV of Live Link Face, or a CSV of "
        "columns or points.",
        show_default=False,
    ),
]
Out = Annotated[Path, typer.Option("-o", "--out", help="Learned map to write (.npz).")]
Fps = Annotated[
    float | None, typer.Option(min=0.001, help="Frames per second of the face capture. Default: that of the file.")
]
JawFps = Annotated[
    float | None, typer.Option(min=0.001, help="Frames per second of the jaw. Default: that of the tracks or the rig.")
]
Offset = Annotated[
    float | None,
    typer.Option(help="Time from frame 0 of the jaw to frame 0 of the face [s]. Default: estimated from the motion."),
]
Bites = Annotated[
    list[str] | None,
    typer.Option(
        metavar="FIRST-LAST",
        help="Frames of the jaw with closed lips and the teeth in occlusion, such as 1200-1260. Repeatable.",
        show_default=False,
    ),
]
Rigid = Annotated[
    list[str] | None,
    typer.Option(
        metavar="head=MARKERS",
        help="Markers fixed to the head; points are expressed relative to them: names, numbers, or a "
        "marker description. Names and numbers need --rest-frame. Default: the points are stabilised.",
        show_default=False,
    ),
]
RestFrame = Annotated[
    int | None, typer.Option(help="For --rigid: frame of the face that defines the marker positions on the head.")
]
HeadError = Annotated[
    tuple[float, float],
    typer.Option(
        min=0.0,
        metavar="MM DEGREES",
        help="Additional standard deviation of the head-stabilisation error in later takes, relative to this take.",
    ),
]


def skin_fit(
    rig: RigArg,
    take: TakeArg,
    face: FaceArg,
    out: Out = Path("skin.npz"),
    fps: Fps = None,
    jaw_fps: JawFps = None,
    offset: Offset = None,
    bite: Bites = None,
    rigid: Rigid = None,
    rest_frame: RestFrame = None,
    length_unit: UnitOption = LengthUnit.mm,
    head_error: HeadError = (0.3, 0.15),
    force: Force = False,
    prim: Prim = None,
    allow: Allow = None,
    as_json: Json = False,
) -> None:
    """Learn d from facial skin in frames with visible teeth, to estimate the jaw in frames with closed lips.

    Points must be relative to the head: stabilised, or with --rigid head=MARKERS. The take must contain the jaw
    exercises, speech with visible teeth, every expression, and a few seconds of occlusion (--bite).
    """
    import math

    from jawusd.cli.options import rigid_bodies
    from jawusd.pipeline.skin import read_face

    refuse_existing(out, force)
    bites = [_frames(text) for text in bite or ()]
    seen = read_face(face, fps, length_unit.value, rigid_bodies(rigid), rest_frame)
    error = (head_error[0], math.radians(head_error[1]))
    _learn(rig, take, seen, out, jaw_fps, offset, prim, as_json, bites, error)


def arkit_fit(
    rig: RigArg,
    face: Annotated[Path, typer.Argument(help="ARKit face capture, the CSV of Live Link Face.", show_default=False)],
    take: TakeArg,
    out: Out = Path("arkit.npz"),
    fps: Fps = None,
    jaw_fps: JawFps = None,
    offset: Offset = None,
    force: Force = False,
    prim: Prim = None,
    allow: Allow = None,
    as_json: Json = False,
) -> None:
    """Learn d from the four ARKit jaw weights, as skin-fit does from all blend shapes, for `animate` and `arkit-table`.

    Face and jaw must be captured together. The subject must open the jaw wide, and move it to both sides and forward.
    """
    from jawusd.pipeline.skin import read_jaw_weights

    refuse_existing(out, force)
    _learn(rig, take, read_jaw_weights(face, fps), out, jaw_fps, offset, prim, as_json, weights=True)


def _learn(
    rig: Path,
    take: Path,
    face: FaceTable,
    out: Path,
    jaw_fps: float | None,
    offset: float | None,
    prim: str | None,
    as_json: bool,
    bites: Sequence[tuple[int, int]] = (),
    head_error: tuple[float, float] = (0.0, 0.0),
    weights: bool = False,
) -> None:
    """Learn d from a face, or from its four jaw weights alone, and write and print the result."""
    import jawusd
    from jawusd.cli.animate_commands import rate_of
    from jawusd.pipeline.skin import learn_jaw_weights, learn_skin, read_jaw

    loaded = jawusd.load(rig, prim=prim)
    jaw = read_jaw(loaded, take)
    jaw = jaw.at_rate(jaw_fps or jaw.fps or rate_of(rig, prim))
    for first, last in bites:
        jaw = jaw.with_bite(first, last)
    if face.fps is None:
        raise typer.BadParameter("is needed: the face capture does not state a frame rate.", param_hint="--fps")
    learn = learn_jaw_weights if weights else learn_skin
    skin, offset_s = learn(loaded, jaw, face, offset, head_error)
    jawusd.save_skin(out, skin)
    emit({"file": str(out), "offset_s": offset_s, **skin.meta}, as_json, lambda: _lines(out, skin, offset_s))


def _lines(out: Path, skin: Skin, offset_s: float) -> list[str]:
    errors = skin.errors_mm
    what = f"{skin.columns // 3} points" if skin.points else f"{skin.columns} columns"
    guesses = ", ".join(f"{words} {errors[name]:.2f}" for name, words in _GUESSES.items() if name in errors)
    return [
        f"{out}: {what}, {skin.meta['frames']} frames with a known jaw, face {offset_s:.3f} s after the jaw's frame 0",
        f"held-out error at the incisal point {errors['skin']:.2f} mm; {guesses}",
        f"{skin.meta['false_alarms']:.1%} of the held-out frames would be flagged as unfamiliar",
    ]


def _frames(text: str) -> tuple[int, int]:
    first, _, last = text.partition("-")
    if not (first.isdigit() and last.isdigit() and int(first) <= int(last)):
        raise typer.BadParameter(f'"{text}" is not of the form FIRST-LAST, such as 1200-1260.', param_hint="--bite")
    return int(first), int(last)
