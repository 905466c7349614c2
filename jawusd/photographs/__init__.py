"""Photographs of teeth that are together, taken with a camera that nobody calibrated."""

from jawusd.photographs.align import PhotoAlignment, align_photographs
from jawusd.photographs.drawing import Drawing, read_lines
from jawusd.photographs.solve import seen_outlines

__all__ = ["Drawing", "PhotoAlignment", "align_photographs", "read_lines", "seen_outlines"]
