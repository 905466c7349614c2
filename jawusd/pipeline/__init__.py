"""The operations build, track, fit, solve, report and view, each from input files to output files.

`build.run_stages`, `track.track` and `solve.solve` list the stages of these operations in order.
The algorithms are in lower-level packages. This package does not print, and does not import `cli`.
"""
