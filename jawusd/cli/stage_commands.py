"""Commands that bring stages edited elsewhere back to d."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jawusd.cli.options import Force, Json, Prim, RigArg
from jawusd.cli.output import emit, refuse_existing

if TYPE_CHECKING:
    from jawusd.evaluator import JawRig
    from jawusd.rig.rebake import StageMotion


class Origin(StrEnum):
    """Name what a motion can be read from."""

    d = "d"
    mandible = "mandible"


def rebake(
    rig: RigArg,
    stage: Annotated[Path, typer.Argument(help="Shot or animation layer that holds the rig.", show_default=False)],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Layer over the stage; <stage>_baked.usdc if not given.")
    ] = None,
    origin: Annotated[
        Origin | None, typer.Option("--from", help="What counts where d and mandible disagree.", show_default=False)
    ] = None,
    prim: Prim = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Give a stage the d and the mandible that belong together, where only one was keyed or moved.

    The motion is brought inside the bound; what lay outside is reported with its margin.
    """
    import jawusd
    from jawusd.cli.motion import AuthoredMotion, kept_inside
    from jawusd.rig.rebake import motion_of_stage, write_rebaked

    out = out or stage.with_name(f"{stage.stem}_baked.usdc")
    refuse_existing(out, force)
    loaded = jawusd.load(rig)
    found = motion_of_stage(stage, loaded, prim, origin.value if origin else None)
    motion, changes = kept_inside(loaded, AuthoredMotion(found.frames, found.d, found.fps))
    known = [i for i, row in enumerate(motion.d) if row[0] == row[0]]
    write_rebaked(out, stage, loaded, motion.frames[known], motion.d[known], prim)
    judged = judged_motion(loaded, found)
    result = {"file": str(out), "from": found.origin, **judged, **changes.figures}
    first, last = float(motion.frames[0]), float(motion.frames[-1])
    head = f"{out}: frames {first:g} .. {last:g} at {found.fps:g} fps, from the {_ORIGINS[found.origin]}"
    emit(result, as_json, lambda: [head, *judged_lines(judged), *changes.lines[1:]])


_ORIGINS = {"d": "keys of d", "mandible": "mandible's transforms"}


def judged_motion(rig: JawRig, motion: StageMotion) -> dict[str, object]:
    """Return how far a motion is from the model and from the bound."""
    import numpy as np

    known = np.isfinite(motion.d).all(axis=1)
    margin = np.where(known, rig.margin(motion.d), np.inf)
    outside = known & ~rig.is_inside(motion.d)
    worst = int(np.argmin(margin))
    return {
        "frames": len(motion.frames),
        "residual_mm": float(np.nanmax(motion.residual_mm, initial=0.0)),
        "outside": int(outside.sum()),
        "worst_frame": float(motion.frames[worst]),
        "worst_margin_mm": float(margin[worst]),
    }


def judged_lines(judged: dict[str, object]) -> list[str]:
    """Return the same in words."""
    lines = [f"at most {judged['residual_mm']:.3f} mm from the model"]
    if judged["outside"]:
        where = f"worst at frame {judged['worst_frame']:g}, margin {judged['worst_margin_mm']:.2f} mm"
        lines.append(f"{judged['outside']} of {judged['frames']} samples lay outside the bound; {where}")
    return lines
