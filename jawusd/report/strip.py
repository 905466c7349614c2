"""A strip of verdicts: one coloured column per frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.patches import Patch

from jawusd.base.arrays import Array
from jawusd.evaluator.verdicts import Verdicts
from jawusd.formats.atomic import write_bytes_atomic
from jawusd.report.style import DPI, GREEN, ORANGE, VERMILION, figure_bytes, new_figure

_INKS = (GREEN, ORANGE, VERMILION)
_WORDS = ("inside", "within tolerance", "invalid")


def save_strip(path: Path, frames: Array, verdicts: Verdicts) -> None:
    """Write an image of verdicts on frames (F,): green is inside, amber within the tolerance, red invalid.

    Plots of the margin to the bound and of the distance from the model [mm] are below the strip.

    Raises:
        OutputError: the file cannot be written.
    """
    kind = np.where(verdicts.valid, np.where(verdicts.inside(), 0, 1), 2)
    figure, (strip, lines) = new_figure(9.0, 2.6, 2, 1, sharex=True, height_ratios=[1.0, 3.0])
    for index, ink in enumerate(_INKS):
        strip.bar(frames[kind == index], 1.0, width=1.0, color=ink)
    strip.set_yticks([])
    strip.set_ylim(0.0, 1.0)
    counts = [f"{words} {int((kind == index).sum())}" for index, words in enumerate(_WORDS)]
    handles = [Patch(color=ink, label=label) for ink, label in zip(_INKS, counts, strict=True)]
    strip.legend(handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False)
    lines.plot(frames, verdicts.margin_mm, color="black", label="margin to the bound")
    lines.plot(frames, verdicts.residual_mm, color="grey", linestyle="--", label="distance from the model")
    lines.axhline(-verdicts.tolerance_mm, color="grey", linewidth=0.5)
    lines.set_xlabel("frame")
    lines.set_ylabel("mm")
    lines.legend(frameon=False)
    write_bytes_atomic(path, figure_bytes(figure, "png", DPI))
