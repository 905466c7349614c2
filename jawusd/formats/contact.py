"""The colours of contacts between teeth, as articulating paper marks them."""

from __future__ import annotations

from typing import NamedTuple


class Mark(NamedTuple):
    """Say what a colour means."""

    color: tuple[int, int, int]  # red, green, blue, 0 to 255
    meaning: str
    apart_mm: float  # surfaces nearer than this have it; of teeth that run too deep, beyond the closed bite


DEEP = Mark((120, 40, 200), "deeper than in the closed bite", -0.15)
TOUCHING = (
    Mark((200, 20, 30), "touching", 0.05),
    Mark((240, 120, 30), "within 0.2 mm", 0.2),
    Mark((250, 205, 70), "within 0.5 mm", 0.5),
)
