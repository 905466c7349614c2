"""Commands on faces: learn jaw motion (`skin-fit`, `arkit-fit`), `align` a model, and judge it (`validate --face`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from typer import Argument, BadParameter, Option

import jawusd
from jawusd.base.errors import naming_file
from jawusd.cli import options
from jawusd.cli.animate_commands import rate_of
from jawusd.cli.animate_commands import read_face as read_arkit_motion
from jawusd.cli.output import emit
from jawusd.evaluator import JawRig
from jawusd.evaluator.skin import Skin
from jawusd.formats.alignment import Alignment, load_alignment, load_correspondences, save_alignment
from jawusd.formats.atomic import refuse_existing
from jawusd.formats.face_table import FaceTable, header_of

if TYPE_CHECKING:
    from jawusd.fitting.face_judging import JudgedFace


_GUESSES = {"chin": "a chin rigid with the bone", "mean": "the mean d", "carried": "the last d"}


TakeArg = Annotated[Path, Argument(help="The jaw of a take: tracks.npz, the CSV of solve, or a table of d or poses.")]
FaceArg = Annotated[
    Path,
    Argument(
        help="Face data of the same take: C3D, TRC or another marker table, the CSV of Live Link Face, or a CSV of "
        "columns or points."
    ),
]
Out = Annotated[Path, Option("-o", "--out", help="Learned map to write (.npz).")]
Fps = Annotated[
    float | None, Option(min=0.001, help="Frames per second of the face capture. Default: that of the file.")
]
JawFps = Annotated[
    float | None, Option(min=0.001, help="Frames per second of the jaw. Default: that of the tracks or the rig.")
]
Offset = Annotated[
    float | None,
    Option(help="Time from frame 0 of the jaw to frame 0 of the face [s]. Default: estimated from the motion."),
]
Bites = Annotated[
    list[str] | None,
    Option(
        metavar="FIRST-LAST",
        help="Frames of the jaw with closed lips and the teeth in occlusion, such as 1200-1260. Repeatable.",
    ),
]
Rigid = Annotated[
    list[str] | None,
    Option(
        metavar="head=MARKERS",
        help="Markers fixed to the head, by name, number or marker description; the points are expressed relative to "
        "them. Names and numbers need --rest-frame. Without this option, the points must already be stabilised.",
    ),
]
RestFrame = Annotated[
    int | None, Option(help="For --rigid: number of the frame of the face data that defines the marker positions.")
]
HeadError = Annotated[
    tuple[float, float],
    Option(
        min=0.0,
        metavar="MM DEGREES",
        help="Additional standard deviation of the head-stabilisation error in later takes, relative to this take.",
    ),
]


def skin_fit(
    rig: options.RigArg,
    take: TakeArg,
    face: FaceArg,
    out: Out = Path("skin.npz"),
    fps: Fps = None,
    jaw_fps: JawFps = None,
    offset: Offset = None,
    bite: Bites = None,
    rigid: Rigid = None,
    rest_frame: RestFrame = None,
    length_unit: options.UnitOption = "mm",
    head_error: HeadError = (0.3, 0.15),
    force: options.Force = False,
    prim: options.Prim = None,
    allow: options.Allow = None,
    as_json: options.Json = False,
) -> None:
    """Learn d from facial skin in frames with visible teeth, to estimate the jaw in frames with closed lips.

    Points must be relative to the head: stabilised, or with --rigid head=MARKERS. The take must contain the jaw
    exercises, speech with visible teeth, every expression, and a few seconds of occlusion (--bite).
    """
    from jawusd.pipeline.skin import read_face

    refuse_existing(out, force)
    bites = [_frames(text) for text in bite or ()]
    seen = read_face(face, fps, length_unit, options.rigid_bodies(rigid), rest_frame)
    error = (head_error[0], math.radians(head_error[1]))
    _learn(rig, take, seen, out, jaw_fps, offset, prim, as_json, bites, error)


def arkit_fit(
    rig: options.RigArg,
    face: Annotated[Path, Argument(help="ARKit face capture, the CSV of Live Link Face.")],
    take: TakeArg,
    out: Out = Path("arkit.npz"),
    fps: Fps = None,
    jaw_fps: JawFps = None,
    offset: Offset = None,
    force: options.Force = False,
    prim: options.Prim = None,
    allow: options.Allow = None,
    as_json: options.Json = False,
) -> None:
    """Learn d from the four ARKit jaw weights, as skin-fit does from all blend shapes, for `animate` and `arkit-table`.

    Face and jaw must be captured together. The subject must open the jaw wide, and move it to both sides and forward.
    """
    from jawusd.formats.arkit import read_arkit

    refuse_existing(out, force)
    _learn(rig, take, read_arkit(face, fps), out, jaw_fps, offset, prim, as_json, weights=True)


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
    from jawusd.pipeline.skin import learn_skin, read_jaw

    loaded = jawusd.load(rig, prim=prim)
    jaw = read_jaw(loaded, take)
    jaw = replace(jaw, fps=jaw_fps or jaw.fps or rate_of(rig, prim))
    for first, last in bites:
        jaw = jaw.with_bite(first, last)
    if face.fps is None:
        raise BadParameter("is needed: the face capture does not state a frame rate.", param_hint="--fps")
    skin, offset_s = learn_skin(loaded, jaw, face, offset, head_error, jaw_weights=weights)
    jawusd.save_skin(out, skin)
    emit({"file": str(out), "offset_s": offset_s, **skin.meta}, as_json, _skin_lines(out, skin, offset_s))


def _skin_lines(out: Path, skin: Skin, offset_s: float) -> list[str]:
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
        raise BadParameter(f'"{text}" is not of the form FIRST-LAST, such as 1200-1260.', param_hint="--bite")
    return int(first), int(last)


def align(
    rig: options.RigArg,
    correspondences: Annotated[Path, Argument(help="Points of the face model and of the rig (JSON).")],
    out: Annotated[Path, Option("-o", "--out", help="Alignment to write (JSON).")] = Path("T_skull_model.json"),
    force: options.Force = False,
    prim: options.Prim = None,
    allow: options.Allow = None,
    as_json: options.Json = False,
) -> None:
    """Align a face model (FLAME, SMPL-X, ICT-FaceKit, any) with the skull frame of a rig, by a few named points.

    The rig provides the lower incisal point, first molars and condyles; other points, such as the chin, need their
    position in the skull frame. The command prints the expected error at the teeth and the condyles.
    """
    refuse_existing(out, force)
    loaded, given = jawusd.load(rig, prim=prim), load_correspondences(correspondences)
    points = given.points
    with naming_file(correspondences):
        found = jawusd.align(
            loaded,
            {name: point.model for name, point in points.items()},
            {name: point.rig for name, point in points.items() if point.rig is not None},
            sigma_mm={name: point.sigma_mm for name, point in points.items()},
            unit_mm=given.unit_mm,
            scale=given.scale,
            joint=given.joint,
        )
    save_alignment(out, found)
    emit({"file": str(out), **found.model_dump(mode="json")}, as_json, _align_lines(out, found, given.scale))


def _align_lines(out: Path, found: Alignment, scale: bool) -> list[str]:
    unit = f"; a model unit is {found.unit_mm:.4g} mm" if scale else ""
    return [
        f"{out}: from {len(found.off_mm)} points{unit}",
        f"expected error {found.teeth_mm:.2f} mm at the teeth, {found.condyles_mm:.2f} mm at the condyles",
        "distances after the fit [mm]: " + ", ".join(f"{name} {off:.1f}" for name, off in found.off_mm.items()),
    ]


FaceOption = Annotated[
    Path | None,
    Option(
        help="Face track: npz of jaw poses (FLAME, SMPL-X) or CSV of matrices in the model's frame, with --align; or "
        "the CSV of Live Link Face."
    ),
]
AlignOption = Annotated[Path | None, Option(help="For --face: the alignment of `jawusd align`.")]
MappingOption = Annotated[Path | None, Option(help="For --face of ARKit weights: a mapping of arkit-fit or skin-fit.")]
CsvOption = Annotated[Path | None, Option(help="For --face: table of verdicts to write.")]
StripOption = Annotated[
    Path | None,
    Option(help="For --face: image to write (PNG): green is inside, amber within the tolerance, red invalid."),
]


def judge_face(
    rig: JawRig,
    face: Path,
    align: Path | None,
    mapping: Path | None,
    residual_mm: float | None,
    tolerance_mm: float | None,
) -> JudgedFace:
    """Judge a face track against a rig: jaw poses by means of an alignment, or ARKit weights."""
    from jawusd.fitting.face_judging import JudgedFace, judge_jaw_track

    if face.suffix.lower() == ".csv" and "timecode" in header_of(face):
        if align is not None:
            raise BadParameter("does not apply to ARKit weights.", param_hint="--align")
        motion = read_arkit_motion(rig, face, None, mapping)
        known = np.isfinite(motion.d).all(axis=1)
        T = rig.pose(motion.d[known])
        verdicts = rig.validate(T, residual_limit_mm=residual_mm, tolerance_mm=tolerance_mm)
        return JudgedFace(motion.frames[known], verdicts, np.zeros(int(known.sum())), 0.0)
    if align is None:
        raise BadParameter("is needed: write it with `jawusd align`.", param_hint="--align")
    return judge_jaw_track(rig, face, load_alignment(align), residual_mm, tolerance_mm)
