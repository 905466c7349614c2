"""Options and output of `jawusd validate --face`: the verdicts on a face track."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from jawusd.cli.output import emit
from jawusd.formats.atomic import refuse_existing

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from jawusd.base.arrays import Array
    from jawusd.evaluator import JawRig
    from jawusd.evaluator.verdicts import Verdicts
    from jawusd.fitting.face_judging import JudgedFace

FaceOption = Annotated[
    Path | None,
    typer.Option(
        help="Face track: npz of jaw poses (FLAME, SMPL-X) or CSV of matrices in the model's frame, with --align; or "
        "the CSV of Live Link Face.",
        show_default=False,
    ),
]
AlignOption = Annotated[
    Path | None, typer.Option(help="For --face: the alignment of `jawusd align`.", show_default=False)
]
MappingOption = Annotated[
    Path | None,
    typer.Option(help="For --face of ARKit weights: a mapping of arkit-fit or skin-fit.", show_default=False),
]
CsvOption = Annotated[Path | None, typer.Option(help="For --face: table of verdicts to write.", show_default=False)]
StripOption = Annotated[
    Path | None,
    typer.Option(
        help="For --face: image to write (PNG): green is inside, amber within the tolerance, red invalid.",
        show_default=False,
    ),
]
_NO = 1  # exit code if a frame is invalid


class FaceOptions(NamedTuple):
    """The options of `jawusd validate --face`."""

    align: Path | None
    mapping: Path | None
    csv: Path | None
    strip: Path | None
    force: bool
    residual_mm: float | None
    tolerance_mm: float | None


def validate_face(rig: Path, face: Path, options: FaceOptions, prim: str | None, as_json: bool) -> None:
    """Print the verdicts on a face track, and write their table and strip; exit code 1 if a frame is invalid."""
    import jawusd
    from jawusd.fitting.face_judging import save_verdicts

    for out in (options.csv, options.strip):
        if out is not None:
            refuse_existing(out, options.force)
    judged = _judged(jawusd.load(rig, prim=prim), face, options)
    verdicts = judged.verdicts
    if options.csv is not None:
        save_verdicts(options.csv, judged)
    if options.strip is not None:
        from jawusd.report.strip import save_strip

        save_strip(options.strip, judged.frames, verdicts)
    rows = verdict_rows(judged.frames, verdicts)
    inside, valid = int((verdicts.valid & verdicts.inside()).sum()), int(verdicts.valid.sum())
    result = {
        "frames": len(rows),
        "inside": inside,
        "within_tolerance": valid - inside,
        "invalid": len(rows) - valid,
        "tolerance_mm": verdicts.tolerance_mm,
        "widened_mm": judged.widened_mm,
        "verdicts": rows,
    }
    summary = (
        f"{len(rows)} frames: {inside} inside, {valid - inside} within tolerance, {len(rows) - valid} invalid "
        f"(tolerance {verdicts.tolerance_mm:.2f} mm, of which {judged.widened_mm:.2f} mm for the alignment)"
    )
    emit(result, as_json, lambda: [*verdict_lines(rows), summary])
    if valid < len(rows):
        raise typer.Exit(_NO)


def _judged(rig: JawRig, face: Path, options: FaceOptions) -> JudgedFace:
    import numpy as np

    from jawusd.fitting.face_judging import JudgedFace, judge_jaw_track
    from jawusd.formats.alignment import load_alignment
    from jawusd.formats.face_table import header_of

    if face.suffix.lower() == ".csv" and "timecode" in header_of(face):
        from jawusd.cli.animate_commands import read_face

        if options.align is not None:
            raise typer.BadParameter("does not apply to ARKit weights.", param_hint="--align")
        motion = read_face(rig, face, None, options.mapping)
        known = np.isfinite(motion.d).all(axis=1)
        T = rig.pose(motion.d[known])
        verdicts = rig.validate(T, residual_limit_mm=options.residual_mm, tolerance_mm=options.tolerance_mm)
        return JudgedFace(motion.frames[known], verdicts, np.zeros(int(known.sum())), 0.0)
    if options.align is None:
        raise typer.BadParameter("is needed: write it with `jawusd align`.", param_hint="--align")
    return judge_jaw_track(rig, face, load_alignment(options.align), options.residual_mm, options.tolerance_mm)


def verdict_rows(frames: Array | NDArray[np.int64], verdicts: Verdicts) -> list[dict[str, object]]:
    """Return the verdicts on frames (F,) as rows for JSON."""
    return [
        {"frame": int(frame), "valid": bool(ok), "reason": words, "residual_mm": float(res), "margin_mm": float(margin)}
        for frame, ok, words, res, margin in zip(
            frames, verdicts.valid, verdicts.words(), verdicts.residual_mm, verdicts.margin_mm, strict=True
        )
    ]


def verdict_lines(rows: Sequence[Mapping[str, object]]) -> list[str]:
    """Return a line for each frame that is not inside the bound."""
    from jawusd.evaluator.verdicts import INSIDE

    shown = "frame {frame}: {reason} (residual {residual_mm:.2f} mm, margin {margin_mm:.2f} mm)"
    return [shown.format(**row) for row in rows if row["reason"] != INSIDE]
