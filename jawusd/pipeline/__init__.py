"""Build, track, fit, solve, report and view: each from its inputs to its files.

The algorithms live in the packages below; nothing here prints, and nothing here imports `cli`.
"""
