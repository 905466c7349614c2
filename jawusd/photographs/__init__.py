"""Estimate the bite from photographs of closed teeth taken with an uncalibrated camera.

This package uses the scan and contour code of `tracking`. Only `pipeline` imports it; it must not import other stages.
"""

from jawusd.photographs.align import PhotoAlignment, align_photographs
from jawusd.photographs.drawing import Drawing, read_lines
from jawusd.photographs.solve import seen_outlines

__all__ = ["Drawing", "PhotoAlignment", "align_photographs", "read_lines", "seen_outlines"]
