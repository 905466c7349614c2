"""Scans and bones: reading, crown labels, the rasteriser, solids and how they touch.

Knows nothing of pictures, cameras' files or tracking.
"""
