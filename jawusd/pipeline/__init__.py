"""The operations build, track, fit, solve, report and view, each from input files to output files.

The algorithms are in lower-level packages. This package does not print, and does not import `cli`.
"""
