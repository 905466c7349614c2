"""Calibrated cameras of this and other programs: a module for each file format, listed in `files`.

Imports `formats`, `geometry` and `base`; knows nothing of captures' footage.
"""
