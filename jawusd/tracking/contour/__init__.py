"""Align both scans with the masks of one instant: contour samples, correspondences, normal equations, quality.

Imports no other subpackage of tracking, only `config`.
"""
