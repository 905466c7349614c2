"""Estimate the bite from photographs of closed teeth taken with an uncalibrated camera.

This package uses the scan and contour code of `tracking`. Only `cli` imports it; it must not import other stages.
"""
