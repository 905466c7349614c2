"""A bar under pictures of a take: frame and time, what a solve found there, and what the colours mean."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.evaluator.verdicts import place
from jawusd.formats.performance import STATE_COLOURS, STATE_WORDS, SolveState
from jawusd.formats.tracks import Tracks
from jawusd.media.overlay import LOWER_COLOUR, UPPER_COLOUR, Colour

_WHITE: Colour = (240, 240, 240)
_WIDE_PX = 1200  # narrower bars have a line for each piece of text
_LINE_PX, _LEFT_PX, _GAP_PX, _SWATCH_PX = 26, 10, 34, 14
_FONT, _SIZE = cv2.FONT_HERSHEY_SIMPLEX, 0.55

Piece = tuple[str, Colour, bool]  # text, its colour, and whether a patch of the colour stands before white text


class StatusBar:
    """Draw the bar of one take at one width."""

    def __init__(self, tracks: Tracks, fps: float, width_px: int) -> None:
        """Take the tracks; times count from frame 0 on."""
        self._tracks, self._fps, self._width_px = tracks, fps, width_px
        if tracks.solved is None:
            self._legend: list[Piece] = [("upper teeth", UPPER_COLOUR, True), ("lower teeth", LOWER_COLOUR, True)]
        else:
            self._legend = [(STATE_WORDS[state], colour, True) for state, colour in STATE_COLOURS.items()]

    def draw(self, row: int) -> NDArray[np.uint8]:
        """Return the bar of the frame at a row of the tracks, (h, w, 3) RGB; h is the same for all."""
        lines: list[list[Piece]] = [self._said(row), self._legend]
        if self._width_px < _WIDE_PX:
            lines = [[piece] for line in lines for piece in line]
        bar = np.zeros((_LINE_PX * len(lines) + _LEFT_PX, self._width_px, 3), np.uint8)
        for number, line in enumerate(lines, start=1):
            _write(bar, line, _LINE_PX * number - 4)
        return bar

    def _said(self, row: int) -> list[Piece]:
        frame = int(self._tracks.frames[row])
        said: list[Piece] = [(f"frame {frame}   {frame / self._fps:.3f} s", _WHITE, False)]
        solved = self._tracks.solved
        if solved is not None:
            state = SolveState(int(solved.state[row]))
            pairs = zip(("d1", "d2", "d3"), solved.d[row], solved.sigma_mm[row], strict=True)
            values = "   ".join(f"{name} {value:.2f} +-{sigma:.2f}" for name, value, sigma in pairs)
            margin = float(solved.margin_mm[row])
            where = place(margin, float(self._tracks.meta.get("tolerance_mm", 0.0)))
            said.append((str(state), STATE_COLOURS[state], False))
            said.append((f"{values} mm (1 sigma)", _WHITE, False))
            said.append((f"bound: {where}, margin {margin:.2f} mm", _WHITE, False))
        return said


def _write(bar: NDArray[np.uint8], line: Sequence[Piece], baseline: int) -> None:
    at = _LEFT_PX
    for text, colour, patch in line:
        if patch:
            cv2.rectangle(bar, (at, baseline - _SWATCH_PX + 2), (at + _SWATCH_PX, baseline + 2), colour, -1)
            at += _SWATCH_PX + 8
        ink = _WHITE if patch else colour
        cv2.putText(bar, text, (at, baseline), _FONT, _SIZE, ink, 1, cv2.LINE_AA)
        at += cv2.getTextSize(text, _FONT, _SIZE, 1)[0][0] + _GAP_PX
