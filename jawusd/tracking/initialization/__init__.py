"""Find the poses in the first frame, from picks or by search, and check the scans and picks.

Imports `contour` and `config`; never `sequence`, `performance` or `region`.
"""
