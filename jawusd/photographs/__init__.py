"""The bite from photographs of closed teeth, taken with uncalibrated cameras.

Uses the contours of `tracking`; nothing but `pipeline` imports it.
"""

from jawusd.photographs.align import PhotoAlignment, align_photographs
from jawusd.photographs.drawing import Drawing, read_lines
from jawusd.photographs.solve import seen_outlines

__all__ = ["Drawing", "PhotoAlignment", "align_photographs", "read_lines", "seen_outlines"]
