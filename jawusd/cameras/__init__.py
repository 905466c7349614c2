"""Calibrated cameras from jawusd and other programs: one module per file format, registered by `files`.

May import `formats`, `geometry` and `base`; does not read footage.
"""
