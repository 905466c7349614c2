"""Find the poses in the first frame, from picks or by search, and check the scans and picks.

This package imports `contour` and `config`, but never `sequence`, `performance` or `region`.
"""
